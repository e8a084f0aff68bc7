"""Plan of a pass of creep sweeps, tip to base: free of collisions, within the drives' torque.

Of the creeps that are possible, those are chosen whose poses of the other joints leave the torque constants least
uncertain.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.plan.collisions import TO_THE_PLAN, Geometry, require_free
from calib.plan.plan_limits import ROUNDING, refuse_unfit, require_bounds
from calib.plan.planned_arm import COLLIDING, PlannedArm
from calib.plan.rough_gravity import NO_LEVER, SHORTEST, VERTICAL, guess_of_file, is_vertical, known_lever
from calib.plan.sweep_plan import MASS_SHARES
from calib.plan.types import Side, Sweep, SweepPlan
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.estimate.posterior import invert
from gcomp.gravity.torque import gravity_levers, gravity_regressor
from gcomp.identify.motor_model import MotorModel, family_slices
from gcomp.identify.readings import StaticReadings

SCATTER_SHARE = 0.003
"""Scatter of a row, as a share of rated torque, that the choice assumes."""
BINS = 10
"""Rows per direction with which a candidate is judged."""


@dataclass(frozen=True, eq=False)
class CreepCandidate:
    """One creep: the other joints' poses, and both ends of the joint's way."""

    joint: int
    rest: Array
    """(n,) [rad]; the creeping joint's entry is not used."""
    lower: float
    """[rad]."""
    upper: float
    """[rad]."""

    def poses(self, count: int) -> Array:
        """Poses along the way (count, n) [rad]."""
        poses = np.tile(self.rest, (count, 1))
        poses[:, self.joint] = np.linspace(self.lower, self.upper, count)
        return poses


def choose(
    creeping: "CreepingArm", candidates: list[list[CreepCandidate]], mass: float
) -> tuple[list[list[CreepCandidate]], Array]:
    """(Candidates of each list, tip to base; standard deviations of the gains that they promise (n,)).

    Greedy: each choice makes the sum of the gains' variances least, with one pass without and one with the mass [kg].
    """
    arm, rated, section = creeping.arm, creeping.limits.rated, creeping.section
    mean, std = section.motor_doubt.prior(arm, rated, True, 0.02 * rated)
    x, at = mean.copy(), family_slices(arm.n)
    x[at["beta"]], x[at["coulomb"]], x[at["load"]] = creeping.beta, 0.02 * rated, 0.05
    information = np.diag(1 / std**2)
    speed = section.creep.speeds[0]
    rows = [[_information(arm, x, one, speed, mass, rated) for one in each] for each in candidates]
    chosen: list[list[CreepCandidate]] = [[] for _ in candidates]
    gains = at["gain"]
    for _ in range(section.creep.poses):
        for place, each in enumerate(candidates):
            costs = [float(np.diag(invert(information + one))[gains].sum()) for one in rows[place]]
            best = int(np.argmin(costs))
            information = information + rows[place][best]
            chosen[place].append(each[best])
    return chosen, np.sqrt(np.diag(invert(information))[gains])


def _information(arm: Arm, x: Array, one: CreepCandidate, speed: float, mass: float, rated: Array) -> Array:
    """Information of a creep both ways, without and with the mass (P, P)."""
    poses = np.tile(one.poses(BINS), (4, 1))
    side, loads = np.repeat([1.0, -1.0, 1.0, -1.0], BINS), np.repeat([0.0, 0.0, mass, mass], BINS)
    own = np.arange(arm.n) == one.joint
    readings = StaticReadings(
        poses,
        np.where(own, 0.0, np.nan) * np.ones((len(poses), 1)),
        np.ones(arm.n),
        load=loads,
        velocity=np.outer(side * speed, own),
        warmth=np.outer(np.repeat([-10.0, -10.0, -5.0, -5.0], BINS), own),
    )
    _, jacobian = MotorModel(arm, readings).linearised(x)
    jacobian /= SCATTER_SHARE * rated[one.joint]
    return jacobian.T @ jacobian


CANDIDATES = 24
"""Creeps of each joint among which the plan chooses."""
DRAWS = 40
"""Draws for each candidate before too much of the range counts as blocked."""
BLIND_SHARE = 0.15
"""Share of max_torque that the reference mass may take where no model file tells what the arm itself weighs."""
WORST_CONSTANT = 1.6
"""A drive may have to be asked for so many times the true torque."""
TRAVEL_ACCELERATION = 1.5
"""Largest acceleration from one creep to the next [rad/s²]; a choice: the arm hangs in soft position loops."""
HAND = 0.12
"""Distance of the mass from the flange that the plan allows for [m]."""
TRAVEL_SECONDS = 6.0
"""Rough time from one creep to the next [s]."""
RAMP = 0.4
"""Time over which a creep reaches its speed, and comes to rest [s]."""
SETTLE = 0.4
"""Time after that in which friction has turned round and the position loop has settled [s]."""


