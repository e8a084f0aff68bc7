"""The check after a recalibration: at the arm's next rests, do readings fit the model worse than with the old pair?"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armlink.arm_file import ArmFile
from armlink.link.types import Calibration
from calib.arm.kinematics import gcomp_arm
from calib.observer.config import ObserverConfig
from calib.observer.rest_detector import RestDetector
from calib.records.records import Array, CalibrationRecord, GravityRecord
from gcomp.gravity.torque import gravity_torque

ROWS = 12
"""Rests at other poses after which the check decides."""
WORSE = 1.1
"""RMS with the new pair over RMS with the old one from which on it is worse, beside the floor."""
FLOOR = 0.0005
"""Difference in RMS that does not count, as a share of rated torque: half of what one rest's average scatters."""


@dataclass(frozen=True)
class Checked:
    """What the check found."""

    verdict: Literal["kept", "worse"]
    joint: int
    why: str
    """RMS against the model with the old and the new pair, in words."""


class AfterWrite:
    """Feed every sample to `handle`; it moves nothing, so the arm's own work must bring it to other poses."""

    def __init__(
        self,
        arm: ArmFile,
        gravity: GravityRecord,
        record: CalibrationRecord,
        joint: int,
        old: Calibration,
        new: Calibration,
    ) -> None:
        """`old` and `new` are what joint's controller held before and holds since (gain, offset [N·m])."""
        self._arm, self._beta = gcomp_arm(arm), np.array(gravity.require(arm).beta)
        self._position = record.values("position_gain", 1.0), record.values("position_offset", 0.0)
        self._rests = RestDetector(len(record.joints), ObserverConfig())
        self._joint, self._old, self._new = joint, old, new
        self._floor = FLOOR * arm.require_link().joints[joint].rated_torque
        self._name = record.joints[joint].name
        self._rows: list[tuple[float, float]] = []

    def handle(self, t: float, position: Array, torque: Array) -> Checked | None:
        """Take one sample as the controllers send it ((n,), SI); the outcome once there are enough rests, else None."""
        row = self._rests.handle(t, position, torque)
        if row is None:
            return None
        q = row.position * self._position[0] + self._position[1]
        model = float(gravity_torque(self._arm, self._beta, q[None])[0, self._joint])
        sent, old, new = float(row.torque[self._joint]), self._old, self._new
        as_before = (sent * new.gain + new.offset - old.offset) / old.gain
        self._rows.append((as_before - model, sent - model))
        return self._decide() if len(self._rows) >= ROWS else None

    def _decide(self) -> Checked:
        before, after = (float(np.sqrt(np.mean(np.square(column)))) for column in zip(*self._rows, strict=True))
        worse = after > WORSE * before and after - before > self._floor
        why = f"{self._name}: RMS against the model {after:.3f} N·m at {ROWS} rests, {before:.3f} with the old pair"
        return Checked("worse" if worse else "kept", self._joint, why)
