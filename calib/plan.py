"""Planning of sweeps: from the arm file alone, then once more with the scout's rough gravity model."""

import numpy as np
import numpy.typing as npt

from armlink.armfile import ArmFile
from armlink.errors import BadInput
from calib.description import gcomp_arm
from calib.design import Candidates, choose, guessed_moments, reachable, stop_combinations
from calib.geometry import Collided, Geometry
from calib.guess import GravityGuess, reach
from calib.plan_limits import Limits
from calib.plan_model import Sweep, SweepPlan
from calib.plan_poses import require_range, scout_poses, sweep_range
from calib.precision import predicted_gain_std, worst_gain_std
from calib.section import SweepSection, sweep_section
from gcomp.arm import Arm
from gcomp.gravity import gravity_regressor
from gcomp.moments import payload_columns

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

DEAD_LEVER = 0.005
"""Γ/g below which a joint feels no gravity: its offset is still swept, at one combination."""
SLOWEST = 0.3
"""Acceleration that every planned sweep must allow [rad/s²]."""
MASS_SHARES = (0.3, 0.5, 0.7)
"""Shares of the torque left over gravity that the reference mass may take; the least that is precise enough."""
ASSUMED_GRAVITY = 0.6
"""Share of max_torque that gravity is assumed to take while nothing has been measured."""
SERVO_GAP = 0.05
"""Distance from the stop at which a servo-held joint rests [rad]."""
HAND = 0.15
"""How far from the flange the reference mass may hang [m]."""
MORE_POSES = 2
"""Stop combinations per joint that may be added to those asked for, to reach the gains' precision."""
FINEST = 3.0
"""How many times finer than asked readings may be averaged to reach the gains' precision."""
FASTEST = 2.0
"""Acceleration between sweeps where the drives allow it [rad/s²]."""


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
    masses = [given] if given else _reference_masses(described, limits, options, guess)
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
            std = predicted_gain_std(guess, sweeps, np.array(scout), mass, sigma, section.position_offset_std, rounding)
            gain_std = worst_gain_std(std)
            if gain_std <= section.gain_std:
                break
        assert gain_std is not None
        finer = float(np.clip(gain_std / section.gain_std, 1.0, FINEST))
        if gain_std <= FINEST * section.gain_std:
            break
    return SweepPlan(
        sweeps=tuple(sweeps),
        scout=scout,
        reference_mass=mass,
        standard_error=section.standard_error / finer,
        travel_acceleration=_travel_acceleration(limits, options, guess),
        gain_std=None if gain_std is None else gain_std / finer,
        notes=tuple(notes),
    )


def hold_torque(guess: GravityGuess, section: SweepSection, limits: Limits, poses: Array) -> tuple[Array, Array, Array]:
    """(Least, largest, allowance) holding torque (C, n) [N·m] along candidate sweeps with poses (C, S, n).

    The allowance covers the rough model's error, the torque scale and friction, but not the margin.
    """
    torque = guess.torque(poses)
    doubt = (guess.uncertainty(poses) + section.gain_tolerance * np.abs(torque)).max(axis=1)
    return torque.min(axis=1), torque.max(axis=1), doubt + section.friction * limits.rated


def required_bias(
    guess: GravityGuess, section: SweepSection, limits: Limits, stops: npt.NDArray[np.int8], poses: Array
) -> Array:
    """Size of the torque (C, n) [N·m] that keeps each resting joint pressed along candidate sweeps; 0 if swept."""
    least, largest, allowance = hold_torque(guess, section, limits, poses)
    against = np.where(stops > 0, largest, -least)
    floor = section.bias_margin * limits.max_torque + section.friction * limits.rated
    needed = np.maximum(against + allowance + section.bias_margin * limits.max_torque, floor)
    return np.where(stops == 0, 0.0, needed)


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
    everything = stop_combinations(described, joint, limits.lower, limits.upper, swept)
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
    pressed = _pressable(guess, section, limits, everything).all(axis=1) & holdable  # it must leave its stop again
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
    """The combinations along which nothing touches; raises Collided where there is none."""
    flat = candidates.poses.reshape(-1, candidates.poses.shape[-1])
    free = np.all(geometry.free(flat).reshape(candidates.poses.shape[:2]), axis=1)
    if free.any():
        return candidates.kept(free)
    first, second = next(found for pose in flat for found in geometry.contacts(pose)).bodies
    raise Collided(
        f"joint {name}: in every combination of stops something touches, as {first} does {second}: narrow lower and"
        " upper in the arm file"
    )


