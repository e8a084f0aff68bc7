"""Verification: model against sensor torque at held-out poses, as Figure 6 of [MH97] (docs/theory.md, section 3).

A torque sensor is read at rest. Of a drive whose torque is a motor current, the half sum of two short creeps, there and
back, is read, which is without friction. Poses that the drives do not reach are left out.

A payload is weighed in the same way: it is what the torques show beyond the gravity record.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.link.reading_bounds import ReadingBounds
from armlink.link.types import Sample
from armlink.loop.open import ArmDriver
from armlink.torque_calibration import per_joint
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_motion, sweep_section
from calib.fit.field_fit import Payload, raw_readings, weigh_payload
from calib.install.check_motion import check_poses
from calib.motion.mover import STALL, Mover, Stalled
from calib.motion.static_reading import stack
from calib.plan.creep_plan import TRAVEL_ACCELERATION, CreepingArm
from calib.plan.planned_arm import FASTEST, PlannedArm, nearest_first
from calib.plan.sweep_plan import weighing_poses
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.sweep_pass import OnStall, give_up, repeat_work
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque, torque_covariance

TOLERANCE = 0.01
"""RMS that passes, as a share of the joint's largest model torque: twice the error of gravity torque that
tests/calib/drawn_arms.py allows."""
EXPECTED = 2.5
"""RMS that passes, as a multiple of what the records expect: a field that is alike over much of the range is drawn anew
only a few times by the poses, and a mean of two squares exceeds this one time in five hundred."""
NOISE_FLOOR = 0.003
"""RMS that always passes, as a share of rated torque: the error of an offset that tests/calib/drawn_arms.py allows."""
CREEP_SPEED = 0.12
"""Of the creeps [rad/s]."""
CREEP_WAY = 0.15
"""Of all joints together, once each way [rad]."""
CREEP_LEAD = 0.05
"""Way at the start of each that does not count: friction turns round [rad]."""
CREEP_TOLERANCE = 0.02
"""TOLERANCE of creeps."""
CREEP_FLOOR = 0.008
"""NOISE_FLOOR of creeps: friction that differs between the directions."""
FEWEST_WEIGHED = 2
"""Poses without which the mass of a payload and its place cannot be told apart (docs/theory.md, section 6.4)."""


@dataclass(frozen=True, eq=False)
class Verification:
    """Model torque against sensor torque at P poses."""

    names: tuple[str, ...]
    position: Array
    """True angles by the calibration (P, n) [rad]."""
    sensor: Array
    """Calibrated sensor torque (P, n) [N·m]."""
    model: Array
    """Model torque (P, n) [N·m]."""
    model_std: Array
    """Standard deviation of the model torque by the record's covariance (P, n) [N·m]."""
    skipped: int
    """Poses that the drives did not reach."""
    tolerance: Array
    """RMS that passes (n,) [N·m]."""

    @property
    def rms(self) -> Array:
        """RMS of sensor minus model (n,) [N·m]."""
        return np.asarray(np.sqrt(np.mean((self.sensor - self.model) ** 2, axis=0)))

    @property
    def max_error(self) -> Array:
        """Largest absolute difference (n,) [N·m]."""
        return np.asarray(np.abs(self.sensor - self.model).max(axis=0))

    @property
    def passed(self) -> bool:
        """Whether every joint's RMS is within its tolerance."""
        return bool(np.all(self.rms <= self.tolerance))


