"""From findings to calibrations in the controllers: policy, rate limit, approval, write, check, roll-back."""

import sqlite3
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future

from armlink.errors import ArmlinkError, BusFault, Refused
from armlink.loop.messages import BATCH_SECONDS
from calib.daemon.environment import BusJobs
from calib.daemon.settings import Configuration
from calib.daemon.state.arm_state import ArmState
from calib.daemon.state.events import EventLog
from calib.daemon.state.journal import Journal
from calib.daemon.state.journal_rows import ProposalRow
from calib.daemon.view import NoSuch, NotPossible, Proposal
from calib.observer.decision import DriftFinding
from calib.observer.recalibrator import APPLIED_BY, Checked, Recalibration, Recalibrator
from calib.records.database import StoreFault
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from gcomp.arrays import Array

Samples = tuple[Array, Array, Array]
"""t (K,) [s], position (K, n) [rad], torque (K, n) [N·m]."""
Installed = Callable[[CalibrationRecord, DriftFinding], None]

DAY = 86400.0
WAITING = round(100 / BATCH_SECONDS)
"""Batches that wait for an alarm to be explained: 100 s; a cause test takes 40 s (`ObserverConfig.window`)."""


class RecalibrationWorkflow:
    """Carries proposals through, one at a time; every step is kept in the journal."""

    def __init__(
        self,
        configuration: Configuration,
        store: RecordStore,
        arm_state: ArmState,
        journal: Journal,
        events: EventLog,
        jobs: BusJobs,
        monotonic: Callable[[], float],
    ) -> None:
        """`monotonic`: the clock of the rate limits [s]."""
        self._configuration, self._names = configuration, configuration.names
        self._store, self._arm_state = store, arm_state
        self._journal, self._events, self._jobs = journal, events, jobs
        self._recalibrator: Recalibrator | None = None
        self._installed: Installed = lambda record, finding: None
        self._waiting: list[DriftFinding] = []
        self._monotonic = monotonic
        self._written = _earlier_writes(journal, monotonic())
        """Joint and time of every write, by the monotonic clock [s]."""
        self._approved: deque[tuple[ProposalRow, str]] = deque()
        """Proposals whose approval is on disk, by whom: written as soon as no other job is under way."""
        self._worse: Checked | None = None
        """A write that made the readings worse and could not be taken back yet."""
        self._unexplained: deque[Samples] = deque(maxlen=WAITING)

    def begin(self, recalibrator: Recalibrator, installed: Installed) -> DriftFinding | None:
        """Follow other records from now on; approvals that a kill interrupted are closed.

        `installed` is called with each record that becomes current, once its finding is written. Returns the finding
        that led to the record now in force, if one did.
        """
        self._recalibrator, self._installed = recalibrator, installed
        self._waiting, self._unexplained = [], deque(maxlen=WAITING)
        self._worse = None
        current, last = recalibrator.record, None
        for row in self._journal.proposals():
            proposal = row.proposal
            if proposal.record == current.id and proposal.state in ("applied", "approved"):
                last = row.finding
            if proposal.state != "approved" or row.id in self._journal.deciding:
                continue
            if proposal.record == current.id:
                self._written.append((proposal.joint, self._monotonic()))
                with self._journal.transaction():
                    self._applied(row, proposal.decided_by or "daemon", current)
            else:
                note = "interrupted before it became current"
                self._journal.decide(row.id, self._events.now(), "failed", "daemon", note)
        return last

    # ---- what the observer found

    def found(self, finding: DriftFinding) -> None:
        policy = self._configuration.settings.policy
        if policy == "observe":
            return
        if self._jobs.busy or not self._may_propose:
            self._waiting.append(finding)
            return
        recalibrator, automatic = self._active(), policy == "apply"
        by, ask = (APPLIED_BY if automatic else None), not self._configuration.listen_only or automatic

        def done(outcome: Recalibration | ArmlinkError) -> None:
            if isinstance(outcome, StoreFault):
                self._waiting.append(finding)
                return
            if isinstance(outcome, ArmlinkError):
                self._refused(finding, outcome)
            else:
                self._proposed(finding, outcome, automatic)
            self._next()

        self._jobs.start(lambda: recalibrator.propose(finding, by, ask), done)

    def _proposed(self, finding: DriftFinding, outcome: Recalibration, automatic: bool) -> None:
        joint, record = outcome.joint, outcome.record
        now = self._events.now()
        with self._journal.transaction():
            added = self._journal.add_proposal(now, joint, record.id, record.parent or "", finding)
            std = dict(zip(("gain_std", "offset_std"), finding.std, strict=True))
            named = {"proposal": record.number, "record": record.id}
            evidence = {**named, "gain": finding.gain, "offset": finding.offset, **std}
            text = (
                f"{joint}: record {record.id} is proposed with gain {outcome.gain:.5f} and offset "
                f"{outcome.offset:.3f} N·m"
            )
            self._events.say("proposal", joint, text, evidence)
            if automatic:
                self._journal.once_kept(lambda: self._write_automatically(added))

    def _write_automatically(self, added: int) -> None:
        row = self._journal.proposal(added)
        if row is None:  # the journal was begun anew meanwhile
            return
        joint, evidence = row.proposal.joint, {"proposal": row.proposal.id}
        limit = self._limit(joint)
        if limit:
            self._events.say(
                "undecided", joint, f"{joint}: the proposal was not written automatically: {limit}", evidence
            )
            return
        try:
            self._write(row, APPLIED_BY)
        except NotPossible as error:
            self._events.say("refused", joint, f"the joint was not recalibrated: {error}", evidence)

    def _limit(self, joint: str) -> str:
        """The rate limit that forbids a write now, empty if none does; by the monotonic clock, over restarts too."""
        settings, now = self._configuration.settings, self._monotonic()
        ages = [(name, now - t) for name, t in self._written]
        if any(name == joint and age < settings.rest_between_writes for name, age in ages):
            return f"a joint may be recalibrated only once in {settings.rest_between_writes:g} s"
        if sum(age < DAY for _, age in ages) >= settings.writes_per_day:
            return f"only {settings.writes_per_day} recalibrations are allowed within a day"
        if any(name is None and age < DAY for name, age in ages):
            return "a damaged journal was set aside less than a day ago, so it is not known what was written before"
        return ""

    # ---- what a person decides

    def approve(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Write a pending proposal and make its record current; raises NoSuch, NotPossible, sqlite3.Error.

        `digest`, if given, must be that of the proposal: what was looked at is then what is decided.
        """
        row = self._named(number, digest)
        if not self._arm_state.connected:
            reason = self._arm_state.fault or "starting"
            raise NotPossible(f"the bus is not connected ({reason}): nothing can be written")
        self._journal.require_writable()
        return self._write(row, by)

    def _write(self, row: ProposalRow, by: str) -> Future[Proposal]:
        """Keep the approval on disk first, then write."""
        current, number, base = self._active().record.id, row.proposal.id, row.proposal.base
        self._require_pending(row)
        if self._jobs.busy or self._approved:
            raise NotPossible("another recalibration is under way: try again in a moment")
        if base != current:
            raise NotPossible(f"proposal {number} is based on record {base}, but record {current} is current now")

        def approved() -> None:
            self._approved.append((row, by))
            self._next()

        return self._decide(row, "approved", by, approved)

    def _decide(
        self, row: ProposalRow, state: str, by: str, then: Callable[[], None] = lambda: None
    ) -> Future[Proposal]:
        """Keep a person's decision, then do what follows from it; the answer is there once it is on disk."""
        answer: Future[Proposal] = Future()
        number, joint = row.proposal.id, row.proposal.joint

        def kept() -> None:
            if not self._has(row):
                gone = f"there is no proposal {number} any more: the journal was damaged and replaced"
                answer.set_exception(NoSuch(gone))
                return
            then()
            answer.set_result(self._named(number).proposal)

        with self._journal.transaction():
            self._journal.decide(row.id, self._events.now(), state, by)
            self._events.say(state, joint, f"{joint}: {state} by {by}", {"proposal": number, "by": by})
            self._journal.once_kept(kept)
        return answer

    def _begin_write(self, row: ProposalRow, by: str) -> None:
        recalibrator, joint = self._active(), self._names.index(row.proposal.joint)
        current = recalibrator.record.id
        if row.proposal.base != current:
            self._keep_failure(row, Refused(f"record {current} became current before the proposed record was written"))
            return

        def work() -> CalibrationRecord:
            record = self._store.get(row.proposal.record)
            assert isinstance(record, CalibrationRecord)
            recalibrator.apply(record, joint, by)
            return record

        def done(outcome: CalibrationRecord | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                again = isinstance(outcome, StoreFault) and by == APPLIED_BY
                if again:
                    self._waiting.append(row.finding)  # to be proposed once the store answers
                self._keep_failure(row, outcome)
                if again:
                    return
            else:
                self._written.append((row.proposal.joint, self._monotonic()))
                self._installed(outcome, row.finding)
                self._forget(joint)
                with self._journal.transaction():
                    self._applied(row, by, outcome)
            self._next()

        self._jobs.start(work, done)

    def reject(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Drop a pending proposal; raises NoSuch, NotPossible, sqlite3.Error. `digest` as for `approve`."""
        row = self._named(number, digest)
        self._active()
        self._journal.require_writable()
        self._require_pending(row)
        return self._decide(row, "rejected", by)

    def _require_pending(self, row: ProposalRow) -> None:
        if row.proposal.state != "pending":
            raise NotPossible(f"proposal {row.proposal.id} is already {row.proposal.state}")
        if row.id in self._journal.deciding:
            raise NotPossible(f"proposal {row.proposal.id} is already decided; the decision waits for the disk")

    # ---- after a write

    def _keep_failure(self, row: ProposalRow, error: ArmlinkError) -> None:
        with self._journal.transaction():
            self._decided(row, "failed", "daemon", str(error))
            self._refused(row.finding, error, row.proposal.id)

    def _decided(self, row: ProposalRow, state: str, by: str, note: str = "") -> None:
        """Keep a decision, unless the journal was begun anew since and has no such proposal."""
        if self._has(row):
            self._journal.decide(row.id, self._events.now(), state, by, note)

    def _has(self, row: ProposalRow) -> bool:
        """Whether the journal still has this proposal; one that is begun anew gives its id to another."""
        kept = self._journal.proposal(row.id)
        return kept is not None and kept.proposal.record == row.proposal.record

    def _applied(self, row: ProposalRow, by: str, record: CalibrationRecord) -> None:
        """Keep and report that a proposal's record is current."""
        joint, values, number = row.proposal.joint, record.joints[row.finding.joint], row.proposal.id
        gain = "as before" if values.gain is None else f"{values.gain:.5f}"
        text = f"{joint}: record {record.id} is current: gain {gain}, offset {values.offset or 0.0:.3f} N·m"
        evidence = {"proposal": number, "record": record.id, "replaces": row.proposal.base, "by": by, "applied": True}
        self._decided(row, "applied", by)
        self._events.say("recalibration", joint, text, evidence)

    def restore(self) -> tuple[str, ...]:
        """Write the current record to controllers that hold another calibration; returns the joints written."""
        return self._active().restore()

    def watch(self, samples: Samples, held: bool) -> None:
        """Give decimated samples to the check after a write; a write that made the readings worse is taken back.

        While an alarm is open (`held`) they wait until its cause is `explained`: a payload says nothing of the sensor.
        """
        if self._jobs.busy or not self._active().checking:
            return
        if held:
            self._unexplained.append(samples)
            return
        self._unexplained.clear()
        self._check(samples)

    def explained(self, kind: str, joint: str | None) -> None:
        """An alarm's cause is known: samples that waited count if it is a drift of the joint just recalibrated."""
        waiting, self._unexplained = list(self._unexplained), deque(maxlen=WAITING)
        if kind != "drift" or joint not in [self._names[j] for j in self._active().checking]:
            return
        for samples in waiting:
            self._check(samples)

    def _check(self, samples: Samples) -> None:
        for t, position, torque in zip(*samples, strict=True):
            checked = self._active().sample(float(t), position, torque)
            if checked is not None:
                self._checked(checked)
                return

    def _checked(self, checked: Checked) -> None:
        if checked.verdict == "worse":
            self._take_back(checked)
            return
        joint = self._names[checked.joint]
        why = checked.why.removeprefix(f"{joint}: ")
        self._events.say("check", joint, f"{joint}: the recalibration is confirmed: {why}", {"kept": True})

    def _take_back(self, checked: Checked) -> None:
        """Roll the last write back; where store or bus fail, again later."""
        joint, again, recalibrator = self._names[checked.joint], self._worse is not None, self._active()
        self._worse = checked

        def done(outcome: Recalibration | ArmlinkError) -> None:
            if isinstance(outcome, ArmlinkError):
                if not isinstance(outcome, StoreFault | BusFault):
                    self._worse = None
                if not again or self._worse is None:
                    self._events.say("refused", joint, f"{joint}: the roll-back failed: {outcome}", {})
            else:
                self._worse = None
                self._forget(checked.joint)
                text = f"{joint}: rolled back to record {outcome.record.id}: {checked.why.removeprefix(f'{joint}: ')}"
                self._events.say("roll-back", joint, text, {"record": outcome.record.id, "why": checked.why})
                if outcome.undo is not None:  # else a whole record: the service sees that another one is current
                    self._installed(outcome.record, outcome.undo)
            self._next()

        self._jobs.start(lambda: recalibrator.undo(checked), done)

    # ---- inside

    def tick(self) -> None:
        """Go on with a roll-back, approvals and findings that waited for the journal, a job or the record store."""
        if self._worse is not None and self._arm_state.connected and not self._jobs.busy:
            self._take_back(self._worse)
        self._next()

    def _forget(self, joint: int) -> None:
        """Another pair is in force for a joint: findings about it that wait are of the pair before."""
        self._waiting = [finding for finding in self._waiting if finding.joint != joint]

    @property
    def _may_propose(self) -> bool:
        """Nothing is proposed, and so nothing written, while something decided before is open or cannot be kept."""
        return self._worse is None and not (self._approved or self._journal.trouble or self._journal.deciding)

    def _next(self) -> None:
        if self._jobs.busy:
            return
        if self._approved:
            self._begin_write(*self._approved.popleft())
        elif self._waiting and self._may_propose:
            self.found(self._waiting.pop(0))

    def _refused(self, finding: DriftFinding, error: ArmlinkError, number: int | None = None) -> None:
        joint = self._names[finding.joint]
        kind = "refused" if isinstance(error, Refused) else "fault"
        evidence = {} if number is None else {"proposal": number}
        self._events.say(kind, joint, f"the joint was not recalibrated: {error}", evidence)

    def _active(self) -> Recalibrator:
        if self._recalibrator is None:
            raise NotPossible(
                "there are no current calibration and gravity records yet: the status says what is missing"
            )
        return self._recalibrator

    def _named(self, number: int, digest: str | None = None) -> ProposalRow:
        """The proposal of that number; raises NoSuch, and NotPossible where it is not the one of that digest."""
        row = self._journal.proposal_numbered(number)
        if row is None:
            raise NoSuch(f"there is no proposal {number}: /api/proposals lists the present proposals")
        if digest is not None and digest != row.proposal.hash:
            raise NotPossible(
                f"proposal {number} does not have the hash {digest[:12]}…: look at the proposal again, then decide"
            )
        return row


def _earlier_writes(journal: Journal, now: float) -> list[tuple[str | None, float]]:
    """Joint and time [s] of the proposals that earlier processes wrote, as young as they may be.

    Where a damaged journal was set aside nobody knows what was written before: that is an entry without a joint.
    """
    try:
        written, faults = (journal.least_ages(kind, now) for kind in ("recalibration", "fault"))
    except sqlite3.Error:
        return [(None, now)]
    found = [(joint, now - age) for joint, evidence, age in written if "proposal" in evidence]
    unknown = [(None, now - age) for _, evidence, age in faults if "file" in evidence]
    return [*found, *unknown, *([(None, now)] if journal.set_aside else [])]
