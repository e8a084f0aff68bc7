"""Recalibration: from a finding of the observer to a new record, and from a record to the controllers."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import Calibration
from calib.install.journaled_write import Controllers, install, mend, same_real32
from calib.observer.check_at_rests import AfterWrite, Checked
from calib.observer.decision import Finding
from calib.records.records import Array, CalibrationRecord, GravityRecord, matrix, provenance
from calib.records.store import RecordStore

Policy = Literal["observe", "propose", "apply"]
APPLIED_BY = "observer, policy apply"
CHECKED_BY = "check after recalibration"


@dataclass(frozen=True)
class Plausibility:
    """What a recalibration in the field may change; beyond, the sensor is broken and not drifting."""

    gain: float = 0.1
    """Largest change of a gain against the reference record, as a ratio: 10 % (theory.md section 6)."""
    offset: float = 0.1
    """Largest offset against the reference record's, as a share of rated torque."""


@dataclass(frozen=True)
class Recalibration:
    """What became of a finding."""

    joint: str
    record: CalibrationRecord
    gain: float
    """New gain of the joint."""
    offset: float
    """New offset [N·m]."""
    applied: bool
    undo: Finding | None = None
    """Where an earlier recalibration was taken back: the change that this was, for `Observer.install`."""


def compose(gain: float, offset: float, finding: Finding) -> tuple[float, float]:
    """Gain and offset [N·m] that make a joint right again whose controller holds `gain` and `offset`.

    The sensor gives v = K τ + O and the controller sends u = (v − offset)/gain = g τ + b, where the finding has g and
    b: hence K = gain·g and O = offset + gain·b.
    """
    return gain * finding.gain, offset + gain * finding.offset


def recalibrated(
    record: CalibrationRecord, arm: ArmFile, finding: Finding, installed_gain: float, by: str | None
) -> CalibrationRecord:
    """The record that follows from `record`, installed, and a finding; its covariance is that of both.

    `installed_gain` is what the controller holds where the record has no gain for the joint; the offset alone can then
    be followed. Raises Refused where the record lacks what the finding changes.
    """
    joint = record.joints[finding.joint]
    if joint.offset is None or (joint.gain is None and finding.cause != "offset"):
        raise Refused(f"{joint.name}: record {record.id} has no torque gain and offset to recalibrate: sweep first")
    gain, offset = compose(installed_gain if joint.gain is None else joint.gain, joint.offset, finding)
    joints = list(record.joints)
    joints[finding.joint] = joint.model_copy(update={"gain": None if joint.gain is None else gain, "offset": offset})
    return CalibrationRecord(
        **provenance(arm, record.sources),
        joints=tuple(joints),
        covariance_of=record.covariance_of,
        covariance=matrix(_propagated(record, finding, installed_gain)),
        confirmed_by=by,
        parent=record.id,
        note=f"{joint.name}: {finding.cause} drift found in {finding.rows} poses, confidence {finding.confidence:.3f}",
    )


def check_plausible(
    new: CalibrationRecord, reference: CalibrationRecord, j: int, rated: float, bounds: Plausibility
) -> None:
    """Raise Refused where joint j's new pair is further from the reference record than a drift can be."""
    ours, theirs = new.joints[j], reference.joints[j]
    if ours.gain is not None and theirs.gain is not None and abs(ours.gain / theirs.gain - 1) > bounds.gain:
        raise Refused(
            f"{ours.name}: gain {ours.gain:.4f} is {ours.gain / theirs.gain - 1:+.1%} from record {reference.id},"
            f" at most {bounds.gain:.0%} is drift: check the sensor, then sweep"
        )
    limit = bounds.offset * rated
    if ours.offset is not None and theirs.offset is not None and abs(ours.offset - theirs.offset) > limit:
        raise Refused(
            f"{ours.name}: offset {ours.offset:.3f} N·m is {ours.offset - theirs.offset:+.3f} N·m from record"
            f" {reference.id}, at most {limit:.3f} N·m is drift: check the sensor, then sweep"
        )