def run_verify(
    link: ArmDriver,
    arm_file: ArmFile,
    gravity: GravityRecord,
    calibration: CalibrationRecord | None = None,
    *,
    poses: int = 24,
    seed: int = 0,
    at: Callable[[Array], Array] | None = None,
    progress: Callable[[int, int], None] | None = None,
    on_stall: OnStall = give_up,
) -> Verification:
    """Drive, servo-held, to random poses within the joint range and read every torque there.

    `at` chooses other poses (P, n) [rad] by the present one (n,).
    The link must have been enabled. Without a calibration record the controllers' own calibration is used; an arm that
    creeps needs one. A pose whose reading a Stall interrupts is repeated where `on_stall` accepts it. Raises Refused on
    records of another arm, or if no pose can be reached; BadInput, BusFault.
    """
    section, limits, kinematics = sweep_section(arm_file), DriveLimits.of(arm_file), gcomp_arm(arm_file)
    creeping = sweep_motion(arm_file) == "creep"
    if calibration is not None:
        calibration.require(arm_file)
    elif creeping:
        raise BadInput(f"{arm_file.name}: its drives store no calibration, so verify needs a calibration record")
    installed = per_joint(link.read_calibration(joint) for joint in range(link.n))
    wanted = installed if calibration is None else calibration.torque_calibration(installed)
    gravity = gravity.carrying(arm_file)
    beta = np.array(gravity.beta)
    mover = Mover(link, section, limits)
    mover.hold_all()
    if at is None and creeping:
        at = partial(verify_poses, CreepingArm(arm_file), poses, seed, about=CREEP_WAY / 2)
    elif at is None:
        at = partial(verify_poses, PlannedArm(arm_file), poses, seed)
    held_out = at(mover.position)
    as_sent = np.isnan(calibration.values("gain")) if creeping and calibration is not None else np.zeros(link.n, bool)
    angles, torques = list[Array](), list[Array]()
    for number, pose in enumerate(held_out, start=1):
        found = repeat_work(link, on_stall, partial(_read_at, mover, pose, creeping), mover.resume)
        if found is None:
            continue
        position, torque = found
        angles.append(position if calibration is None else calibration.angle(position))
        torques.append(np.where(as_sent, torque, wanted.invert(installed.apply(torque))))
        if progress is not None:
            progress(number, len(held_out))
    if not angles:
        raise Refused(
            f"none of {len(held_out)} poses was reached, since a joint stalled on the way to each: check that nothing "
            "blocks the arm, and that max_torque suffices"
        )
    q = np.array(angles)
    model = gravity_torque(kinematics, beta, q)
    variance = np.diagonal(torque_covariance(kinematics, np.array(gravity.covariance), q), axis1=-2, axis2=-1)
    share, floor = (CREEP_TOLERANCE, CREEP_FLOOR) if creeping else (TOLERANCE, NOISE_FLOOR)
    tolerance = np.maximum(share * np.abs(model).max(axis=0), floor * limits.rated)
    if calibration is not None and not creeping:
        tolerance = _expected_rms(calibration, model, variance, tolerance, floor * limits.rated)
    std, skipped = np.sqrt(np.maximum(variance, 0.0)), len(held_out) - len(angles)
    return Verification(link.names, q, np.array(torques), model, std, skipped, tolerance)


def creep_complaint(
    link: ArmDriver, arm: ArmFile, gravity: GravityRecord, calibration: CalibrationRecord
) -> str | None:
    """A complaint if short creeps about the arm's present pose do not agree with the records, else None.

    The link must have been enabled. Raises Refused, BusFault as `run_verify`.
    """
    limits = DriveLimits.of(arm)
    found = run_verify(link, arm, gravity, calibration, at=lambda begin: check_poses(begin, limits))
    if found.passed:
        return None
    worst = int(np.argmax(found.rms / found.tolerance))
    return (
        f"{found.names[worst]}: in the check motion the RMS difference to the model is {found.rms[worst]:.3g} N·m, "
        f"allowed {found.tolerance[worst]:.3g} N·m"
    )


def _expected_rms(calibration: CalibrationRecord, model: Array, variance: Array, fixed: Array, floor: Array) -> Array:
    """RMS that passes (n,) [N·m]: what records with a discrepancy expect of themselves, else fixed bounds."""
    level, level_std = calibration.discrepancy("level", np.nan), calibration.discrepancy("level_std", np.nan)
    gain, offset = calibration.values("gain", 1.0), np.nan_to_num(calibration.std("offset"))
    of_gain = np.nan_to_num(calibration.std("gain")) * np.abs(model)
    square = (level + 2 * level_std) ** 2 + (variance + (of_gain**2 + offset**2) / gain**2).mean(axis=0)
    return np.where(np.isnan(level), fixed, np.maximum(EXPECTED * np.sqrt(square), floor))


