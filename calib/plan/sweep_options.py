"""Stop combinations among which sweeps are chosen: held by the drives, felt by the sensor, free of collisions.

And the torques that press resting joints on their stops, with the accelerations that these allow; ranges of sweeps,
poses of the scout, and an order of poses with little travel.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import SweepSection, sweep_section
from calib.plan.collisions import POINTS, Collided, Geometry
from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import Candidates, stop_combinations, with_lever
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.design.selection import select
from gcomp.gravity.torque import gravity_regressor

UNKNOWN = 1e-6
"""Prior information on each parameter: negligible, but it keeps the first poses' matrices regular."""
Poses = tuple[tuple[float, ...], ...]
"""(P, n) [rad]"""

COLLIDING = (
    "almost every pose within the joint ranges collides: correct the collision shapes of the model, or narrow lower "
    "and upper in the arm file"
)
"""Message of a plan without free poses."""


def sweep_range(section: SweepSection, limits: DriveLimits, joint: int) -> tuple[float, float]:
    """First and last step [rad] of a joint; the margin grows with the angle, since the position gain is unknown."""
    low, high = float(limits.lower[joint]), float(limits.upper[joint])
    margin = section.range_margin
    return low + margin + 0.02 * abs(low), high - margin - 0.02 * abs(high)


def scout_poses(
    kinematics: Arm,
    section: SweepSection,
    limits: DriveLimits,
    seed: int,
    geometry: Geometry | None = None,
) -> Poses:
    """n + 3 poses that determine mass moments and sensor offsets well, in an order with little travel.

    Poses in which bodies of `geometry` touch are left out; raises BadInput if too few remain.
    """
    n = kinematics.n
    poses = _free_poses(section, limits, np.random.default_rng(seed), geometry, 2 * (n + 3))
    chosen = _informative_poses(poses, gravity_regressor(kinematics, poses), 10.0, limits, n + 3)
    middle = np.mean([sweep_range(section, limits, joint) for joint in range(n)], axis=1)
    return tuple(tuple(pose.tolist()) for pose in nearest_first(chosen, middle))


def weighing_poses(arm_file: ArmFile, count: int, seed: int, begin: Array) -> Array:
    """Poses (P, n) [rad] that tell a payload's mass and place best (D-optimal), in an order with little travel.

    Where the arm file has geometry, poses in which bodies touch are left out; raises BadInput if too few remain.
    """
    kinematics, limits, section = gcomp_arm(arm_file), DriveLimits.of(arm_file), sweep_section(arm_file)
    geometry = None if arm_file.model_path is None else Geometry(arm_file)
    poses = _free_poses(section, limits, np.random.default_rng([seed, 8]), geometry, count)
    columns = gravity_regressor(kinematics, poses) @ np.column_stack(payload_columns(kinematics))
    return nearest_first(_informative_poses(poses, columns, 1.0, limits, count), begin)


def drawn_poses(section: SweepSection, limits: DriveLimits, count: int, random: np.random.Generator) -> Array:
    """Poses (count, n) [rad] all over the range that sweeps have."""
    ends = np.array([sweep_range(section, limits, joint) for joint in range(len(limits.lower))])
    return np.asarray(ends[:, 0] + random.random((count, len(ends))) * (ends[:, 1] - ends[:, 0]))


def _free_poses(
    section: SweepSection, limits: DriveLimits, random: np.random.Generator, geometry: Geometry | None, fewest: int
) -> Array:
    """Drawn poses (P, n) [rad] in which no bodies of `geometry` touch; raises BadInput if too few remain."""
    poses = drawn_poses(section, limits, 300, random)
    if geometry is not None:
        poses = poses[geometry.free(poses)]
        if len(poses) < fewest:
            raise BadInput(COLLIDING)
    return poses


def _informative_poses(poses: Array, columns: Array, offset: float, limits: DriveLimits, count: int) -> Array:
    """The poses (count, n) that tell most (D-optimal) of unknowns with these columns (P, n, p) of torque and of every
    joint's offset, in units of `offset` [N·m]."""
    offsets = np.broadcast_to(offset * np.eye(poses.shape[1]), (*poses.shape, poses.shape[1]))
    rows = np.concatenate([columns, offsets], axis=2) / limits.rated[:, None]
    (chosen,) = select([rows[None]], UNKNOWN * np.eye(rows.shape[2])[None], [count], exchanges=0)
    return poses[chosen]


