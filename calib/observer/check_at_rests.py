"""The check after a recalibration: at the arm's next rests, does the model fit worse than with the old calibration?"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armlink.arm_file import ArmFile
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.install.check_motion import WORSE
from calib.observer.config import ObserverConfig
from calib.observer.rest_detector import RestDetector
from calib.records.records import CalibrationRecord, GravityRecord
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
        row = self._rests.handle(t, position, torque)
        if row is None:
            return None
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
