"""Verification of an arm whose torque is a motor current: model against half sums of short creeps at held-out poses."""

from collections.abc import Callable
from functools import partial

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.guard import ReadingBounds
from armlink.link.types import Sample
from armlink.loop.driver import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.creep.plan import CreepGround
from calib.motion.mover import STALL, Mover, Stalled
from calib.motion.static_reading import stack
from calib.plan.poses import nearest_first
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.stalls import OnStall, give_up, repeat_motion
from calib.sweep.verify import Verification
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque, torque_covariance

SPEED = 0.12
"""Of the creeps [rad/s]."""
WAY = 0.15
"""Of all joints together, once each way [rad]."""
LEAD = 0.05
"""Way at the start of each that does not count: friction turns round [rad]."""
TOLERANCE = 0.02
"""RMS that passes, as a share of the joint's largest model torque."""
FLOOR = 0.008
"""RMS that always passes, as a share of rated torque: friction that differs between the directions."""


def verify_creeping(
    link: ArmDriver,
    arm_file: ArmFile,
    gravity: GravityRecord,
    calibration: CalibrationRecord,
    *,
    poses: int = 12,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_stall: OnStall = give_up,
) -> Verification:
    """Creep all joints together, both ways, about random poses; the half sum of the readings is without friction.

    The link must have been enabled. A pose that a Stall interrupts is repeated where `on_stall` accepts it. Raises
    Refused on records of another arm or where no pose can be reached, BusFault.
    """
    ground, limits = CreepGround.of(arm_file), DriveLimits.of(arm_file)
    calibration.require(arm_file)
    beta = np.array(gravity.require(arm_file).beta)
    mover = Mover(link, ground.section, limits)
    mover.hold_all()
    installed = [link.read_calibration(joint) for joint in range(link.n)]
    wanted = calibration.torque_calibration()
    angles, torques, skipped = list[Array](), list[Array](), 0
    held_out = _poses(ground, poses, seed, mover.position)
    for number, pose in enumerate(held_out, start=1):
        ways = repeat_motion(mover, on_stall, partial(_both_ways, mover, pose))
        if ways is None:
            skipped += 1
            continue
        angle, torque = _half_sum(*ways, pose)
        raw = np.array([each.apply(float(value)) for each, value in zip(installed, torque, strict=True)])
        angles.append(calibration.angle(angle))
        torques.append(np.where(np.isnan(wanted.gain), torque, wanted.invert(raw)))
        if progress is not None:
            progress(number, len(held_out))
    if not angles:
        raise Refused("no pose was reached: the drives stalled at every one; is the arm free to move?")
    q = np.array(angles)
    model = gravity_torque(ground.arm, beta, q)
    variance = np.diagonal(torque_covariance(ground.arm, np.array(gravity.covariance), q), axis1=-2, axis2=-1)
    tolerance = np.maximum(TOLERANCE * np.abs(model).max(axis=0), FLOOR * limits.rated)
    return Verification(link.names, q, np.array(torques), model, np.sqrt(np.maximum(variance, 0.0)), skipped, tolerance)


def _poses(ground: CreepGround, count: int, seed: int, begin: Array) -> Array:
    """Random poses (P, n) [rad] about which nothing touches, each reached straight from the one before."""
    random = np.random.default_rng([seed, 6])
    ends = np.array([ground.range(joint) for joint in range(ground.arm.n)]) + WAY / 2 * np.array([1.0, -1.0])
    here, found = begin, list[Array]()
    for _ in range(200 * count):
        pose: Array = random.uniform(ends[:, 0], ends[:, 1])
        if ground.way(pose - WAY / 2, pose + WAY / 2) and ground.way(here, pose):
            found.append(pose)
            here = pose
            if len(found) == count:
                break
    if ground.geometry is None and found:
        return nearest_first(np.array(found), begin)
    return np.array(found)


def _both_ways(mover: Mover, pose: Array) -> tuple[list[Sample], list[Sample]] | None:
    """Creep up and down about a pose (n,) [rad]; back where it came from, and None, where a joint meets something."""
    begin = mover.position.copy()
    try:
        mover.travel(pose - WAY / 2, 1.5)
        return _creep(mover, WAY), _creep(mover, -WAY)
    except Stalled:
        mover.hold_all()
        mover.travel(begin, 1.0)
        return None


def _creep(mover: Mover, way: float) -> list[Sample]:
    """All joints together by `way` [rad]."""
    period, start = mover.link.period, mover.command.position.copy()
    count = round(abs(way) / SPEED / period)
    rows = start + way * (np.arange(1, count + 1) / count)[:, None]
    n = mover.link.n
    return mover.follow(rows, ReadingBounds(np.full(n, -np.inf), np.full(n, np.inf), np.full(n, STALL)))


def _half_sum(up: list[Sample], down: list[Sample], pose: Array) -> tuple[Array, Array]:
    """(Position (n,), torque (n,)) in the middle of both ways, each direction by a line through its samples."""
    means = []
    for samples in (up, down):
        position, torque = stack(samples, "position"), stack(samples, "torque")
        line = np.empty(len(pose))
        for joint, at in enumerate(pose):
            q, v = position[:, joint], torque[:, joint]
            kept = np.isfinite(q) & np.isfinite(v) & (np.abs(q - at) < WAY / 2 - LEAD / 2)
            if kept.sum() < 4:
                raise Refused(f"joint {joint + 1}: too few samples in a creep of {WAY} rad")
            line[joint] = np.polynomial.polynomial.polyfit(q[kept] - at, v[kept], 1)[0]
        means.append(line)
    torque = (means[0] + means[1]) / 2
    return pose, torque
