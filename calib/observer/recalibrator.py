"""Recalibration: from a finding to a record, from a record to the controllers, and the check after it.

The check: at the arm's next rests, does the model fit worse than with the old calibration?
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import Calibration, Controllers
from armlink.torque_calibration import TorqueCalibration, same_real32
from calib.arm.kinematics import gcomp_arm
from calib.install.check_motion import WORSE
from calib.install.journaled_write import install, recover
from calib.install.plausibility import Admitted, admit, admit_drift, admit_rollback
from calib.observer.config import ObserverConfig
from calib.observer.decision import DriftFinding
from calib.observer.row_makers import RestDetector
from calib.records.records import CalibrationRecord, GravityRecord, matrix, provenance
from calib.records.store import RecordStore
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque

ROWS = 12
"""Rests at other poses after which the check decides. An RMS of so few is known to ± 20 % (1/√(2 · 12)), but both RMS
are of the same rests."""


@dataclass(frozen=True)
class Checked:
    verdict: Literal["kept", "worse"]
    joint: int
    """Joint with the largest increase of RMS, or the smallest decrease."""
    why: str
    """RMS against the model with the old and the new calibration, in words."""


class AfterWrite:
    """Check at rests of the arm's own work: feed every sample to `handle`. It moves nothing itself."""

    def __init__(
        self,
        arm: ArmFile,
        gravity: GravityRecord,
        record: CalibrationRecord,
        old: Mapping[int, TorqueCalibration[float]],
        new: Mapping[int, TorqueCalibration[float]],
    ) -> None:
        """`old` and `new`: calibrations of the joints written, before and after. Raises Refused for another arm."""
        self._arm, self._beta = gcomp_arm(arm), np.array(gravity.carrying(arm).beta)
        self._record = record
        config = ObserverConfig()
        self._rests = RestDetector(len(record.joints), config)
        self._joints, self._names = list(old), [record.joints[j].name for j in old]
        self._pairs = [(old[j], new[j]) for j in old]
        self._floor = config.noise_share / 2 * arm.require_link().rated_torques[self._joints]
        """Difference in RMS that does not count [N·m]: half of the scatter of one rest's average."""
        self._before: list[list[float]] = []
        self._after: list[list[float]] = []

    def handle(self, t: float, position: Array, torque: Array) -> Checked | None:
        """Take one sample as the controllers send it ((n,), SI); the outcome once there are enough rests, else None."""
        rows = self._rests.handle(t, position, torque)
        if not rows:
            return None
        (row,) = rows
        model = gravity_torque(self._arm, self._beta, self._record.angle(row.position)[None])[0, self._joints].tolist()
        sent = row.torque[self._joints].tolist()
        as_before = [old.invert(new.apply(now)) for (old, new), now in zip(self._pairs, sent, strict=True)]
        self._before.append([value - at for value, at in zip(as_before, model, strict=True)])
        self._after.append([value - at for value, at in zip(sent, model, strict=True)])
        return self._decide() if len(self._after) >= ROWS else None

    def _decide(self) -> Checked:
        before, after = (np.sqrt(np.mean(np.square(rows), axis=0)) for rows in (self._before, self._after))
        worse = (after > WORSE * before) & (after - before > self._floor)
        counted = worse if worse.any() else np.ones(len(worse), dtype=bool)
        k = int(np.argmax(np.where(counted, (after - before) / self._floor, -np.inf)))
        why = (
            f"{self._names[k]}: RMS difference between sensor and model at {ROWS} rests: {after[k]:.3f} N·m "
            f"with the new gain and offset, {before[k]:.3f} N·m with the old gain and offset"
        )
        return Checked("worse" if worse.any() else "kept", self._joints[k], why)


APPLIED_BY = "observer, policy apply"
CHECKED_BY = "check after recalibration"
RESTORED_BY = "daemon, policy apply"


@dataclass(frozen=True)
class Recalibration:
    joint: str
    record: CalibrationRecord
    gain: float
    """New gain of the joint."""
    offset: float
    """New offset [N·m]."""
    undo: DriftFinding | None = None
    """After a roll-back of one joint: the change of its sensor, for `Observer.install`; None for a whole record."""