class Recalibrator:
    """Turns findings into records under a policy: observe keeps nothing, propose keeps, apply also writes."""

    def __init__(
        self,
        arm: ArmFile,
        controllers: Controllers,
        store: RecordStore,
        policy: Policy,
        bounds: Plausibility | None = None,
    ) -> None:
        """Start from the arm's current calibration record; raises Refused where there is none."""
        current = store.current(CalibrationRecord, arm)
        if current is None:
            raise Refused(f"{arm.name} {arm.serial} has no calibration record yet: run armlink sweep and calibrate")
        self.record = current
        self._arm, self._controllers, self._store, self._policy = arm, controllers, store, policy
        self._bounds = bounds or Plausibility()
        self._reference = self._swept(current)
        self._check: AfterWrite | None = None

    def handle(self, finding: Finding) -> Recalibration | None:
        """Make of a finding what the policy says; None under observe. Raises Refused, as propose and apply do."""
        if self._policy == "observe":
            return None
        apply = self._policy == "apply"
        proposed = self.propose(finding, by=APPLIED_BY if apply else None)
        if not apply:
            return proposed
        self.apply(proposed.record, finding.joint, by=APPLIED_BY)
        return replace(proposed, applied=True)

    def propose(self, finding: Finding, by: str | None = None, ask: bool = True) -> Recalibration:
        """Keep the record that a finding leads to, current nowhere yet; `by` is who confirms it, if anybody does.

        With `ask` the controller is asked what it holds; without, it is taken to hold the current record. Raises
        Refused where the change is implausible, or the controller does not hold what the current record says.
        """
        j = finding.joint
        held = require_installed(self.record, self._controllers, j).gain if ask else 1.0
        new = recalibrated(self.record, self._arm, finding, held, by)
        check_plausible(new, self._reference, j, self._arm.require_link().joints[j].rated_torque, self._bounds)
        gain = float(new.values("gain", missing=held)[j])
        offset = float(new.values("offset")[j])
        self._store.add(new)
        return Recalibration(new.joints[j].name, new, gain, offset, False)

    def apply(self, new: CalibrationRecord, j: int, by: str) -> None:
        """Write joint j of a kept record to its controller and make the record current (`install`).

        From then on `sample` checks it. Raises Refused where the record does not follow from the current one or the
        controller holds something else, BusFault.
        """
        if new.parent != self.record.id:
            raise Refused(f"record {new.id} follows from {new.parent}, but {self.record.id} is current: superseded")
        mend(self._arm, self._store, self._controllers)
        old = require_installed(self.record, self._controllers, j)
        install(new, self._arm, self._store, self._controllers, by=by, reason=new.note, joints=(j,))
        self.record = new
        gravity = self._store.current(GravityRecord, self._arm)
        if gravity is not None:
            held = self._controllers.read_calibration(j)
            self._check = AfterWrite(self._arm, gravity, new, j, old, held)

    def sample(self, t: float, position: Array, torque: Array) -> Checked | None:
        """After `apply`, take each sample (as sent, (n,), SI); the check's outcome once it has its rests, else None.

        Reads and writes nothing; what is worse is taken back by `undo`.
        """
        outcome = None if self._check is None else self._check.handle(t, position, torque)
        if outcome is not None:
            self._check = None
        return outcome

    def undo(self, checked: Checked) -> Recalibration:
        """Take the last recalibration back: the old pair written, its record current again.

        Raises Refused where the current record has none before it, BusFault.
        """
        if self.record.parent is None:
            raise Refused(f"record {self.record.id} has none before it to go back to")
        parent, j = self._store.get(self.record.parent), checked.joint
        assert isinstance(parent, CalibrationRecord)
        mend(self._arm, self._store, self._controllers)
        was = require_installed(self.record, self._controllers, j)
        install(parent, self._arm, self._store, self._controllers, by=CHECKED_BY, reason=checked.why, joints=(j,))
        now = self._controllers.read_calibration(j)
        self.record, self._check = parent, None
        change = Finding(
            j, "drift", now.gain / was.gain, (now.offset - was.offset) / was.gain, np.zeros((2, 2)), 0, 1.0
        )
        return Recalibration(parent.joints[j].name, parent, now.gain, now.offset, applied=True, undo=change)

    def _swept(self, record: CalibrationRecord) -> CalibrationRecord:
        """The last record of this line that the observer did not make: what drift is bounded against."""
        while record.parent is not None and record.confirmed_by == APPLIED_BY:
            parent = self._store.get(record.parent)
            assert isinstance(parent, CalibrationRecord)
            record = parent
        return record


def require_installed(record: CalibrationRecord, controllers: Controllers, j: int) -> Calibration:
    """What joint j's controller holds; raises Refused where that is another pair than the record's."""
    joint, held = record.joints[j], controllers.read_calibration(j)
    for what, wanted, found in (("gain", joint.gain, held.gain), ("offset", joint.offset, held.offset)):
        if wanted is not None and not same_real32(found, wanted):
            raise Refused(
                f"{joint.name}: the controller holds {what} {found:.6g}, record {record.id} has {wanted:.6g}:"
                " write the record first (armlink calibrate --apply)"
            )
    return held


def write_record(record: CalibrationRecord, controllers: Controllers) -> tuple[str, ...]:
    """Write every joint's gain and offset of a record to its controller; returns the joints that were written.

    A gain that is not identifiable stays what the controller holds. Raises BusFault.
    """
    written = []
    for j, joint in enumerate(record.joints):
        held = controllers.read_calibration(j)
        gain = held.gain if joint.gain is None else joint.gain
        offset = held.offset if joint.offset is None else joint.offset
        controllers.write_calibration(j, gain, offset, record.number)
        written.append(joint.name)
    return tuple(written)


def _propagated(record: CalibrationRecord, finding: Finding, installed_gain: float) -> Array:
    """Covariance of K = k g, O = o + k b, the old pair (k, o) and the finding (g, b) being independent."""
    joint = record.joints[finding.joint]
    gain = installed_gain if joint.gain is None else joint.gain
    names = [f"{joint.name}.gain", f"{joint.name}.offset"]
    at = [record.covariance_of.index(name) for name in names if name in record.covariance_of]
    kept = [index for index, name in enumerate(names) if name in record.covariance_of]
    carried = np.eye(len(record.covariance_of))
    of_old = np.array([[finding.gain, 0.0], [finding.offset, 1.0]])
    carried[np.ix_(at, at)] = of_old[np.ix_(kept, kept)]
    covariance: Array = carried @ np.array(record.covariance).reshape(carried.shape) @ carried.T
    covariance[np.ix_(at, at)] += (gain**2 * finding.covariance)[np.ix_(kept, kept)]
    return covariance