class CreepingArm(PlannedArm):
    """An arm in whose plan joints creep."""

    def __init__(self, arm_file: ArmFile) -> None:
        """Raises BadInput where a range is too short or the model cannot be used."""
        super().__init__(arm_file, guess_of_file(arm_file))
        self.require_range()

    @property
    def beta(self) -> Array:
        """Guess of the mass moments (2n,) [kg·m]."""
        if self.guess is not None:
            return self.guess.beta
        share = 0.2 * self.limits.rated / float(np.linalg.norm(self.arm.gravity))
        return np.column_stack([share, 0 * share]).ravel()

    @property
    def ends(self) -> tuple[Array, Array]:
        """Lower and upper ends of the joints' ways (n,) [rad]; twice the doubt of the zero away from the stops."""
        margin = self.section.range_margin + 2 * self.section.creep.zero_std
        return self.limits.lower + margin, self.limits.upper - margin

    def mass(self) -> float:
        """Reference mass to attach [kg]."""
        if self.section.reference_mass is not None:
            return self.section.reference_mass
        at_origin, by_point = payload_columns(self.arm)
        each = gravity_regressor(self.arm, self.drawn_poses(400, np.random.default_rng(0)))
        per_kg = np.abs(each @ at_origin) + HAND * np.linalg.norm(each @ by_point, axis=-1)
        share = BLIND_SHARE if self.guess is None else MASS_SHARES[0]
        most = share * self.limits.max_torque / np.maximum(per_kg.max(axis=0), 1e-9)
        return float(f"{float(most.min()):.2g}")

    def bearable(self, one: CreepCandidate, mass: float) -> bool:
        """Whether every drive can hold its joint along a creep with the mass, however wrong its constant may be."""
        at_origin, by_point = payload_columns(self.arm)
        each = gravity_regressor(self.arm, one.poses(6))
        torque = np.abs(each @ (self.beta + mass * at_origin)) + mass * HAND * np.linalg.norm(each @ by_point, axis=-1)
        return bool((WORST_CONSTANT * torque <= self.limits.max_torque).all())


def plan_creep(arm_file: ArmFile, *, seed: int = 0) -> SweepPlan:
    """The sweeps of one pass; every pass of an arm has the same ones. Raises BadInput where the arm cannot be swept."""
    creeping = CreepingArm(arm_file)
    creep, n, mass = creeping.section.creep, creeping.arm.n, creeping.mass()
    random = np.random.default_rng([seed, 19])
    home = _home(creeping, random)
    lists = [_candidates(creeping, joint, home, mass, random) for joint in reversed(range(n))]
    chosen, promised = choose(creeping, lists, mass)
    sweeps = []
    for each in chosen:
        for number, one in enumerate(each):
            sweeps.append(_sweep(creeping, one, number, creep.speeds[number % len(creep.speeds)]))
    blind = [creeping.arm.names[joint] for joint in range(n) if is_vertical(creeping.arm, joint)]
    notes = tuple(f"{name}: {VERTICAL}" for name in blind)
    if creeping.section.known_point is None and known_lever(creeping.arm) < SHORTEST:
        notes = (*notes, f"{arm_file.name}: {NO_LEVER}")
    return SweepPlan(
        sweeps=tuple(sweeps),
        scout=(tuple(home.tolist()),),
        reference_mass=mass,
        standard_error=creeping.section.standard_error,
        travel_acceleration=min(creeping.section.acceleration, TRAVEL_ACCELERATION),
        gain_std=float(promised[[j for j in range(n) if creeping.arm.names[j] not in blind]].max(initial=0.0)),
        notes=notes,
    )


def refuse_unbearable_creeps(arm_file: ArmFile, mass: float) -> None:
    """Raise BadInput, naming the joint, where the drives cannot hold a reference mass [kg] in any creep."""
    creeping = CreepingArm(arm_file)
    random = np.random.default_rng(0)
    home = _home(creeping, random)
    for joint in range(creeping.arm.n):
        _candidates(creeping, joint, home, mass, random)


def check_creep_limits(creeping: CreepingArm, arm_file: ArmFile, plan: SweepPlan) -> None:
    """Raise Refused, naming sweep, joint and value, where a plan of creeps leaves what this one would plan within."""
    require_bounds(arm_file, plan, creeping.ends, creeping.ends)
    refuse_unfit(arm_file, _unfit(creeping, plan))


def check_creeps(arm_file: ArmFile, geometry: Geometry, plan: SweepPlan, here: Array) -> None:
    """Check every creep of a plan, and the way to it from the home pose, which is reached from `here` (n,) [rad].

    Raises Collided naming bodies, sweep and pose.
    """
    home = np.array(plan.scout[0])
    ways = [(TO_THE_PLAN, here, home)]
    for sweep in plan.sweeps:
        begin, end = (np.array(sweep.rest) for _ in range(2))
        begin[sweep.joint], end[sweep.joint] = creep_ends(sweep)
        ways += [(f"on the way to sweep {sweep.name}", home, begin), (f"in sweep {sweep.name}", begin, end)]
    require_free(arm_file, geometry, ways)


