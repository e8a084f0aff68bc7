"""The records in force: taken from the store, compared with what the controllers hold, observed against."""

from typing import TYPE_CHECKING

from armlink.errors import ArmlinkError, Refused
from calib.daemon.observer_feed import Watcher
from calib.daemon.proposal import finding_of
from calib.daemon.recalibration_workflow import Recalibrations
from calib.daemon.service_hooks import Outside
from calib.install.journaled_write import recover
from calib.install.plausibility import GateRefused
from calib.observer.decision import Finding
from calib.records.records import CalibrationRecord, GravityRecord

if TYPE_CHECKING:
    from calib.daemon.service import Service

RECORDS_SECONDS = 5.0
"""The record store is looked at so often: other commands may have put another record in force."""

Held = tuple[tuple[float, float, int], ...] | None
"""Gain, offset [N·m] and record id of every controller; None where it is only listened to."""


class InForce:
    """Keeps a service's watcher and recalibrations to the records in force."""

    def __init__(self, service: "Service") -> None:
        self._service = service
        self._held: Held = None
        self._looked = -float("inf")

    def tick(self, now: float) -> None:
        """Look at the record store when it is time."""
        if now - self._looked >= RECORDS_SECONDS and not self._busy:
            self.load()

    @property
    def _busy(self) -> bool:
        recalibrations = self._service.recalibrations
        return recalibrations is not None and recalibrations.busy

    # ---- records

    def load(self) -> None:
        """Take over the records in force; another one than before begins a new observer."""
        service = self._service
        self._looked = service.around.monotonic()
        try:
            calibration = service.store.current(CalibrationRecord, service.arm)
            gravity = service.store.current(GravityRecord, service.arm)
        except ArmlinkError as error:
            service.detail = str(error)
            return
        if calibration is None or gravity is None:
            found = {"calibration": calibration, "gravity": gravity}
            missing = " and ".join(name for name, record in found.items() if record is None)
            arm = f"{service.arm.name} {service.arm.serial}"
            service.detail = f"waits for a {missing} record of {arm}: armlink sweep, calibrate, identify"
            return
        watcher = service.watcher
        if watcher and (calibration.id, gravity.id) == (watcher.calibration.id, watcher.gravity.id):
            return
        try:
            self._begin(calibration, gravity)
        except Refused as error:
            service.detail = str(error)
            return
        service.detail = ""
        if watcher is not None:
            evidence = {"calibration": calibration.id, "gravity": gravity.id}
            service.say("configuration", None, "other records are in force: observing anew against them", evidence)
        if service.connected and not service.listen_only:
            self._ask()
        else:
            self._compare()

    def observe_anew(self) -> None:
        """Other thresholds: a new observer that goes on from what the old one knows."""
        service = self._service
        if self._busy or service.calibration is None or service.gravity is None:
            return
        service.keeping.keep()
        self._begin(service.calibration, service.gravity)
        if service.connected and not service.listen_only:
            self._ask()

    def _begin(self, calibration: CalibrationRecord, gravity: GravityRecord) -> None:
        service = self._service
        around = service.around
        watcher = Watcher(service.arm, calibration, gravity, service.settings.observer_config())
        recalibrations = Recalibrations(
            service.arm,
            service.settings,
            service.listen_only,
            service.store,
            service.journal,
            around.port.controllers,
            Outside(service.say, around.wall, around.run, self._installed),
        )
        service.watcher, service.recalibrations = watcher, recalibrations
        service.calibration, service.gravity = calibration, gravity
        installed = self._decided(recalibrations, calibration)
        belief = service.journal.belief()
        if belief is None or belief.gravity != gravity.id:
            return
        if belief.calibration == calibration.id:
            watcher.restore(belief.state)
        elif belief.calibration == calibration.parent and installed is not None and watcher.restore(belief.state):
            watcher.observer.install(installed)

    def _decided(self, recalibrations: Recalibrations, calibration: CalibrationRecord) -> Finding | None:
        """What became of approvals that a kill cut off; the finding that led to the record in force, if one did."""
        journal, installed = self._service.journal, None
        for row in journal.proposals():
            if row.record == calibration.id and row.state in ("applied", "approved"):
                installed = finding_of(row.finding)
            if row.state != "approved":
                continue
            if row.record == calibration.id:
                recalibrations.applied(row, row.by or "daemon", calibration, install=False)
            else:
                now = self._service.around.wall()
                journal.decide(row.id, now, "failed", "daemon", "interrupted before it was in force")
        return installed

    def _installed(self, record: CalibrationRecord, finding: Finding) -> None:
        """A finding is in the controller and its record in force."""
        service = self._service
        if service.watcher is None:
            return
        service.calibration = record
        service.watcher.follow(record)
        service.watcher.observer.install(finding)
        service.keeping.keep(history=True)

    # ---- controllers

    def held(self, held: Held) -> None:
        """The bus is there, and this is what the controllers hold."""
        service = self._service
        self._held = held
        if service.recalibrations is not None and service.store.unfinished_write(service.arm) is not None:
            self._ask()
        else:
            self._compare()

    def _ask(self) -> None:
        """Read what the controllers hold; a write that was cut off (by a kill, say) is undone before."""
        service, recalibrations = self._service, self._service.recalibrations
        controllers, count = service.around.port.controllers, len(service.names)
        if recalibrations is None or recalibrations.busy:
            return

        def work() -> tuple[bool, Held]:
            undone = recover(service.arm, service.store, controllers) is not None
            held = [controllers.read_calibration(joint) for joint in range(count)]
            return undone, tuple((each.gain, each.offset, each.record_id) for each in held)

        def done(outcome: tuple[bool, Held] | Exception) -> None:
            recalibrations.busy = False
            if isinstance(outcome, Exception):
                _known(outcome)
                service.say("fault", None, f"the controllers could not be read: {outcome}", {})
                return
            undone, self._held = outcome
            if undone:
                service.say("roll-back", None, "a write to the controllers that was cut off is undone", {})
            self._compare()

        recalibrations.busy = True
        service.around.run(work, done)

    def _compare(self) -> None:
        """What the controllers hold against the record in force; the policy apply writes it where they differ."""
        service, watcher, recalibrations = self._service, self._service.watcher, self._service.recalibrations
        if watcher is None or recalibrations is None:
            return
        differ = watcher.controllers_hold(self._held)
        if not differ:
            return
        record = watcher.calibration
        if service.settings.policy != "apply" or service.listen_only:
            text = f"{', '.join(differ)}: the controllers hold another calibration than record {record.id}"
            text += "; readings are converted; armlink calibrate --apply writes it"
            service.say("configuration", None, text, {"record": record.id, "joints": differ})
            return

        def done(outcome: tuple[str, ...] | Exception) -> None:
            recalibrations.busy = False
            if isinstance(outcome, Exception):
                _known(outcome)
                gate = {"gate": outcome.refusal.name} if isinstance(outcome, GateRefused) else {}
                text = f"record {record.id} is not written: {outcome}"
                service.say("refused", None, text, {"record": record.id, "joints": differ, **gate})
                return
            watcher.controllers_hold(None)
            recalibrations.restored(outcome)
            evidence = {"record": record.id, "joints": differ, "applied": True, "restored": True}
            service.say("recalibration", None, f"record {record.id} written anew to {', '.join(outcome)}", evidence)

        recalibrations.busy = True
        service.around.run(recalibrations.recalibrator.restore, done)


def _known(error: Exception) -> None:
    if not isinstance(error, ArmlinkError):
        raise error