def nearest_first(poses: Array, begin: Array) -> Array:
    """The same poses (K, n) [rad], each followed by the nearest of the remaining ones, from `begin` (n,) on."""
    left, way = list(range(len(poses))), []
    here = begin
    while left:
        nearest = min(left, key=lambda k: float(np.abs(poses[k] - here).max()))
        left.remove(nearest)
        way.append(nearest)
        here = poses[nearest]
    return poses[way]


def require_range(section: SweepSection, limits: DriveLimits, kinematics: Arm) -> None:
    """Raise BadInput, naming the joint, if a range leaves nothing to sweep."""
    for joint, name in enumerate(kinematics.names):
        first, last = sweep_range(section, limits, joint)
        if not np.isfinite([first, last]).all() or last - first < 0.2:
            raise BadInput(
                f"{name}: of its range {limits.lower[joint]:g} to {limits.upper[joint]:g} rad only {last - first:.2f} "
                "rad are left to sweep, at least 0.2 rad are needed. At each end range_margin "
                f"({section.range_margin:g} rad) and 2 % are left out: check lower and upper, or reduce range_margin"
            )


@dataclass(frozen=True, eq=False)
class PlannedArm:
    """The arm, its limits and what is known of its masses, as planning needs them."""

    kinematics: Arm
    section: SweepSection
    limits: DriveLimits
    guess: GravityGuess | None
    """Rough gravity model; None if nothing is known of the masses."""
    geometry: Geometry | None
    """The model's bodies, for collisions; None if the arm file has no model."""

    @classmethod
    def of(cls, arm_file: ArmFile, guess: GravityGuess | None) -> Self:
        """Raises BadInput if a joint's range is too short to sweep or the model cannot be used."""
        kinematics, section, limits = gcomp_arm(arm_file), sweep_section(arm_file), DriveLimits.of(arm_file)
        require_range(section, limits, kinematics)
        return cls(kinematics, section, limits, guess, None if arm_file.model_path is None else Geometry(arm_file))


def sweep_options(planned: PlannedArm) -> tuple[list[Candidates], list[str]]:
    """(Combinations of each joint, tip to base; notes on what had to be given up).

    Raises BadInput if the drives can hold no combination, Collided if something touches in every one.
    """
    found = [_options(planned, joint) for joint in reversed(range(planned.kinematics.n))]
    return [options for options, _ in found], [note for _, notes in found for note in notes]


def _options(planned: PlannedArm, joint: int) -> tuple[Candidates, list[str]]:
    section, limits, guess = planned.section, planned.limits, planned.guess
    name = planned.kinematics.names[joint]
    everything = stop_combinations(planned.kinematics, joint, sweep_range(section, limits, joint))
    if planned.geometry is not None:
        everything = _without_collision(everything, planned.geometry, name)
    if guess is None:
        return with_lever(everything), []
    least, largest, allowance = hold_torque(guess, section, limits, everything.poses)
    strongest = np.maximum(np.abs(least), np.abs(largest))
    drivable = strongest[:, joint] + allowance[:, joint] <= limits.max_torque[joint]
    if not drivable.any():
        drivable = strongest[:, joint] <= limits.max_torque[joint]
    holdable = (strongest + section.friction * limits.rated <= limits.max_torque).all(axis=1) & drivable
    pressed = (
        pressable_joints(guess, section, limits, everything).all(axis=1) & holdable
    )  # it must leave its stop again
    if pressed.sum() >= min(section.poses, everything.count):
        return with_lever(everything.kept(pressed)), []
    if not (pressed | holdable).any():
        needs = zip(planned.kinematics.names, strongest.min(axis=0), limits.max_torque, strict=True)
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


def _without_collision(candidates: Candidates, geometry: Geometry, name: str) -> Candidates:
    """The combinations along which nothing touches, at the poses `check_plan` looks at; raises Collided if none."""
    shares = np.linspace(0, 1, POINTS + 1)[:, None]
    begin, end = candidates.poses[:, :1], candidates.poses[:, -1:]
    flat = (begin + shares * (end - begin)).reshape(-1, candidates.poses.shape[-1])
    free = np.all(geometry.free(flat).reshape(candidates.count, -1), axis=1)
    if free.any():
        return candidates.kept(free)
    first, second = next(found for pose in flat for found in geometry.contacts(pose)).bodies
    raise Collided(
        f"joint {name}: in every combination of stops two bodies touch, for example {first} and {second}: "
        "narrow lower and upper in the arm file"
    )