def _read_at(mover: Mover, pose: Array, creeping: bool) -> tuple[Array, Array] | None:
    """Position [rad] and torque [N·m] readings (n,) at a pose (n,), at rest or by creeps of all joints together, up and
    down about the pose; back again, and None, where a joint stalls."""
    begin, up, down = mover.position.copy(), list[Sample](), list[Sample]()
    try:
        if creeping:
            mover.travel(pose - CREEP_WAY / 2, TRAVEL_ACCELERATION)
            up, down = _creep(mover, CREEP_WAY), _creep(mover, -CREEP_WAY)
        else:
            mover.travel(pose, FASTEST)
    except Stalled:
        mover.hold_all()
        mover.travel(begin, 1.0 if creeping else FASTEST)
        return None
    if creeping:
        return pose, _half_sum(up, down, pose)
    rest = mover.rest(np.ones(mover.link.n, dtype=bool))
    return rest.position, rest.torque


def verify_poses(planned: PlannedArm, count: int, seed: int, begin: Array, about: float = 0.0) -> Array:
    """Random poses (P, n) [rad] about which, by so much [rad], nothing touches, each reached straight from the one
    before, the first from `begin` (n,); there are `count` unless the arm reaches fewer.

    Where the arm file has no geometry they are in an order with little travel. Raises Refused where it reaches none.
    """
    poses = planned.reachable_poses(count, np.random.default_rng([seed, 6]), begin, about=about)
    return poses[nearest_first(poses, begin)] if planned.geometry is None else poses


def _creep(mover: Mover, way: float) -> list[Sample]:
    """All joints together by `way` [rad]."""
    period, start = mover.link.period, mover.command.position.copy()
    count = round(abs(way) / CREEP_SPEED / period)
    rows = start + way * (np.arange(1, count + 1) / count)[:, None]
    n = mover.link.n
    return mover.follow(rows, ReadingBounds(np.full(n, -np.inf), np.full(n, np.inf), np.full(n, STALL)))


def _half_sum(up: list[Sample], down: list[Sample], pose: Array) -> Array:
    """Torque (n,) in the middle of both ways, each direction by a line through its samples."""
    means = []
    for samples in (up, down):
        position, torque = stack(samples, "position"), stack(samples, "torque")
        line = np.empty(len(pose))
        for joint, at in enumerate(pose):
            q, v = position[:, joint], torque[:, joint]
            kept = np.isfinite(q) & np.isfinite(v) & (np.abs(q - at) < CREEP_WAY / 2 - CREEP_LEAD / 2)
            if kept.sum() < 4:
                raise Refused(f"joint {joint + 1}: there are too few samples in a creep of {CREEP_WAY} rad")
            line[joint] = np.polynomial.polynomial.polyfit(q[kept] - at, v[kept], 1)[0]
        means.append(line)
    return (means[0] + means[1]) / 2


def run_weigh(
    link: ArmDriver,
    arm_file: ArmFile,
    gravity: GravityRecord,
    calibration: CalibrationRecord,
    *,
    poses: int = 12,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_stall: OnStall = give_up,
) -> tuple[Payload, int]:
    """(The payload, number of poses that were reached). The link must have been enabled.

    Raises Refused where a record is of another arm or too few poses are reached, BadInput, BusFault.
    """
    creeping = sweep_motion(arm_file) == "creep"
    found = run_verify(
        link,
        arm_file,
        gravity,
        calibration,
        poses=poses,
        seed=seed,
        at=None if creeping else partial(weighing_poses, arm_file, poses, seed),
        progress=progress,
        on_stall=on_stall,
    )
    reached = len(found.sensor)
    if reached < FEWEST_WEIGHED:
        raise Refused(f"{reached} of {poses} poses were reached: can the drives hold the load?")
    sigma = sweep_section(arm_file).standard_error * arm_file.require_link().rated_torques
    readings = raw_readings(found.position, found.sensor, np.maximum(sigma, 1e-9), calibration)
    if creeping:  # half sums of both directions
        readings = replace(readings, direction=np.zeros_like(readings.direction))
    return weigh_payload(arm_file, readings, gravity, calibration), reached
