"""Planning of sweeps: from the arm file alone, then once more with the scout's rough gravity model.

With that model the precision of a plan is predicted before anything moves: the covariance that the fit would report.
Sweeps are chosen among the stop combinations that the drives hold, the sensor feels, and in which nothing touches;
poses for the scout and for weighing by what they tell of the masses, in an order with little travel.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.plan.collisions import Collided, sweep_ends
from calib.plan.planned_arm import SLOWEST, PlannedArm, nearest_first
from calib.plan.rough_gravity import HAND, GravityGuess, reach
from calib.plan.stop_selection import Candidates, StopDesign, guessed_moments, stop_combinations, with_lever
from calib.plan.types import APPROACH, Sweep, SweepPlan
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.design.selection import select
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.global_fit import predict_covariance
from gcomp.identify.parameters import GAIN_STD, Parameters, Prior
from gcomp.identify.readings import StaticReadings

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
    middle = np.mean(planned.ends, axis=0)
    columns = gravity_regressor(planned.arm, poses)
    chosen = _informative_poses(planned, poses, columns, 10.0, count, middle)
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
    """The combinations along which nothing touches; raises Collided if there is none."""
    ends = candidates.poses[:, [0, -1]]
    ends[:, :, candidates.joint] += -APPROACH, APPROACH
    free = np.array([planned.is_clear(*each) for each in ends])
    if free.any() or planned.geometry is None:
        return candidates.kept(free)
    first, second = next(found for _, touching in planned.geometry.way(*ends[0]) for found in touching).bodies
    raise Collided(
        f"joint {planned.arm.names[candidates.joint]}: in every combination of stops two bodies touch, for example "
        f"{first} and {second}: narrow lower and upper in the arm file"
    )


SIDE = 0.05
"""Lateral offset at which the reference mass is assumed to hang [m]; a choice."""
SCATTER = 1.3
"""Scatter of readings over the noise of their samples, since joints never rest completely: as the fits of
tests/campaigns/random_arms.py find it."""


def predicted_gain_std(
    guess: GravityGuess,
    sweeps: Sequence[Sweep],
    scout: Array,
    mass: float,
    sigma: Array,
    position_offset_std: float,
    position_sigma: Array | float = 0.0,
    point: Prior | None = None,
) -> Array:
    """Standard deviations (n,) of the torque gains after passes without and with `mass` [kg]; inf if not observable.

    scout (P, n) [rad] are poses at which all sensors count; sigma (n,) [N·m] is that of one reading, position_sigma
    (n,) [rad] that of its positions; `point` is the prior on the place of the mass.
    """
    kinematics = guess.kinematics
    positions, counted = [scout], [np.ones(scout.shape, dtype=bool)]
    for sweep in sweeps:
        poses = np.tile(np.array(sweep.rest), (sweep.readings, 1))
        poses[:, sweep.joint] = [sweep.target(index)[0] for index in range(sweep.readings)]
        counts = np.array(sweep.servo)
        counts[sweep.joint] = True
        positions.append(poses)
        counted.append(np.tile(counts, (sweep.readings, 1)))
    position, counts = np.concatenate(positions), np.concatenate(counted)
    torque = np.where(counts, 0.0, np.nan)
    loads = np.repeat([0.0, mass], len(position))
    both = StaticReadings.of(np.tile(position, (2, 1)), np.tile(torque, (2, 1)), SCATTER * sigma, loads)
    unknown = {"gain", "offset", "position_gain", "beta", "rho"}
    priors = {}
    if position_offset_std > 0:
        unknown.add("position_offset")
        priors["position_offset"] = Prior(0.0, position_offset_std)
    tip = kinematics.span[-1] + [SIDE, SIDE, 0.0]
    if point is not None:
        priors["rho"], tip = point, np.asarray(point.mean, dtype=np.float64)
    start = Parameters.nominal(kinematics.n, beta=guess.beta, rho=tip)
    std: Array = predict_covariance(
        kinematics, both, start, unknown=unknown, priors=priors, position_sigma=position_sigma
    ).std.gain
    return std


MASS_SHARES = (0.3, 0.5, 0.7)
"""Shares of the torque beyond gravity that the reference mass may take, tried from the smallest; a choice."""
ASSUMED_GRAVITY = 0.6
"""Share of max_torque that gravity is assumed to take before any measurement: drives have 1.5 to 2.2 times gravity in
tests/calib/drawn_arms.py."""
DEAD_LEVER = 0.005
"""Γ/g below which a joint is swept at one combination, for its offset alone (docs/theory.md, section 4.4)."""
MORE_POSES = 2
"""Stop combinations per joint that may be added, where they suffice for the gains' precision; each takes minutes."""
FINEST = 3.0
"""Largest factor of precision by averaging longer: nine times the samples; a choice."""
HOLDING_RESERVE = 1.1
"""Torque that the drives keep over gravity with the mass on, as a factor: friction and acceleration need the rest."""
TRAVEL_POSES = 400
"""Random poses on the way from one sweep to another at which it is looked whether the mass can be held."""
GRAMS = 100.0
"""Reference mass from which grams may be meant [kg]."""
ENOUGH = 1.2
"""Factor by which the gains may be less precise than asked without a note; a choice."""


