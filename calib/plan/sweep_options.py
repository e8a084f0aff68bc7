"""Stop combinations among which sweeps are chosen: held by the drives, felt by the sensor, free of collisions.

And poses that tell most of the masses, for the scout and for weighing, in an order with little travel.
"""

from itertools import pairwise

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.plan.collisions import Collided, straight_way
from calib.plan.planned_arm import PlannedArm, nearest_first
from calib.plan.stop_selection import Candidates, stop_combinations, with_lever
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.design.selection import select
from gcomp.gravity.torque import gravity_regressor

UNKNOWN = 1e-6
"""Prior information on each parameter: negligible, but it keeps the first poses' matrices regular."""
Poses = tuple[tuple[float, ...], ...]
"""(P, n) [rad]"""


def scout_poses(planned: PlannedArm, seed: int) -> Poses:
    """n + 3 poses that determine mass moments and sensor offsets well, in an order with little travel.

    Poses in which bodies touch are left out; raises BadInput if too few remain.
    """
    count = planned.arm.n + 3
    poses = planned.free_poses(2 * count, np.random.default_rng(seed))
    middle = np.mean([planned.sweep_range(joint) for joint in range(planned.arm.n)], axis=1)
    chosen = _informative_poses(planned, poses, gravity_regressor(planned.arm, poses), 10.0, count, middle)
    return tuple(tuple(pose.tolist()) for pose in chosen)


def weighing_poses(arm_file: ArmFile, count: int, seed: int, begin: Array) -> Array:
    """Poses (P, n) [rad] that tell a payload's mass and place best (D-optimal), in an order with little travel.

    Where the arm file has geometry, poses in which bodies touch are left out; raises BadInput if too few remain.
    """
    planned = PlannedArm(arm_file)
    poses = planned.free_poses(count, np.random.default_rng([seed, 8]))
    columns = gravity_regressor(planned.arm, poses) @ np.column_stack(payload_columns(planned.arm))
    return _informative_poses(planned, poses, columns, 1.0, count, begin)


def _informative_poses(
    planned: PlannedArm, poses: Array, columns: Array, offset: float, count: int, begin: Array
) -> Array:
    """The poses (count, n) that tell most (D-optimal) of unknowns with these columns (P, n, p) of torque and of every
    joint's offset, in units of `offset` [N·m]; from `begin` (n,) on each is near to the one before.

    Poses on whose way something touches give their place to others, as long as there are any.
    """
    offsets = np.broadcast_to(offset * np.eye(poses.shape[1]), (*poses.shape, poses.shape[1]))
    rows, left = np.concatenate([columns, offsets], axis=2) / planned.limits.rated[:, None], np.arange(len(poses))
    while True:
        (chosen,) = select([rows[left][None]], UNKNOWN * np.eye(rows.shape[2])[None], [count], exchanges=0)
        order = left[chosen][nearest_first(poses[left[chosen]], begin)]
        blocked = [goal for here, goal in pairwise(order) if not planned.is_clear(poses[here], poses[goal])]
        left = np.setdiff1d(left, blocked)
        if not blocked or len(left) < count:
            return poses[order]


def sweep_options(planned: PlannedArm) -> tuple[list[Candidates], list[str]]:
    """(Combinations of each joint, tip to base; notes on what had to be given up).

    Raises BadInput if the drives can hold no combination, Collided if something touches in every one.
    """
    found = [_options(planned, joint) for joint in reversed(range(planned.arm.n))]
    return [options for options, _ in found], [note for _, notes in found for note in notes]


def _options(planned: PlannedArm, joint: int) -> tuple[Candidates, list[str]]:
    section, limits, name = planned.section, planned.limits, planned.arm.names[joint]
    everything = _without_collision(stop_combinations(planned.arm, joint, planned.sweep_range(joint)), planned)
    if planned.guess is None:
        return with_lever(everything), []
    least, largest, allowance = planned.hold_torque(everything.poses)
    strongest = np.maximum(np.abs(least), np.abs(largest))
    drivable = strongest[:, joint] + allowance[:, joint] <= limits.max_torque[joint]
    if not drivable.any():
        drivable = strongest[:, joint] <= limits.max_torque[joint]
    holdable = (strongest + section.friction * limits.rated <= limits.max_torque).all(axis=1) & drivable
    pressable = planned.pressable_joints(everything)
    pressed = pressable.all(axis=1) & holdable  # it must leave its stop again
    if pressed.sum() >= min(section.poses, everything.count):
        return with_lever(everything.kept(pressed)), []
    if not (pressed | holdable).any():
        needs = zip(planned.arm.names, strongest.min(axis=0), limits.max_torque, strict=True)
        needed = ", ".join(f"{each} {torque:.1f} of {most:g} N·m" for each, torque, most in needs)
        raise BadInput(
            f"{name}: no combination of stops can be held for its sweep: gravity needs at least these shares of "
            f"max_torque: {needed}: sweep a lighter arm, or raise max_torque"
        )
    note = (
        f"{name}: in some of its sweeps the other joints are held by their position loops, since max_torque cannot "
        "press them on their stops in enough poses"
    )
    return with_lever(everything.kept(pressed | holdable)), [note]


def _without_collision(candidates: Candidates, planned: PlannedArm) -> Candidates:
    """The combinations along which nothing touches, at the poses `check_plan` looks at; raises Collided if none."""
    ways = straight_way(candidates.poses[:, 0], candidates.poses[:, -1])
    flat = ways.reshape(-1, planned.arm.n)
    free = np.all(planned.free(flat).reshape(candidates.count, -1), axis=1)
    if free.any() or planned.geometry is None:
        return candidates.kept(free)
    first, second = next(found for pose in flat for found in planned.geometry.contacts(pose)).bodies
    raise Collided(
        f"joint {planned.arm.names[candidates.joint]}: in every combination of stops two bodies touch, for example "
        f"{first} and {second}: narrow lower and upper in the arm file"
    )
