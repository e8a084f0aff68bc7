"""The records in force: read from the store, compared with what the controllers hold, observed against."""

import logging
from collections.abc import Callable

from armlink.errors import ArmlinkError
from armlink.link.types import Calibration
from calib.daemon.environment import RETRY_SECONDS, BusJobs, Environment
from calib.daemon.observation.observation import ObserverFeed
from calib.daemon.observation.recalibration_workflow import RecalibrationWorkflow
from calib.daemon.settings import Configuration
from calib.daemon.state.arm_state import ArmState
from calib.daemon.state.events import EventLog
from calib.install.journaled_write import recover
from calib.install.plausibility import GateRefused
from calib.records.database import StoreFault, first_line
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import ControllerWrite, RecordStore, way_to

_LOG = logging.getLogger("armlink.daemon")
RECORDS_SECONDS = 5.0
"""Time between two looks at the record store, where other commands may have made another record current [s]. A look
that takes longer shows as a fault: a new connection to a PostgreSQL may take as long (`database.py`)."""

Found = tuple[CalibrationRecord | None, GravityRecord | None]
Held = tuple[Calibration, ...] | None
"""In every controller; None if the daemon only listens."""


class ActiveRecords:
    """Holds the observer of the records in force, and keeps it in step with store and controllers."""

    def __init__(
        self,
        configuration: Configuration,
        environment: Environment,
        store: RecordStore,
        arm_state: ArmState,
        events: EventLog,
        jobs: BusJobs,
        recalibrations: RecalibrationWorkflow,
        observe: Callable[[CalibrationRecord, GravityRecord], ObserverFeed],
    ) -> None:
        """`observe` begins to observe against a pair of records; raises Refused if they are of another arm."""
        self._configuration, self._environment, self._store = configuration, environment, store
        self._arm_state, self._events, self._jobs, self._observe = arm_state, events, jobs, observe
        self._recalibrations = recalibrations
        self.feed: ObserverFeed | None = None
        """The observer against the records in force; None until there are both."""
        self.detail = ""
        """Why there is no observation, or none against the newest records; empty otherwise."""
        self._held: Held = None
        self._unchecked = False
        self._looked, self._looking = -float("inf"), False
        self._store_fault = ""

    @property
    def store_fault(self) -> str:
        """Why the record store cannot be read; empty while it can."""
        waited = self._environment.monotonic() - self._looked if self._looking else 0.0
        if self._store_fault or waited <= RECORDS_SECONDS:
            return self._store_fault
        return f"record store {self._store.url} has not answered for {waited:.0f} s"

    def tick(self) -> None:
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
        if self._looking:
            return  # the store is slow
        arm, store = self._configuration.arm, self._store
        self._looking, self._looked = True, self._environment.monotonic()

        def look() -> Found:
            try:
                return store.current(CalibrationRecord, arm), store.current(GravityRecord, arm)
            except ArmlinkError:
                raise
            except Exception as error:  # whatever the database's driver raises
                raise StoreFault(f"record store {store.url}: {type(error).__name__}: {first_line(error)}") from None

        self._jobs.aside(look, self._found)

    def _found(self, found: Found | ArmlinkError) -> None:
        """Take over what the store has now; while it fails, the records in force stay in force."""
        self._looking = False
        if isinstance(found, StoreFault):
            self._looked = self._environment.monotonic() - RECORDS_SECONDS + RETRY_SECONDS
            if not self._store_fault:
                kept = "" if self.feed is None else "; the current records stay in use"
                self._events.say("fault", None, f"{found}{kept}", {})
            self._store_fault = str(found)
            return
        if self._store_fault:
            self._store_fault = ""
            self._events.say("recovered", None, "the record store answers again", {})
        if self._jobs.busy:
            return
        try:
            if isinstance(found, ArmlinkError):
                raise found
            self._take_over(*found)
        except ArmlinkError as error:
            self.detail = str(error)

    def _take_over(self, calibration: CalibrationRecord | None, gravity: GravityRecord | None) -> None:
        """Observe against these records, if they are other ones; raises Refused if they are of another arm."""
        arm = self._configuration.arm
        if calibration is None or gravity is None:
            found = {"calibration": calibration, "gravity": gravity}
            missing = [name for name, record in found.items() if record is None]
            of_arm = f"of {arm.name} {arm.serial}"
            way = way_to(arm, *missing, listen_only=self._configuration.listen_only)
            waits = f"waits for a {' and '.join(missing)} record {of_arm}: {way}"
            if waits != self.detail:
                _LOG.warning(waits)
            self.detail = waits
            return
        before = self.feed
        if before is not None and before.measures_against(calibration, gravity, arm):
            self.detail = ""
            return
        self.feed = self._observe(calibration, gravity)
        self.detail = ""
        if before is not None:
            evidence = {"calibration": calibration.id, "gravity": gravity.id}
            self._events.say(
                "configuration", None, "other records are now current, and the observer uses them", evidence
            )
        self._check_controllers()

    def renew(self) -> None:
        """Other thresholds: a new observer against the same records, which continues from the saved state."""
        if self._jobs.busy or self.feed is None:
            return
        self.feed = self._observe(self.feed.calibration, self.feed.gravity)
        if self._arm_state.connected and not self._configuration.listen_only:
            self._ask()

    # ---- controllers

    def held(self, held: Held) -> None:
        """The bus is there, and this is what the controllers hold."""
        self._held = held
        self._unchecked = self._jobs.busy
        if self._unchecked:
            return
        if self.feed is None:
            return
        arm, store = self._configuration.arm, self._store
        self._jobs.aside(lambda: store.unfinished_write(arm), self._compare_or_ask)

    def _compare_or_ask(self, unfinished: ControllerWrite | ArmlinkError | None) -> None:
        if self._jobs.busy or isinstance(unfinished, ArmlinkError):
            self._unchecked = True  # later: the job, or the store's failure, comes first
        elif unfinished is not None:
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
            return undone, tuple(controllers.read_calibration(joint) for joint in range(len(arm.joint_names)))

        def done(outcome: tuple[bool, Held] | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                self._events.say("fault", None, f"the calibration in the drives could not be read: {outcome}", {})
                return
            undone, self._held = outcome
            if undone:
                self._events.say("roll-back", None, "an interrupted write to the drives was undone", {})
            self._compare()

        self._jobs.start(work, done)

    def _compare(self) -> None:
        """Compare the controllers with the record in force; under the policy apply, write it if they differ."""
        feed = self.feed
        if feed is None:
            return
        differ, record = feed.controllers_hold(self._held), feed.calibration
        if not differ:
            return
        if self._configuration.settings.policy != "apply" or self._configuration.listen_only:
            text = f"{', '.join(differ)}: the drives hold another calibration than record {record.id}"
            write = f"armlink rollback {self._configuration.arm.argument} --to {record.id} --apply"
            text += f"; the daemon converts their readings; to write the record: {write}"
            self._events.say("configuration", None, text, {"record": record.id, "joints": differ})
            return

        def done(outcome: tuple[str, ...] | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                gate = {"gate": outcome.refusal.name} if isinstance(outcome, GateRefused) else {}
                text = f"record {record.id} was not written: {outcome}"
                self._events.say("refused", None, text, {"record": record.id, "joints": differ, **gate})
                return
            feed.controllers_hold(None)
            self._arm_state.calibrated(outcome)
            evidence = {"record": record.id, "joints": differ, "applied": True, "restored": True}
            text = f"record {record.id} was written again to {', '.join(outcome)}"
            self._events.say("recalibration", None, text, evidence)

        self._jobs.start(self._recalibrations.restore, done)
