"""The records in force: read from the store, compared with what the controllers hold, observed against."""

from collections.abc import Callable

from armlink.errors import ArmlinkError
from calib.daemon.environment import Environment
from calib.daemon.observing.observation import Observation
from calib.daemon.settings import Configuration
from calib.daemon.state.arm_state import ArmState
from calib.daemon.state.bus_jobs import BusJobs
from calib.daemon.state.event_log import EventLog
from calib.install.journaled_write import recover
from calib.install.plausibility import GateRefused
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore

RECORDS_SECONDS = 5.0
"""Time between two looks at the record store, where other commands may have made another record current [s]."""

Held = tuple[tuple[float, float, int], ...] | None
"""Gain, offset [N·m] and record id of every controller; None if the daemon only listens."""


class ActiveRecords:
    """Holds the observation against the records in force, and keeps it in step with store and controllers."""

    def __init__(
        self,
        configuration: Configuration,
        environment: Environment,
        store: RecordStore,
        arm_state: ArmState,
        events: EventLog,
        jobs: BusJobs,
        observe: Callable[[CalibrationRecord, GravityRecord], Observation],
    ) -> None:
        """`observe` makes the observation against a pair of records; raises Refused if they are of another arm."""
        self._configuration, self._environment, self._store = configuration, environment, store
        self._arm_state, self._events, self._jobs, self._observe = arm_state, events, jobs, observe
        self.observation: Observation | None = None
        """None until there are both records."""
        self.detail = ""
        """Why there is no observation, or none against the newest records; empty otherwise."""
        self._held: Held = None
        self._unchecked = False
        self._looked = -float("inf")

    def tick(self) -> None:
        """Look at the record store when it is time."""
        if self._jobs.busy:
            return
        if self._unchecked:
            self._check_controllers()
        if self._environment.monotonic() - self._looked >= RECORDS_SECONDS:
            self.load()

    # ---- records

    def load(self) -> None:
        """Take over the records in force; other ones than before begin a new observation."""
        if self._jobs.busy:
            return  # an approval may be about to change them
        self._looked = self._environment.monotonic()
        arm = self._configuration.arm
        try:
            calibration = self._store.current(CalibrationRecord, arm)
            gravity = self._store.current(GravityRecord, arm)
            if calibration is None or gravity is None:
                found = {"calibration": calibration, "gravity": gravity}
                missing = " and ".join(name for name, record in found.items() if record is None)
                of_arm = f"of {arm.name} {arm.serial}"
                self.detail = f"waits for a {missing} record {of_arm}: armlink sweep, calibrate, identify"
                return
            before = self.observation
            if before is not None and before.feed.measures_against(calibration, gravity):
                self.detail = ""
                return
            self.observation = self._observe(calibration, gravity)
        except ArmlinkError as error:
            self.detail = str(error)
            return
        self.detail = ""
        if before is not None:
            evidence = {"calibration": calibration.id, "gravity": gravity.id}
            self._events.say("configuration", None, "other records are in force and observed against now", evidence)
        self._check_controllers()

    def renew(self) -> None:
        """Other thresholds: a new observer against the same records, which continues from the saved state."""
        if self._jobs.busy or self.observation is None:
            return
        feed = self.observation.feed
        self.observation = self._observe(feed.calibration, feed.gravity)
        if self._arm_state.connected and not self._configuration.listen_only:
            self._ask()

    # ---- controllers

    def held(self, held: Held) -> None:
        """The bus is there, and this is what the controllers hold."""
        self._held = held
        self._unchecked = self._jobs.busy
        if self._unchecked:
            return
        if self.observation is not None and self._store.unfinished_write(self._configuration.arm) is not None:
            self._ask()
        else:
            self._compare()

    def _check_controllers(self) -> None:
        self._unchecked = False
        if self._arm_state.connected and not self._configuration.listen_only:
            self._ask()
        else:
            self._compare()

    def _ask(self) -> None:
        """Read what the controllers hold; a write that was interrupted (by a kill, say) is undone before."""
        arm, controllers = self._configuration.arm, self._environment.port.controllers

        def work() -> tuple[bool, Held]:
            undone = recover(arm, self._store, controllers) is not None
            held = [controllers.read_calibration(joint) for joint in range(len(arm.joint_names))]
            return undone, tuple((each.gain, each.offset, each.record_id) for each in held)

        def done(outcome: tuple[bool, Held] | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                self._events.say("fault", None, f"the controllers could not be read: {outcome}", {})
                return
            undone, self._held = outcome
            if undone:
                self._events.say("roll-back", None, "an interrupted write to the controllers was undone", {})
            self._compare()

        self._jobs.start(work, done)

    def _compare(self) -> None:
        """Compare the controllers with the record in force; under the policy apply, write it if they differ."""
        if self.observation is None:
            return
        feed = self.observation.feed
        differ, record, recalibrations = (
            feed.controllers_hold(self._held),
            feed.calibration,
            self.observation.recalibrations,
        )
        if not differ:
            return
        if self._configuration.settings.policy != "apply" or self._configuration.listen_only:
            text = f"{', '.join(differ)}: the controllers hold another calibration than record {record.id}"
            text += "; readings are converted; armlink calibrate --apply writes it"
            self._events.say("configuration", None, text, {"record": record.id, "joints": differ})
            return

        def done(outcome: tuple[str, ...] | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                gate = {"gate": outcome.refusal.name} if isinstance(outcome, GateRefused) else {}
                text = f"record {record.id} is not written: {outcome}"
                self._events.say("refused", None, text, {"record": record.id, "joints": differ, **gate})
                return
            feed.controllers_hold(None)
            recalibrations.restored(outcome)
            evidence = {"record": record.id, "joints": differ, "applied": True, "restored": True}
            text = f"record {record.id} written again to {', '.join(outcome)}"
            self._events.say("recalibration", None, text, evidence)

        self._jobs.start(recalibrations.restore, done)
