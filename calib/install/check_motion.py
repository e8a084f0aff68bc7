"""Check of a write: the same small motion before and after it, and whether the readings are worse afterwards.

Each joint moves at most `AMPLITUDE` from its present position, stays `MARGIN` off its stops, and returns. Two things
are judged: whether every controller now sends the old readings converted by its new calibration, and, if there is a
gravity model, whether the readings fit it worse than before.
"""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import Calibration
from armlink.loop.open import ArmDriver
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Mover, Stalled
from calib.motion.static_reading import StaticReading, stack
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque

AMPLITUDE = 0.2
"""Largest excursion of a joint [rad]."""
MARGIN = 0.1
"""Distance kept from the stops [rad]; a joint nearer to one moves away from it."""
SPEED = 0.3
"""Share of each joint's largest velocity."""
ACCELERATION = 1.0
"""[rad/s²]"""
POSES = 4
"""Two patterns of signs, each both ways."""
FLOOR = 0.004
"""Difference of readings or of RMS that does not count, as a share of rated torque: twice the torque noise of the
simulated arm (0.2 %), as the servo's friction holds a joint a little off the first position the second time."""
DOUBT = 2.0
"""The same as a multiple of the record's discrepancy: a better calibration may fit these few poses worse by it."""
WORSE = 1.1
"""Ratio of RMS against the model, after over before, above which the fit is worse if the FLOOR is exceeded too."""


class CheckMotion:
    """The same small motion before and after a write; the link must have been enabled."""

    def __init__(self, link: ArmDriver, arm: ArmFile, record: CalibrationRecord, beta: Array | None) -> None:
        """The motion is around the arm's present pose; `beta` (2n,) [kg·m] is None if no gravity model is known."""
        self._link, self._arm, self._record, self._beta = link, arm, record, beta
        self._limits, self._names = DriveLimits.of(arm), arm.joint_names
        self._floor = np.maximum(FLOOR * self._limits.rated, DOUBT * record.discrepancy("level"))
        self._installed: list[Calibration] = []
        self._before: list[StaticReading] = []
        self._poses: Array = np.empty((0, link.n))

    def before(self) -> None:
        """Make the motion and keep its readings; raises Refused if the arm cannot move, BusFault."""
        self._installed = [self._link.read_calibration(joint) for joint in range(self._link.n)]
        mover = self._mover()
        self._poses = check_poses(mover.position, self._limits)
        self._before = self._run(mover)

    def after(self) -> str | None:
        """Make it again; a complaint if something is worse now, else None. Raises Refused, BusFault."""
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
            raise Refused(f"check motion after the write: {error}") from None
        return readings

    def _not_converted(
        self, readings: list[StaticReading], old: list[Calibration], new: list[Calibration]
    ) -> str | None:
        """A complaint about a controller that does not send the old reading converted by its new calibration."""
        before, after = stack(self._before, "torque"), stack(readings, "torque")
        for j, name in enumerate(self._names):
            expected = new[j].invert(old[j].apply(before[:, j]))
            away = float(np.mean(after[:, j] - expected))
            if abs(away) > self._floor[j]:
                return (
                    f"{name}: its readings after the write are {away:+.3f} N·m from the expected ones, which are the "
                    "readings before the write, converted with the new calibration"
                )
        return None

    def _fits_worse(self, readings: list[StaticReading]) -> str | None:
        if self._beta is None:
            return None
        before, after = self._rms(self._before, self._beta), self._rms(readings, self._beta)
        worse = (after > WORSE * before) & (after - before > self._floor)
        if not worse.any():
            return None
        j = int(np.argmax(np.where(worse, after - before, -np.inf)))
        return (
            f"{self._names[j]}: in the check motion the RMS difference to the model is {after[j]:.3f} N·m, but "
            f"{before[j]:.3f} N·m before the write"
        )

    def _rms(self, readings: list[StaticReading], beta: Array) -> Array:
        q = self._record.angle(stack(readings, "position"))
        residual: Array = stack(readings, "torque") - gravity_torque(gcomp_arm(self._arm), beta, q)
        return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))


def check_poses(begin: Array, limits: DriveLimits) -> Array:
    """Poses (P, n) [rad] around `begin` (n,), each joint once to either side in a pattern of its own, off the stops."""
    joints = np.arange(len(begin))
    signs = np.array([np.where((joints >> bit) & 1, 1.0, -1.0) for bit in range(POSES // 2)])
    poses = begin + AMPLITUDE * np.concatenate([signs, -signs])
    margin = np.minimum(MARGIN, (limits.upper - limits.lower) / 4)
    return np.clip(poses, limits.lower + margin, limits.upper - margin)
