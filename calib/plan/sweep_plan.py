"""Planning of sweeps: from the arm file alone, then once more with the scout's rough gravity model."""

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.arm.drive_limits import Limits
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import SweepSection, sweep_section
from calib.plan.bias_torque import (
    bias_and_acceleration,
    hold_torque,
    pressable,
    reaction_bound,
    required_bias,
    travel_acceleration,
)
from calib.plan.collisions import POINTS, Collided, Geometry
from calib.plan.poses import require_range, scout_poses, sweep_range
from calib.plan.predicted_precision import predicted_gain_std, worst_gain_std
from calib.plan.reference_mass import reference_masses
from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import Candidates, choose, guessed_moments, reachable, stop_combinations
from calib.plan.types import Sweep, SweepPlan
from gcomp.arm.arm import Arm

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

DEAD_LEVER = 0.005
"""Γ/g below which a joint feels no gravity: its offset is still swept, at one combination."""
SERVO_GAP = 0.05
"""Distance from the stop at which a servo-held joint rests [rad]."""
MORE_POSES = 2
"""Stop combinations per joint that may be added to those asked for, to reach the gains' precision."""
FINEST = 3.0
"""How many times finer than asked readings may be averaged to reach the gains' precision."""
ENOUGH = 1.2
"""How much worse than asked the gains' precision may be without a word."""


def plan_sweep(
    arm: ArmFile,
    guess: GravityGuess | None = None,
    *,
    seed: int = 0,
    reference_mass: float = 0.0,
    resolution: Array | None = None,
) -> SweepPlan:
    """The plan of one pass over all joints, tip to base.

    `reference_mass` [kg] is what hangs on the arm during this pass, 0 for nothing; `resolution` (n,) [rad] that of the
    position readings, where known. Where two combinations a joint would not give the gains as exactly as asked,
    up to `MORE_POSES` more are swept.
    Without `guess` nothing is known of the masses and no bias torque is set. With the scout's guess, combinations
    that cannot be held within max_torque are left out and the others get their bias torques. Raises BadInput where
    a joint's range is too short to sweep or no combination can be held.
    """
    section, limits, described = sweep_section(arm), Limits.of(arm), gcomp_arm(arm)
    require_range(section, limits, described)
    geometry = None if arm.model_path is None else Geometry(arm)
    options, notes = [], []
    for joint in reversed(range(described.n)):
        found, remarks = _options(joint, section, limits, described, guess, geometry)
        options.append(found)
        notes += remarks
    moments = guessed_moments(described, seed) if guess is None else [guess.beta]
    sigma = section.standard_error * limits.rated
    given = reference_mass or section.reference_mass
    masses = [given] if given else reference_masses(described, limits, options, guess)
    mass = masses[-1]
    poses = section.loaded_poses if reference_mass else section.poses
    scout = scout_poses(described, section, limits, seed, None if geometry is None else geometry.free)
    rounding = np.zeros(described.n) if resolution is None else resolution / np.sqrt(12.0)
    gain_std, finer = None, 1.0
    for more in range(MORE_POSES + 1):
        counts = [1 if each.lever.max() < DEAD_LEVER else poses + more for each in options]
        picks = choose(described, options, counts, moments, sigma, mass, section.travel_speed * limits.speed)
        sweeps = [
            _sweep(described.names[each.joint], number, each, pick, section, limits, guess)
            for each, chosen in zip(options, picks, strict=True)
            for number, pick in enumerate(chosen, start=1)
        ]
        if guess is None:
            break
        for mass in masses:
            std = predicted_gain_std(
                guess,
                sweeps,
                np.array(scout),
                mass,
                sigma,
                section.position_offset_std,
                rounding,
                section.known_point,
            )
            gain_std = worst_gain_std(std)
            if gain_std <= section.gain_std:
                break
        assert gain_std is not None
        finer = float(np.clip(gain_std / section.gain_std, 1.0, FINEST))
        if gain_std <= FINEST * section.gain_std:
            break
    if gain_std is not None and gain_std > ENOUGH * FINEST * section.gain_std:
        notes.append(
            f"gains will be known to ± {2 * gain_std / finer:.1%} only, not ± {2 * section.gain_std:.1%}, however long"
            " one averages: use a heavier reference mass, or measure where it hangs (sweep.reference_point)"
        )
    return SweepPlan(
        sweeps=tuple(sweeps),
        scout=scout,
        reference_mass=mass,
        standard_error=section.standard_error / finer,
        travel_acceleration=travel_acceleration(limits, options, guess),
        gain_std=None if gain_std is None else gain_std / finer,
        notes=tuple(notes),
    )