def recalibrated_record(
    record: CalibrationRecord, arm: ArmFile, finding: DriftFinding, installed_gain: float, by: str | None
) -> CalibrationRecord:
    """The record that follows from `record`, installed, and a finding; its covariance is that of both.

    `installed_gain` is what the controller holds if the record has no gain for the joint; only the offset can then be
    followed. Raises Refused if the record lacks what the finding changes.
    """
    joint = record.joints[finding.joint]
    if joint.offset is None or (joint.gain is None and finding.cause != "offset"):
        raise Refused(
            f"{joint.name}: record {record.id} has no torque gain and offset to recalibrate: both come from a "
            "calibration by sweeps"
        )
    installed = joint.torque_calibration(TorqueCalibration(installed_gain, joint.offset))
    new = installed.compose(finding.change)
    values = {"gain": None if joint.gain is None else new.gain, "offset": new.offset}
    joints = list(record.joints)
    joints[finding.joint] = joint.model_copy(update=values)
    return CalibrationRecord(
        **provenance(arm, record.sources),
        joints=tuple(joints),
        drives=record.drives,
        covariance_of=record.covariance_of,
        covariance=matrix(_propagated(record, finding, installed.gain)),
        confirmed_by=by,
        parent=record.id,
        note=f"{joint.name}: a drift of the {finding.cause} was found in {finding.rows} poses, with confidence "
        f"{finding.confidence:.3f}",
    )


class Recalibrator:
    def __init__(
        self, arm: ArmFile, controllers: Controllers, store: RecordStore, current: CalibrationRecord | None = None
    ) -> None:
        """Start from the arm's current calibration record (default: as the store has it); raises Refused if none is."""
        current = current or store.required(CalibrationRecord, arm)
        self.record = current
        self._arm, self._controllers, self._store = arm, controllers, store
        self._reference = self._swept(current)
        self._before = current.parent
        """Id of the record that `undo` goes back to."""
        self._written: tuple[int, ...] = ()
        """Joints of the last write."""
        self._check: AfterWrite | None = None

    @property
    def checking(self) -> tuple[int, ...]:
        """Joints of the last write, while `sample` checks it."""
        return () if self._check is None else self._written

    def recalibrate(self, finding: DriftFinding) -> Recalibration:
        """Propose and apply at once. Raises Refused, BusFault."""
        proposed = self.propose(finding, by=APPLIED_BY)
        self.apply(proposed.record, finding.joint, by=APPLIED_BY)
        return proposed

    def propose(self, finding: DriftFinding, by: str | None = None, ask: bool = True) -> Recalibration:
        """Keep the record that a finding leads to, without making it current; `by` is who confirms it, if anybody does.

        With `ask` the controller's calibration is read; without, it is taken to be the current record's. Raises Refused
        if the change is implausible, or the controller's calibration is not the current record's.
        """
        j = finding.joint
        held = require_installed(self.record, self._controllers, j) if ask else Calibration(1.0, 0.0)
        new = recalibrated_record(self.record, self._arm, finding, held.gain, by)
        admit_drift(new, self._reference, j, self._arm)
        self._store.add(new)
        pair = new.joints[j].torque_calibration(held)
        return Recalibration(new.joints[j].name, new, pair.gain, pair.offset)

    def apply(self, new: CalibrationRecord, j: int, by: str) -> None:
        """Write joint j of a kept record to its controller and make the record current.

        From then on `sample` checks it. Raises Refused if the record does not follow from the current one, a gate
        refuses it, or the controller's calibration is not the current record's; BusFault.
        """
        if new.parent != self.record.id:
            raise Refused(
                f"record {new.id} is based on record {new.parent}, but record {self.record.id} is current now: "
                f"{new.id} is superseded"
            )
        self._require_current()
        recover(self._arm, self._store, self._controllers)
        old = require_installed(self.record, self._controllers, j)
        admitted = admit_drift(new, self._reference, j, self._arm)
        check = self._check_of(new, {j: old})
        self._install(admitted, by, new.note, (j,))
        self.record, self._before, self._written, self._check = new, self.record.id, (j,), check

    def restore(self) -> tuple[str, ...]:
        """Write the whole current record to controllers that hold something else; returns the joints written.

        If another record was installed before, `sample` checks from then on. Raises Refused if a gate refuses the
        record, BusFault.
        """
        recover(self._arm, self._store, self._controllers)
        held = [self._controllers.read_calibration(j) for j in range(len(self.record.joints))]
        admitted = admit(self.record, self._arm, self._store, held=held)
        check = self._check_of(self.record, dict(enumerate(held)))
        written = self._install(admitted, RESTORED_BY, "the drives held another calibration")
        if admitted.before is not None:
            self._before, self._written, self._check = admitted.before.id, tuple(range(len(held))), check
        return written

    def sample(self, t: float, position: Array, torque: Array) -> Checked | None:
        """After a write, take each sample (as sent, (n,), SI); the check's outcome once it has its rests, else None.

        Reads and writes nothing; what is worse is rolled back by `undo`.
        """
        outcome = None if self._check is None else self._check.handle(t, position, torque)
        if outcome is not None:
            self._check = None
        return outcome

    def undo(self, checked: Checked) -> Recalibration:
        """Roll the last write back: the old calibration written, its record current again.

        Raises Refused if there is no record to go back to, BusFault.
        """
        if self._before is None:
            raise Refused(f"record {self.record.id} is the first of this arm, and stays current: calibrate again")
        parent, j, joints = self._store.get(self._before), checked.joint, self._written or (checked.joint,)
        assert isinstance(parent, CalibrationRecord)
        recover(self._arm, self._store, self._controllers)
        held = {joint: require_installed(self.record, self._controllers, joint) for joint in joints}
        admitted = admit_rollback(parent, self._arm, self._store, held)
        self._install(admitted, CHECKED_BY, checked.why, joints)
        now = parent.joints[j].torque_calibration(held[j])
        change = now.relative_to(held[j])
        undo = DriftFinding(j, "drift", change.gain, change.offset, np.zeros((2, 2)), 0, 1.0)
        self.record, self._before, self._written, self._check = parent, parent.parent, (), None
        whole = len(joints) > 1
        name = parent.joints[j].name
        return Recalibration(name, parent, now.gain, now.offset, None if whole else undo)

    def _require_current(self) -> None:
        """Raise Refused where the store has another record current than the one that is followed: it was exchanged, or
        somebody else has just made another one current."""
        current = self._store.current(CalibrationRecord, self._arm)
        if current is None or current.id != self.record.id:
            now = "none" if current is None else current.id
            raise Refused(
                f"record {self.record.id} is superseded: it is not current in {self._store.url} any more ({now} is)"
            )

    def _install(
        self, admitted: Admitted, by: str, reason: str, joints: Sequence[int] | None = None
    ) -> tuple[str, ...]:
        """Write without a check: it is made at the rests that follow, by `sample`, since nothing here may move."""
        return install(admitted, self._store, self._controllers, by=by, reason=reason, joints=joints, check=None)

    def _check_of(self, record: CalibrationRecord, old: Mapping[int, Calibration]) -> AfterWrite | None:
        """The check of a record against `old`, what the controllers hold before; None without a gravity record.

        Made before the write: nothing that could fail comes after it.
        """
        gravity = self._store.current(GravityRecord, self._arm)
        if gravity is None:
            return None
        new = {j: record.joints[j].torque_calibration(held) for j, held in old.items()}
        return AfterWrite(self._arm, gravity, record, old, new)

    def _swept(self, record: CalibrationRecord) -> CalibrationRecord:
        """The last record of this line that the observer did not make: what drift is bounded against."""
        while record.parent is not None and record.confirmed_by == APPLIED_BY:
            parent = self._store.get(record.parent)
            assert isinstance(parent, CalibrationRecord)
            record = parent
        return record


