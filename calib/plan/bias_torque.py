"""Torques that press resting joints on their stops, and the accelerations that these allow."""

import numpy as np
import numpy.typing as npt

from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import SweepSection
from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import Candidates
from gcomp.arrays import Array, Mask

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
