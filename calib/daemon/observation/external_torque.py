"""External torque of the bus's samples, where a file says what was learned of the arm's own work."""

from collections import deque
from pathlib import Path

from armlink.errors import ArmlinkError, BadInput
from armlink.loop.messages import Batch
from calib.arm.kinematics import StatedModel, gcomp_arm
from calib.daemon.environment import Environment
from calib.daemon.observation.observation import ObserverFeed
from calib.daemon.settings import Configuration
from calib.daemon.state.events import EventLog
from calib.daemon.view import ContactItem, ExternalEvent, Hub
from calib.external.arm_model import ArmRecords
from calib.external.listening import Learned, LiveExternal, load_learned
from calib.external.tables import event_of, event_text
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.external.contact import EVENT_KINDS, ContactEvent

MOST_EVENTS = 50
"""The newest ones are kept."""
LOGGED_SECONDS = 60.0
"""Least time between two events of one kind in the event log [s], which keeps each for good: hands that work on an arm
all day make thousands of contacts."""


class ExternalTorque:
    def __init__(
        self, configuration: Configuration, environment: Environment, path: Path, log: EventLog, hub: Hub
    ) -> None:
        """`path` is the file of `armlink external --learned`."""
        self._configuration, self._environment, self.path = configuration, environment, path
        self._log, self._hub = log, hub
        self.reason = "there are no records yet"
        """Why there is no external torque, in one line; empty if there is."""
        self.live: LiveExternal | None = None
        self.events: deque[ExternalEvent] = deque(maxlen=MOST_EVENTS)
        self.counts = dict.fromkeys(EVENT_KINDS, 0)
        """Number of events since the service began, by kind."""
        self._logged = dict.fromkeys(EVENT_KINDS, (-float("inf"), 0))
        """When an event of each kind was logged last [s], and their number then."""
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
                self.live, self.reason = LiveExternal(found), ""
            except ArmlinkError as error:
                self.reason = str(error)

        self._environment.disk(work, done)

    def take(self, batch: Batch, feed: ObserverFeed) -> None:
        if self.live is None:
            return
        channel = self.live.learned.listener.channel
        position, velocity, torque = (batch.channels[name] for name in ("position", "velocity", channel))
        if channel == "torque":
            torque = feed.reading(torque)
        for event in self.live.take(batch.t, position, velocity, torque, batch.temperature):
            self._tell(event)

    def interrupt(self) -> None:
        """The calibration changes under the readings."""
        if self.live is not None:
            self.live.restart()

    def _tell(self, event: ContactEvent) -> None:
        """To the stream at once; to the log unless it has one of this kind of late."""
        found, kind = event_of(event, self._configuration.names), event.kind
        told = {name: value for name, value in found.items() if name in ExternalEvent.model_fields}
        self.events.append(ExternalEvent(time=self._environment.wall(), **told))
        self._hub.publish(ContactItem(contact=self.events[-1]))
        self.counts[kind] += 1
        now, (logged_at, logged) = self._environment.monotonic(), self._logged[kind]
        if now - logged_at >= LOGGED_SECONDS:
            self._logged[kind] = now, self.counts[kind]
            evidence = found | {"unlogged": self.counts[kind] - logged - 1}
            self._log.say("contact", found["link"], event_text(found), evidence)