def require_installed(record: CalibrationRecord, controllers: Controllers, j: int) -> Calibration:
    """The calibration in joint j's controller; raises Refused if it is not the record's."""
    joint, held = record.joints[j], controllers.read_calibration(j)
    wanted = joint.torque_calibration(held)
    for what, value, found in (("gain", wanted.gain, held.gain), ("offset", wanted.offset, held.offset)):
        if not same_real32(value, found):
            raise Refused(
                f"{joint.name}: the drive holds {what} {found:.6g}, but record {record.id} has {value:.6g}: "
                "write the record to the drives first"
            )
    return held


def _propagated(record: CalibrationRecord, finding: DriftFinding, installed_gain: float) -> Array:
    """Covariance of K = k g, O = o + k b, the old pair (k, o) and the finding (g, b) being independent."""
    joint = record.joints[finding.joint]
    names = [f"{joint.name}.gain", f"{joint.name}.offset"]
    at = [record.covariance_of.index(name) for name in names if name in record.covariance_of]
    kept = [index for index, name in enumerate(names) if name in record.covariance_of]
    carried = np.eye(len(record.covariance_of))
    of_old = np.array([[finding.gain, 0.0], [finding.offset, 1.0]])
    carried[np.ix_(at, at)] = of_old[np.ix_(kept, kept)]
    covariance: Array = carried @ np.array(record.covariance).reshape(carried.shape) @ carried.T
    covariance[np.ix_(at, at)] += (installed_gain**2 * finding.covariance)[np.ix_(kept, kept)]
    return covariance