def _pressable(guess: GravityGuess, section: SweepSection, limits: Limits, candidates: Candidates) -> Flags:
    """Which resting joints (C, n) can be pressed on their stop within max_torque; True for the swept joint."""
    needed = required_bias(guess, section, limits, candidates.stops, candidates.poses)
    needed = needed + SLOWEST * _reaction(guess, candidates.joint)
    given = limits.max_torque if section.bias_torque is None else np.array(section.bias_torque)
    flags: Flags = (needed <= np.minimum(given, limits.max_torque)) | (candidates.stops == 0)
    return flags


def _reaction(guess: GravityGuess, joint: int) -> Array:
    """Bound of the torque (n,) [N·m] that 1 rad/s² of the swept joint makes at every joint: √(M_ii M_jj)."""
    inertia = guess.inertia()
    bound: Array = np.sqrt(inertia * inertia[joint])
    return bound


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
        servo = servo | (resting & ~_pressable(guess, section, limits, one)[0])
        needed = required_bias(guess, section, limits, one.stops, one.poses)[0]
        least, largest, _ = hold_torque(guess, section, limits, one.poses)
        spare = limits.max_torque - np.maximum(np.abs(least), np.abs(largest))[0]
        own = float(spare[joint] / max(2 * guess.inertia()[joint], 1e-9))
        pressed = resting & ~servo
        size, acceleration = _with_reaction(needed, _reaction(guess, joint), pressed, section, limits, joint, own)
        bias = tuple((stops * np.where(resting & ~servo, size, 0.0)).tolist())
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


def _with_reaction(
    needed: Array, reaction: Array, pressed: Flags, section: SweepSection, limits: Limits, joint: int, own: float
) -> tuple[Array, float]:
    """(Bias size (n,) [N·m], acceleration [rad/s²]): as fast as the resting joints' torque and its own allow."""
    given = limits.max_torque if section.bias_torque is None else np.array(section.bias_torque)
    room = np.where(pressed, (given - needed) / np.maximum(reaction, 1e-9), np.inf)
    room[joint] = own
    acceleration = float(np.clip(room.min(), SLOWEST, section.acceleration))
    if section.bias_torque is not None:
        return given, acceleration
    return np.minimum(needed + acceleration * reaction, limits.max_torque), acceleration


def _reference_masses(
    described: Arm, limits: Limits, options: list[Candidates], guess: GravityGuess | None
) -> list[float]:
    """Masses [kg] that take `MASS_SHARES` of the torque left at the joint that they load most, to two digits."""
    poses = np.concatenate([each.poses.reshape(-1, described.n) for each in options])
    regressor = gravity_regressor(described, poses)
    at_origin, by_point = payload_columns(described)
    flange = np.array([described.a[-1], 0.0, described.d[-1]])
    per_kg = np.abs(regressor @ (at_origin + by_point @ flange))
    per_kg += HAND * np.linalg.norm(regressor @ by_point, axis=-1)
    gravity = ASSUMED_GRAVITY * limits.max_torque if guess is None else np.abs(guess.torque(poses)).max(axis=0)
    room = np.maximum(limits.max_torque - gravity, 0.05 * limits.max_torque)
    most = float(np.min(room / np.maximum(per_kg.max(axis=0), 1e-9)))
    most = min(most, 2 * float(limits.rated.max()) / (9.81 * float(reach(described)[0])))
    return [float(f"{share * most:.2g}") for share in MASS_SHARES]


def _travel_acceleration(limits: Limits, options: list[Candidates], guess: GravityGuess | None) -> float:
    """Acceleration [rad/s²] that the drives can give beside gravity at the poses between which they travel."""
    if guess is None:
        return 1.0
    poses = np.concatenate([each.poses.reshape(-1, guess.arm.n) for each in options])
    spare = limits.max_torque - np.abs(guess.torque(poses)).max(axis=0)
    return float(np.clip(np.min(spare / np.maximum(2 * guess.inertia(), 1e-9)), SLOWEST, FASTEST))


def _torques(values: Array) -> str:
    return " ".join(f"{value:.1f}" for value in values)