def plan_sweep(
    arm_file: ArmFile,
    guess: GravityGuess | None = None,
    *,
    seed: int = 0,
    reference_mass: float = 0.0,
    resolution: Array | None = None,
) -> SweepPlan:
    """The plan of one pass over all joints, tip to base.

    `reference_mass` [kg] is what hangs on the arm during this pass, 0 for nothing; `resolution` (n,) [rad] that of the
    position readings, if known. Without `guess` nothing is known of the masses and no bias torque is set. With the
    scout's guess, combinations that cannot be held within max_torque are left out, the others get their bias torques,
    and up to `MORE_POSES` more a joint are swept if that makes the gains as precise as asked. Poses and
    combinations on whose way something touches give their place to others, as long as there are any. Raises BadInput
    if a joint's range is too short to sweep or no combination can be held.
    """
    planned = PlannedArm(arm_file, guess).require_range()
    section, goal = planned.section, planned.section.gain_std
    options, notes = sweep_options(planned)
    reached = np.concatenate([each.poses.reshape(-1, planned.arm.n) for each in options])
    moments = guessed_moments(planned.arm, seed) if guess is None else [guess.beta]
    given = reference_mass or section.reference_mass
    masses = [given] if given else reference_masses(planned, reached)
    poses = section.loaded_poses if reference_mass else section.poses
    scout = scout_poses(planned, seed)
    while True:
        design = StopDesign.of(planned.arm, options, moments, section.standard_error * planned.limits.rated, masses[-1])
        sweeps, mass, gain_std = _as_exact_as_asked(planned, design, poses, scout, masses, resolution)
        blocked = _first_blocked(planned, np.array(scout[-1]), sweeps)
        if blocked is None:
            break
        same = np.array(blocked.stops)
        left = [
            each.kept((each.stops != same).any(axis=1)) if each.joint == blocked.joint else each for each in options
        ]
        if not all(each.count for each in left):
            break
        options = left
    finer = 1.0 if gain_std is None else float(np.clip(gain_std / goal, 1.0, FINEST))
    if gain_std is not None and gain_std > ENOUGH * FINEST * goal:
        notes.append(
            f"if the mass hangs {100 * np.hypot(SIDE, SIDE):.0f} cm off the last joint's axis, the worst gain that can "
            f"be found will be known to about ± {200 * gain_std / finer:.2g} %, and the goal (sweep.gain_std) is ± "
            f"{200 * goal:.2g} %: go on, or use a heavier mass, more sweep.poses, or a measured sweep.reference_point"
        )
    return SweepPlan(
        sweeps=sweeps,
        scout=scout,
        reference_mass=mass,
        standard_error=section.standard_error / finer,
        travel_acceleration=planned.travel_acceleration(reached),
        gain_std=None if gain_std is None else gain_std / finer,
        notes=tuple(notes),
    )


