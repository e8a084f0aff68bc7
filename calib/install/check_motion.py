"""The check after a calibration was written: a small motion before and after, and what is worse afterwards.

Each joint goes at most `AMPLITUDE` from where it stands, all stay `MARGIN` from their stops, and the arm returns to
where it was. Two things are judged: whether every controller now sends what its new pair makes of the old readings,
and, where there is a gravity model, whether readings fit it worse than before.
"""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.link import Link
from armlink.link.types import Calibration
from calib.arm.drive_limits import Limits
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Mover, Stalled
from calib.motion.static_reading import StaticReading, stack
from calib.records.records import Array, CalibrationRecord
from gcomp.gravity.torque import gravity_torque

AMPLITUDE = 0.2
"""Largest way of a joint from where it stands [rad]."""
MARGIN = 0.1
"""Distance kept from the stops [rad]; a joint nearer to one moves away from it."""
SPEED = 0.3
"""Share of each joint's largest velocity."""
ACCELERATION = 1.0
"""[rad/s²]"""
POSES = 4
FLOOR = 0.004
"""Difference of readings or of RMS that does not count, as a share of rated torque: friction of the drives' servo that
holds a joint a little elsewhere the second time, and the torque noise."""
WORSE = 1.1
"""RMS against the model afterwards over before from which on it is worse, beside the floor."""


class CheckMotion:
    """The same small motion before and after a write; the link must have been enabled."""

    def __init__(self, link: Link, arm: ArmFile, record: CalibrationRecord, beta: Array | None) -> None:
        """Where the arm stands now is its middle; `beta` (2n,) [kg·m] is None where no gravity model is known."""
        self._link, self._arm, self._record, self._beta = link, arm, record, beta
        self._limits, self._names = Limits.of(arm), arm.joint_names
        self._installed: list[Calibration] = []
        self._before: list[StaticReading] = []
        self._poses: Array = np.empty((0, link.n))

    def before(self) -> None:
        """Make the motion and keep its readings; raises Refused where the arm cannot move, BusFault."""
        self._installed = [self._link.read_calibration(joint) for joint in range(self._link.n)]
        mover = self._mover()
        self._poses = check_poses(mover.position, self._limits)
        self._before = self._run(mover)

    def after(self) -> str | None:
        """Make it again: what is worse now, None where nothing is; raises Refused, BusFault."""
        assert self._before
        old = self._installed
        new = [self._link.read_calibration(joint) for joint in range(self._link.n)]
        readings = self._run(self._mover())
        return self._not_converted(readings, old, new) or self._fits_worse(readings)

    def _mover(self) -> Mover:
        mover = Mover(self._link, sweep_section(self._arm), self._limits)
        mover.hold_all()
        mover.speed = SPEED * self._limits.speed
        return mover

    def _run(self, mover: Mover) -> list[StaticReading]:
        begin, readings = mover.position.copy(), list[StaticReading]()
        try:
            for pose in self._poses:
                mover.travel(pose, ACCELERATION)
                readings.append(mover.rest(np.ones(self._link.n, dtype=bool)))
            mover.travel(begin, ACCELERATION)
        except Stalled as error:
            raise Refused(f"check motion: {error}") from None
        return readings

    def _not_converted(
        self, readings: list[StaticReading], old: list[Calibration], new: list[Calibration]
    ) -> str | None:
        """Whether some controller does not send what its new pair makes of the old reading."""
        before, after = stack(self._before, "torque"), stack(readings, "torque")
        for j, name in enumerate(self._names):
            expected = (before[:, j] * old[j].gain + old[j].offset - new[j].offset) / new[j].gain
            away = float(np.mean(after[:, j] - expected))
            if abs(away) > FLOOR * self._limits.rated[j]:
                return f"{name}: sends {away:+.3f} N·m more than its new pair makes of the same readings"
        return None

    def _fits_worse(self, readings: list[StaticReading]) -> str | None:
        if self._beta is None:
            return None
        before, after = self._rms(self._before, self._beta), self._rms(readings, self._beta)
        worse = (after > WORSE * before) & (after - before > FLOOR * self._limits.rated)
        if not worse.any():
            return None
        j = int(np.argmax(np.where(worse, after - before, -np.inf)))
        return f"{self._names[j]}: in the check motion {after[j]:.3f} N·m RMS against the model, {before[j]:.3f} before"

    def _rms(self, readings: list[StaticReading], beta: Array) -> Array:
        record = self._record
        q = stack(readings, "position") * record.values("position_gain", 1.0) + record.values("position_offset", 0.0)
        residual: Array = stack(readings, "torque") - gravity_torque(gcomp_arm(self._arm), beta, q)
        rms: Array = np.sqrt(np.mean(residual**2, axis=0))
        return rms


def check_poses(begin: Array, limits: Limits) -> Array:
    """Poses (P, n) [rad] around `begin` (n,), each joint once to either side in a pattern of its own, off the stops."""
    joints = np.arange(len(begin))
    signs = np.array([np.where((joints >> bit) & 1, 1.0, -1.0) for bit in range(POSES // 2)])
    poses = begin + AMPLITUDE * np.concatenate([signs, -signs])
    margin = np.minimum(MARGIN, (limits.upper - limits.lower) / 4)
    inside: Array = np.clip(poses, limits.lower + margin, limits.upper - margin)
    return inside
