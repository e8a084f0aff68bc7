"""External torque of the bus's samples, where a file says what was learned of the arm's own work."""

from collections import deque
from datetime import datetime
from pathlib import Path

from armlink.errors import ArmlinkError, BadInput
from armlink.loop.messages import Batch
from calib.arm.kinematics import gcomp_arm
from calib.arm.stated_model import StatedModel
from calib.daemon.environment import Environment
from calib.daemon.observation.observation import ObserverFeed
from calib.daemon.settings import Configuration
from calib.external.arm_model import ArmRecords
from calib.external.learned import Learned, load_learned
from calib.external.live import LiveExternal
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.external.contact import ContactEvent

MOST_EVENTS = 50
"""The newest ones are kept."""


class ExternalTorque:
    def __init__(self, configuration: Configuration, environment: Environment, path: Path) -> None:
        """`path` is the file of `armlink external --learned`."""
        self._configuration, self._environment, self.path = configuration, environment, path
        self.reason = "there are no records yet"
        """Why there is no external torque, in one line; empty if there is."""
        self.live: LiveExternal | None = None
        self.events: deque[tuple[datetime, ContactEvent]] = deque(maxlen=MOST_EVENTS)
        self._asked = 0

    def renew(self, calibration: CalibrationRecord, gravity: GravityRecord) -> None:
        """Other records, another arm file or another file: read it again, in the thread for the disk."""
        arm, path = self._configuration.arm, self.path
        self.live, self.reason = None, f"{path.name} of the state directory is being read"
        self._asked += 1
        asked = self._asked

        def work() -> Learned:
            if not path.is_file():
                raise BadInput(
                    f"nothing is learned yet from this arm's work: run armlink external {arm.argument} --baseline "
                    f"RECORDING --learned {path}, then reload the daemon"
                )
            stated = StatedModel(gcomp_arm(arm), None, None, None, arm)
            return load_learned(path, ArmRecords(stated, calibration, gravity.carrying(arm)))

        def done(found: Learned | Exception) -> None:
            if asked != self._asked:
                return
            try:
                if isinstance(found, Exception):
                    raise found
                self.live, self.reason = LiveExternal(found, arm.require_link().rate), ""
            except ArmlinkError as error:
                self.reason = str(error)

        self._environment.disk(work, done)

    def take(self, batch: Batch, feed: ObserverFeed) -> None:
        if self.live is None:
            return
        channel = self.live.learned.listener.channel
        torque = batch.channels[channel]
        events = self.live.take(
            batch.t,
            batch.channels["position"],
            batch.channels["velocity"],
            feed.reading(torque) if channel == "torque" else torque,
            batch.temperature,
        )
        self.events.extend((self._environment.wall(), event) for event in events)

    def interrupt(self) -> None:
        """The calibration changes under the readings."""
        if self.live is not None:
            self.live.restart()