def _unfit(creeping: CreepingArm, plan: SweepPlan) -> Iterator[str]:
    mass, (lowest, highest) = creeping.mass(), creeping.ends
    most = min(creeping.section.acceleration, TRAVEL_ACCELERATION)
    if not 0 < plan.travel_acceleration <= most * (1 + ROUNDING):
        yield f"travel_acceleration is {plan.travel_acceleration:g} rad/s², expected at most {most:g}"
    for sweep in plan.sweeps:
        speed, (lower, upper) = creep_speed(sweep), creep_ends(sweep)
        fastest = min(max(creeping.section.creep.speeds), creeping.limits.speed[sweep.joint])
        if speed > fastest * (1 + ROUNDING):
            yield f"sweep {sweep.name}: speed is {speed:g} rad/s, expected at most {fastest:g} rad/s"
        low, high = lowest[sweep.joint], highest[sweep.joint]
        if lower < low - ROUNDING or upper > high + ROUNDING:
            yield (
                f"sweep {sweep.name} goes from {lower:.4g} to {upper:.4g} rad: it must stay between {low:.4g} "
                f"and {high:.4g} rad"
            )
        if not creeping.bearable(CreepCandidate(sweep.joint, np.array(sweep.rest), lower, upper), mass):
            yield f"sweep {sweep.name}: with {mass:g} kg, a drive cannot hold its joint in this sweep within max_torque"


def creep_seconds(plan: SweepPlan) -> Array:
    """Rough duration (sweeps,) of each sweep of a pass of creeps, with the way to it [s]."""
    seconds = list[float]()
    for sweep in plan.sweeps:
        speed = creep_speed(sweep)
        way = (sweep.steps[-1] - sweep.steps[0]) * (1 + 1 / (len(sweep.steps) - 1)) + 2 * lead_way(speed)
        seconds.append(2 * way / speed + TRAVEL_SECONDS)
    return np.array(seconds)


def creep_speed(sweep: Sweep) -> float:
    """Of a planned creep [rad/s]; raises BadInput for a sweep that has none."""
    if sweep.speed is None:
        raise BadInput(f"sweep {sweep.name} has no `speed`: set `sweep.motion: steps` in the arm file, or plan again")
    return sweep.speed


def lead_way(speed: float) -> float:
    """Way at either end of a creep that does not count [rad]."""
    return speed * (RAMP / 2 + SETTLE)


def creep_ends(sweep: Sweep) -> tuple[float, float]:
    """Both ends of a planned creep's way, with the lead at either [rad]."""
    middles = sweep.steps
    half = (middles[1] - middles[0]) / 2 + lead_way(creep_speed(sweep))
    return middles[0] - half, middles[-1] + half


def _sweep(creeping: CreepingArm, one: CreepCandidate, number: int, speed: float) -> Sweep:
    speed = min(speed, (one.upper - one.lower) / 4 / lead_way(1.0))
    lead = lead_way(speed)
    way = one.upper - one.lower - 2 * lead
    count = max(round(way / creeping.section.creep.bin), 4)
    width = way / count
    no_stop: Side = 0
    rest = one.rest.copy()
    rest[one.joint] = one.lower
    lever = gravity_levers(creeping.arm, one.poses(3))[:, one.joint].max() / np.linalg.norm(creeping.arm.gravity)
    return Sweep(
        name=f"{creeping.arm.names[one.joint]} creep {number + 1}",
        joint=one.joint,
        stops=tuple(no_stop for _ in range(creeping.arm.n)),
        rest=tuple(rest.tolist()),
        steps=tuple((one.lower + lead + width * (np.arange(count) + 0.5)).tolist()),
        lever=float(lever),
        servo=(True,) * creeping.arm.n,
        speed=speed,
    )


def _home(creeping: CreepingArm, random: np.random.Generator) -> Array:
    """A pose from which creeps are reached: the middle of the ranges, or the first free one drawn."""
    middle = np.asarray(np.mean(creeping.ends, axis=0))
    if creeping.free(middle[None]).all():
        return middle
    for _ in range(20 * DRAWS):
        pose = random.uniform(*creeping.ends)
        if creeping.free(pose[None]).all():
            return np.asarray(pose)
    raise BadInput(COLLIDING)


def _candidates(
    creeping: CreepingArm, joint: int, home: Array, mass: float, random: np.random.Generator
) -> list[CreepCandidate]:
    lowest, highest = creeping.ends
    low, high = float(lowest[joint]), float(highest[joint])
    span, found = min(high - low, creeping.section.creep.span), list[CreepCandidate]()
    for _ in range(CANDIDATES * DRAWS):
        lower = random.uniform(low, high - span) if high - low > span else low
        one = CreepCandidate(joint, random.uniform(lowest, highest), lower, lower + span)
        begin, end = one.poses(2)
        if creeping.is_clear(begin, end) and creeping.is_clear(home, begin) and creeping.bearable(one, mass):
            found.append(one)
            if len(found) == CANDIDATES:
                break
    if not found:
        raise BadInput(
            f"joint {creeping.arm.names[joint]}: no creep of {span:.2f} rad is free of collisions and within "
            f"max_torque with {mass:g} kg: shorten sweep.creep.span, choose a smaller sweep.reference_mass, "
            "or narrow lower and upper of the other joints in the arm file"
        )
    return found
