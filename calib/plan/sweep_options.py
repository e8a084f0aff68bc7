"""Stop combinations among which sweeps are chosen: held by the drives, felt by the sensor, free of collisions."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import SweepSection, sweep_section
from calib.plan.bias_torque import hold_torque, pressable_joints
from calib.plan.collisions import POINTS, Collided, Geometry
from calib.plan.poses import require_range, sweep_range
from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import Candidates, stop_combinations, with_lever
from gcomp.arm.arm import Arm


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