SLOWEST = 0.3
"""Acceleration that every planned sweep must allow [rad/s²]: a step of 0.5 rad then takes 2.6 s; a choice."""
FASTEST = 2.0
"""Largest acceleration between sweeps [rad/s²]; a choice, swept in tests/campaigns/random_arms.py."""


def hold_torque(
    guess: GravityGuess, section: SweepSection, limits: DriveLimits, poses: Array
) -> tuple[Array, Array, Array]:
    """(Least, largest, allowance) holding torque (C, n) [N·m] along candidate sweeps with poses (C, S, n).

    The allowance covers the rough model's error, the torque scale and friction, but not the margin.
    """
    torque = guess.torque(poses)
    doubt = (guess.uncertainty(poses) + section.gain_tolerance * np.abs(torque)).max(axis=1)
    return torque.min(axis=1), torque.max(axis=1), doubt + section.friction * limits.rated


def required_bias(
    guess: GravityGuess, section: SweepSection, limits: DriveLimits, stops: npt.NDArray[np.int8], poses: Array
) -> Array:
    """Size of the torque (C, n) [N·m] that keeps each resting joint pressed along candidate sweeps; 0 if swept."""
    least, largest, allowance = hold_torque(guess, section, limits, poses)
    against = np.where(stops > 0, largest, -least)
    floor = section.bias_margin * limits.max_torque + section.friction * limits.rated
    needed = np.maximum(against + allowance + section.bias_margin * limits.max_torque, floor)
    return np.where(stops == 0, 0.0, needed)


def pressable_joints(guess: GravityGuess, section: SweepSection, limits: DriveLimits, candidates: Candidates) -> Mask:
    """Resting joints (C, n) that can be pressed on their stop within max_torque; True for the swept joint."""
    needed = required_bias(guess, section, limits, candidates.stops, candidates.poses)
    needed = needed + SLOWEST * reaction_bound(guess, candidates.joint)
    given = limits.max_torque if section.bias_torque is None else np.array(section.bias_torque)
    flags: Mask = (needed <= np.minimum(given, limits.max_torque)) | (candidates.stops == 0)
    return flags


def reaction_bound(guess: GravityGuess, joint: int) -> Array:
    """Bound of the torque (n,) [N·m] at every joint per rad/s² of the swept one: √(M_ii M_jj)."""
    inertia = guess.inertia()
    bound: Array = np.sqrt(inertia * inertia[joint])
    return bound


def bias_and_acceleration(
    needed: Array, spare: Array, reaction: Array, pressed: Mask, section: SweepSection, limits: DriveLimits, joint: int
) -> tuple[Array, float]:
    """(Bias size (n,) [N·m], acceleration [rad/s²]), the largest acceleration that every joint's torque allows.

    `spare` (n,) [N·m] is the drives' torque beyond gravity: a servo-held joint resists the swept one's reaction with
    it, and the swept joint accelerates with half of it.
    """
    given = limits.max_torque if section.bias_torque is None else np.array(section.bias_torque)
    left = np.where(pressed, given - needed, spare)
    left[joint] = spare[joint] / 2
    room = left / np.maximum(reaction, 1e-9)
    acceleration = float(np.clip(room.min(), SLOWEST, section.acceleration))
    if section.bias_torque is not None:
        return given, acceleration
    return np.minimum(needed + acceleration * reaction, limits.max_torque), acceleration


def travel_acceleration(limits: DriveLimits, options: list[Candidates], guess: GravityGuess | None) -> float:
    """Acceleration [rad/s²] that the drives have beyond gravity at the poses between which they travel."""
    if guess is None:
        return 1.0
    poses = np.concatenate([each.poses.reshape(-1, guess.kinematics.n) for each in options])
    spare = limits.max_torque - np.abs(guess.torque(poses)).max(axis=0)
    return float(np.clip(np.min(spare / np.maximum(2 * guess.inertia(), 1e-9)), SLOWEST, FASTEST))