def refuse_unbearable_mass(arm_file: ArmFile, mass: float, guess: GravityGuess | None) -> None:
    """Raise BadInput where a reference mass [kg] is more than a joint's drive, or another's, can hold while it sweeps.

    `guess` is of the arm alone; without one, gravity counts as nothing. Where the mass hangs beyond the flange is not
    known and counts as nothing, too.
    """
    planned, most = PlannedArm(arm_file, guess).require_range(), {}
    for options in sweep_options(planned)[0]:
        own = 0.0 if guess is None else np.abs(guess.torque(options.poses))
        room = planned.limits.max_torque - own
        bearable = (room / _torque_per_kilogram(planned.arm, options.poses)).min(axis=(1, 2))
        most[planned.arm.names[options.joint]] = max(float(bearable.max()), 0.0)
    name = min(most, key=lambda joint: most[joint])
    if mass > most[name]:
        unit = f"; or do you mean {mass / 1000:g} kg?" if mass >= GRAMS and mass / 1000 < most[name] else ""
        raise BadInput(
            f"--reference-mass {mass:g}: with this mass no sweep of {name} stays within max_torque: attach "
            f"at most {float(f'{most[name]:.2g}'):g} kg{unit}"
        )


def _as_exact_as_asked(
    planned: PlannedArm,
    design: StopDesign,
    poses: int,
    scout: Poses,
    masses: list[float],
    resolution: Array | None,
) -> tuple[tuple[Sweep, ...], float, float | None]:
    """The sweeps, with up to MORE_POSES more a joint where those suffice; mass and worst gain's std as `_lightest`."""
    tried = []
    for more in range(MORE_POSES + 1):
        sweeps = _choose(planned, design, poses + more)
        tried.append((sweeps, *_lightest(planned, sweeps, scout, masses, resolution)))
        if tried[-1][-1] is None or tried[-1][-1] <= FINEST * planned.section.gain_std:
            return tried[-1]
    return tried[0]


def _first_blocked(planned: PlannedArm, here: Array, sweeps: Sequence[Sweep]) -> Sweep | None:
    """The first sweep on whose way, from `here` (n,) [rad] or from the sweep before, something touches."""
    for sweep in sweeps:
        begin, _ = sweep_ends(sweep)
        if not planned.is_clear(here, begin):
            return sweep
        here = begin
    return None


def _choose(planned: PlannedArm, design: StopDesign, poses: int) -> tuple[Sweep, ...]:
    counts = [1 if each.lever.max() < DEAD_LEVER else poses for each in design.candidates]
    picks = design.choose(counts, planned.section.travel_speed * planned.limits.speed)
    return tuple(
        _sweep(planned, f"{planned.arm.names[each.joint]}.{number}", each, pick)
        for each, chosen in zip(design.candidates, picks, strict=True)
        for number, pick in enumerate(chosen, start=1)
    )


def _lightest(
    planned: PlannedArm, sweeps: Sequence[Sweep], scout: Poses, masses: list[float], resolution: Array | None
) -> tuple[float, float | None]:
    """(Lightest of the masses [kg] that gives the gains as exactly as asked, else the heaviest; worst gain's std).

    Without a rough gravity model nothing can be predicted: the heaviest and None.
    """
    if planned.guess is None:
        return masses[-1], None
    section, poses = planned.section, np.array(scout)
    sigma, zero_std = section.standard_error * planned.limits.rated, section.position_offset_std
    rounding = np.zeros(planned.arm.n) if resolution is None else resolution / np.sqrt(12.0)
    for mass in masses:
        std = predicted_gain_std(planned.guess, sweeps, poses, mass, sigma, zero_std, rounding, section.known_point)
        gain_std = float(std[std < GAIN_STD].max(initial=0.0))  # beyond it more averaging cannot help
        if gain_std <= section.gain_std:
            break
    return mass, gain_std


def _sweep(planned: PlannedArm, name: str, options: Candidates, pick: int) -> Sweep:
    section, limits = planned.section, planned.limits
    joint, stops = options.joint, options.stops[pick]
    steps = np.linspace(*planned.sweep_range(joint), section.steps)
    servo, bias, acceleration = _hold(planned, options.kept(np.arange(options.count) == pick))
    low, high = planned.ends
    pressed = np.where(stops > 0, limits.upper, limits.lower)
    rest = np.where(servo, np.where(stops > 0, high, low), pressed)
    rest[joint] = steps[0]
    return Sweep(
        name=name,
        joint=joint,
        stops=tuple(-1 if side < 0 else 1 if side > 0 else 0 for side in stops),
        rest=tuple(rest.tolist()),
        steps=tuple(steps.tolist()),
        lever=float(options.lever[pick]),
        servo=tuple(bool(held) for held in servo),
        bias=None if bias is None else tuple(bias.tolist()),
        acceleration=acceleration,
    )


