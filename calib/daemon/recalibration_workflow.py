"""From findings to records in force: policy, rate limit, approval, write, check, roll-back; every step kept."""

from collections import deque
from collections.abc import Callable
from datetime import datetime
from typing import TypeVar

from armlink.arm_file import ArmFile
from armlink.errors import ArmlinkError, Refused
from calib.daemon.loop.loop_messages import Array
from calib.daemon.proposal import finding_json, finding_of, proposal_answer
from calib.daemon.service_hooks import Outside
from calib.daemon.settings import DaemonSection
from calib.daemon.state.journal import Journal, ProposalRow
from calib.daemon.view.api_models import Proposal
from calib.daemon.view.view import NoSuch, NotPossible
from calib.install.journaled_write import Controllers
from calib.observer.check_at_rests import Checked
from calib.observer.decision import Finding
from calib.observer.recalibrator import APPLIED_BY, Recalibration, Recalibrator
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore

T = TypeVar("T")
DAY = 86400.0
WAITING = 1000
"""Batches that wait for an alarm to be explained: a hundred seconds."""


class Recalibrations:
    """Under one policy, with one set of records; `busy` while something waits for the bus."""

    def __init__(
        self,
        arm: ArmFile,
        settings: DaemonSection,
        listen_only: bool,
        store: RecordStore,
        journal: Journal,
        controllers: Controllers,
        outside: Outside,
    ) -> None:
        """Raises Refused where the arm has no calibration record."""
        self.settings, self.names = settings, arm.joint_names
        self._journal, self._store, self._outside = journal, store, outside
        self._listen_only = listen_only
        self.recalibrator = Recalibrator(arm, controllers, store, "propose")
        self.busy = False
        self._waiting: list[Finding] = []
        self._checking: tuple[str, ...] = ()
        self._unexplained: deque[tuple[Array, Array, Array]] = deque(maxlen=WAITING)

    # ---- what the observer found

    def found(self, finding: Finding) -> None:
        """Make of a finding what the policy says."""
        if self.settings.policy == "observe":
            return
        if self.busy:
            self._waiting.append(finding)
            return
        automatic = self.settings.policy == "apply"
        by, ask = (APPLIED_BY if automatic else None), not self._listen_only or automatic

        def done(outcome: Recalibration | Exception) -> None:
            self.busy = False
            if isinstance(outcome, Exception):
                self._refused(finding, outcome)
            else:
                self._proposed(finding, outcome, automatic)
            self._next()

        self._start(lambda: self.recalibrator.propose(finding, by, ask), done)

    def _proposed(self, finding: Finding, outcome: Recalibration, automatic: bool) -> None:
        joint, record = outcome.joint, outcome.record
        now = self._outside.now()
        with self._journal.transaction():
            number = self._journal.add_proposal(now, joint, record.id, record.parent or "", finding_json(finding))
            std = dict(zip(("gain_std", "offset_std"), finding.std, strict=True))
            evidence = {"proposal": number, "record": record.id, "gain": finding.gain, "offset": finding.offset, **std}
            text = f"{joint}: record {record.id} proposed: gain {outcome.gain:.5f}, offset {outcome.offset:.3f} N·m"
            self._outside.say("proposal", joint, text, evidence)
        if not automatic:
            return
        limit = self._limit(joint, now)
        if limit:
            self._outside.say("undecided", joint, f"{joint}: not written by itself: {limit}", {"proposal": number})
            return
        try:
            self.approve(number, APPLIED_BY)
        except NotPossible as error:
            self._outside.say("refused", joint, f"not recalibrated: {error}", {"proposal": number})

    def _limit(self, joint: str, now: datetime) -> str:
        """Which rate limit forbids to write now, empty where none does; a clock that was set back counts as no time."""
        applied = [row for row in self._journal.proposals() if row.state == "applied" and row.decided is not None]
        ages = [(row.joint, abs((now - row.decided).total_seconds())) for row in applied if row.decided is not None]
        settings = self.settings
        if any(name == joint and age < settings.rest_between_writes for name, age in ages):
            return f"at most one recalibration of a joint in {settings.rest_between_writes:g} s"
        if sum(age < DAY for _, age in ages) >= settings.writes_per_day:
            return f"{settings.writes_per_day} recalibrations in a day already"
        return ""

    # ---- what a person decides

    def approve(self, number: int, by: str) -> Proposal:
        """Write a pending proposal and put it in force; raises NoSuch, NotPossible."""
        row = self._pending(number)
        if self.busy:
            raise NotPossible("another recalibration is under way: try again in a moment")
        if row.base != self.recalibrator.record.id:
            now = self.recalibrator.record.id
            raise NotPossible(f"proposal {number} follows from record {row.base}, but {now} is in force by now")
        with self._journal.transaction():
            self._journal.decide(number, self._outside.now(), "approved", by)
            self._outside.say("approved", row.joint, f"{row.joint}: approved by {by}", {"proposal": number, "by": by})
        finding = finding_of(row.finding)

        def work() -> CalibrationRecord:
            record = self._store.get(row.record)
            assert isinstance(record, CalibrationRecord)
            self.recalibrator.apply(record, finding.joint, by)
            return record

        def done(outcome: CalibrationRecord | Exception) -> None:
            self.busy = False
            if isinstance(outcome, Exception):
                with self._journal.transaction():
                    self._journal.decide(number, self._outside.now(), "failed", "daemon", str(outcome))
                    self._refused(finding, outcome, number)
            else:
                self.applied(row, by, outcome)
            self._next()

        self._start(work, done)
        return proposal_answer(self._row(number))

    def applied(self, row: ProposalRow, by: str, record: CalibrationRecord, install: bool = True) -> None:
        """A proposal is in force: keep and say it; with `install` the observer takes it over too."""
        finding = finding_of(row.finding)
        self._checking = (row.joint,)
        joint = record.joints[finding.joint]
        gain = "as before" if joint.gain is None else f"{joint.gain:.5f}"
        text = f"{row.joint}: record {record.id} in force: gain {gain}, offset {joint.offset or 0.0:.3f} N·m"
        evidence = {"proposal": row.id, "record": record.id, "replaces": row.base, "by": by, "applied": True}
        with self._journal.transaction():
            self._journal.decide(row.id, self._outside.now(), "applied", by)
            self._outside.say("recalibration", row.joint, text, evidence)
            if install:
                self._outside.installed(record, finding)

    def reject(self, number: int, by: str) -> Proposal:
        """Drop a pending proposal; raises NoSuch, NotPossible."""
        row = self._pending(number)
        with self._journal.transaction():
            self._journal.decide(number, self._outside.now(), "rejected", by)
            self._outside.say("rejected", row.joint, f"{row.joint}: rejected by {by}", {"proposal": number, "by": by})
        return proposal_answer(self._row(number))

    # ---- after a write

    def restored(self, joints: tuple[str, ...]) -> None:
        """The current record was written to the controllers of these joints: `watch` checks it."""
        self._checking = joints

    def watch(self, samples: tuple[Array, Array, Array], held: bool) -> None:
        """Give decimated samples to the check after a write; what is worse than before is taken back.

        While an alarm stands (`held`) they wait until its cause is `explained`: a payload says nothing of the sensor.
        """
        if not self._checking or self.busy:
            return
        if held:
            self._unexplained.append(samples)
            return
        self._unexplained.clear()
        self._check(samples)

    def explained(self, kind: str, joint: str | None) -> None:
        """An alarm's cause is known: samples that waited count where it is a drift of the joint just recalibrated."""
        waiting, self._unexplained = list(self._unexplained), deque(maxlen=WAITING)
        if kind != "drift" or joint not in self._checking:
            return
        for samples in waiting:
            self._check(samples)

    def _check(self, samples: tuple[Array, Array, Array]) -> None:
        for t, position, torque in zip(*samples, strict=True):
            checked = self.recalibrator.sample(float(t), position, torque)
            if checked is not None:
                self._checking = ()
                self._checked(checked)
                return

    def _checked(self, checked: Checked) -> None:
        joint = self.names[checked.joint]
        why = checked.why.removeprefix(f"{joint}: ")
        if checked.verdict == "kept":
            self._outside.say("check", joint, f"{joint}: recalibration holds: {why}", {"kept": True})
            return

        def done(outcome: Recalibration | Exception) -> None:
            self.busy = False
            if isinstance(outcome, Exception):
                _known(outcome)
                self._outside.say("refused", joint, f"{joint}: roll-back failed: {outcome}", {})
            else:
                text = f"{joint}: rolled back to record {outcome.record.id}: {why}"
                self._outside.say("roll-back", joint, text, {"record": outcome.record.id, "why": checked.why})
                if outcome.undo is not None:  # else a whole record: the service sees that another one is current
                    self._outside.installed(outcome.record, outcome.undo)
            self._next()

        self._start(lambda: self.recalibrator.undo(checked), done)

    # ---- inside

    def _start(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        self.busy = True
        self._outside.run(work, done)

    def _next(self) -> None:
        if self._waiting and not self.busy:
            self.found(self._waiting.pop(0))

    def _refused(self, finding: Finding, error: Exception, number: int | None = None) -> None:
        _known(error)
        joint = self.names[finding.joint]
        kind = "refused" if isinstance(error, Refused) else "fault"
        evidence = {} if number is None else {"proposal": number}
        self._outside.say(kind, joint, f"not recalibrated: {error}", evidence)

    def _pending(self, number: int) -> ProposalRow:
        row = self._row(number)
        if row.state != "pending":
            raise NotPossible(f"proposal {number} is {row.state} already")
        return row

    def _row(self, number: int) -> ProposalRow:
        row = self._journal.proposal(number)
        if row is None:
            raise NoSuch(f"no proposal {number}")
        return row


def _known(error: Exception) -> None:
    if not isinstance(error, ArmlinkError):
        raise error