def _options(
    joint: int,
    section: SweepSection,
    limits: Limits,
    described: Arm,
    guess: GravityGuess | None,
    geometry: Geometry | None,
) -> tuple[Candidates, list[str]]:
    """The combinations from which a joint's sweeps are chosen, and what had to be given up."""
    swept = sweep_range(section, limits, joint)
    everything = stop_combinations(described, joint, swept)
    if geometry is not None:
        everything = _clear(everything, geometry, described.names[joint])
    if guess is None:
        return reachable(everything), []
    least, largest, allowance = hold_torque(guess, section, limits, everything.poses)
    strongest = np.maximum(np.abs(least), np.abs(largest))
    drivable = strongest[:, joint] + allowance[:, joint] <= limits.max_torque[joint]
    if not drivable.any():
        drivable = strongest[:, joint] <= limits.max_torque[joint]
    holdable = (strongest + section.friction * limits.rated <= limits.max_torque).all(axis=1) & drivable
    pressed = pressable(guess, section, limits, everything).all(axis=1) & holdable  # it must leave its stop again
    name = described.names[joint]
    if pressed.sum() >= section.poses:
        return reachable(everything.kept(pressed)), []
    if not (pressed | holdable).any():
        raise BadInput(
            f"joint {name}: no combination of stops can be held within max_torque: gravity needs up to"
            f" {_torques(strongest.min(axis=0))} N·m; sweep a lighter arm, or allow more torque"
        )
    note = f"{name}: too few stop combinations can be pressed within max_torque: some joints are servo-held instead"
    return reachable(everything.kept(pressed | holdable)), [note]


def _clear(candidates: Candidates, geometry: Geometry, name: str) -> Candidates:
    """The combinations along which nothing touches, as closely looked at as the way; raises Collided if none."""
    shares = np.linspace(0, 1, POINTS + 1)[:, None]
    begin, end = candidates.poses[:, :1], candidates.poses[:, -1:]
    flat = (begin + shares * (end - begin)).reshape(-1, candidates.poses.shape[-1])
    free = np.all(geometry.free(flat).reshape(candidates.count, -1), axis=1)
    if free.any():
        return candidates.kept(free)
    first, second = next(found for pose in flat for found in geometry.contacts(pose)).bodies
    raise Collided(
        f"joint {name}: in every combination of stops something touches, as {first} does {second}: narrow lower and"
        " upper in the arm file"
    )


def _sweep(
    name: str,
    number: int,
    options: Candidates,
    pick: int,
    section: SweepSection,
    limits: Limits,
    guess: GravityGuess | None,
) -> Sweep:
    joint, stops = options.joint, options.stops[pick]
    steps = np.linspace(*sweep_range(section, limits, joint), section.steps)
    resting = stops != 0
    bias = acceleration = None
    servo = resting & (section.hold == "servo")
    if guess is not None:
        one = options.kept(np.arange(len(options.stops)) == pick)
        servo = servo | (resting & ~pressable(guess, section, limits, one)[0])
        needed = required_bias(guess, section, limits, one.stops, one.poses)[0]
        least, largest, _ = hold_torque(guess, section, limits, one.poses)
        spare = limits.max_torque - np.maximum(np.abs(least), np.abs(largest))[0]
        pressed = resting & ~servo
        size, acceleration = bias_and_acceleration(
            needed, spare, reaction_bound(guess, joint), pressed, section, limits, joint
        )
        bias = tuple((stops * np.where(pressed, size, 0.0)).tolist())
    rest = np.where(stops > 0, limits.upper, limits.lower) - SERVO_GAP * stops * servo
    rest[joint] = steps[0]
    return Sweep(
        name=f"{name}.{number}",
        joint=joint,
        stops=tuple(-1 if side < 0 else 1 if side > 0 else 0 for side in stops),
        rest=tuple(rest.tolist()),
        steps=tuple(steps.tolist()),
        lever=float(options.lever[pick]),
        servo=tuple(bool(held) for held in servo),
        bias=bias,
        acceleration=section.acceleration if acceleration is None else acceleration,
    )


def _torques(values: Array) -> str:
    return " ".join(f"{value:.1f}" for value in values)