def _hold(planned: PlannedArm, one: Candidates) -> tuple[Mask, Array | None, float]:
    """(Joints held by servo (n,), signed bias torques of the others (n,) [N·m], acceleration [rad/s²]) at `one`.

    The acceleration is the largest that every joint's torque allows: a servo-held joint resists the swept one's
    reaction with its torque beyond gravity, and the swept joint accelerates with half of it.
    """
    section, limits = planned.section, planned.limits
    joint, stops = one.joint, one.stops[0]
    resting = stops != 0
    servo = resting & (section.hold == "servo")
    if planned.guess is None:
        return servo, None, section.acceleration
    servo = servo | (resting & ~planned.pressable_joints(one)[0])
    pressed = resting & ~servo
    needed, reaction = planned.required_bias(one)[0], planned.reaction_bound(joint)
    least, largest, _ = planned.hold_torque(one.poses)
    spare = limits.max_torque - np.maximum(np.abs(least), np.abs(largest))[0]
    left = np.where(pressed, planned.given_bias - needed, spare)
    left[joint] = spare[joint] / 2
    acceleration = float(np.clip((left / np.maximum(reaction, 1e-9)).min(), SLOWEST, section.acceleration))
    size = planned.given_bias
    if section.bias_torque is None:
        size = np.minimum(needed + acceleration * reaction, limits.max_torque)
    return servo, stops * np.where(pressed, size, 0.0), acceleration


def reference_masses(planned: PlannedArm, poses: Array) -> list[float]:
    """Masses [kg] that take `MASS_SHARES` of the torque left at the joint that they load most, to two digits.

    `poses` (K, n) [rad] are those of all sweeps that may be planned.
    """
    limits, guess = planned.limits, planned.guess
    per_kg = _torque_per_kilogram(planned.arm, poses, HAND)
    gravity = ASSUMED_GRAVITY * limits.max_torque if guess is None else np.abs(guess.torque(poses)).max(axis=0)
    room = np.maximum(limits.max_torque - gravity, 0.05 * limits.max_torque)
    most = float(np.min(room / per_kg.max(axis=0)))
    most = min(most, 2 * float(limits.rated.max()) / (9.81 * float(reach(planned.arm)[0])))
    on_the_way = np.inf if guess is None else _bearable_on_the_way(limits.max_torque, guess, poses, most)
    return [float(f"{min(share * most, on_the_way):.2g}") for share in MASS_SHARES]


def _bearable_on_the_way(max_torque: Array, guess: GravityGuess, poses: Array, most: float) -> float:
    """Mass [kg] that the drives hold with `HOLDING_RESERVE` on straight ways from one sweep's poses to another's."""
    random = np.random.default_rng(0)
    begin, end = poses[random.integers(len(poses), size=(2, TRAVEL_POSES))]
    way = begin + random.uniform(size=(TRAVEL_POSES, 1)) * (end - begin)
    room = max_torque / HOLDING_RESERVE - np.abs(guess.torque(way))
    return max(float(np.min(room / _torque_per_kilogram(guess.kinematics, way, HAND))), MASS_SHARES[0] * most / 2)


def _torque_per_kilogram(kinematics: Arm, poses: Array, hand: float = 0.0) -> Array:
    """Largest torque (…, n) [N·m] of 1 kg that hangs within `hand` [m] of the flange at poses (…, n) [rad]; not 0."""
    regressor, (at_origin, by_point) = gravity_regressor(kinematics, poses), payload_columns(kinematics)
    torque = np.abs(regressor @ (at_origin + by_point @ kinematics.span[-1]))
    return np.asarray(np.maximum(torque + hand * np.linalg.norm(regressor @ by_point, axis=-1), 1e-9))
