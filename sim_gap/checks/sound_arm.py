"""How likely a torque channel is for a sound arm: the model, with effects of usual size.

A joint has a gain, an offset, a spring, friction and a rotor of its own; the arm has masses that are elsewhere on each
link, a load at its tip, and a base that is tilted. All are linear, with priors, and so a wrong mass, a tool or a
counterbalance is no evidence of a wrong column (docs/theory.md, section 14).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arm.rigid_body import CREEP, INERTIAL, RigidArm
from gcomp.arrays import Array, Mask
from gcomp.estimate.linear_terms import PRICE, REWEIGHINGS, LinearTerms, fold_sums
from sim_gap.checks.positions import beyond_range
from sim_gap.residuals.preprocess import PreparedSignals
from sim_gap.residuals.residual_set import FOLDS

ROWS = 1500
"""Rows that are looked at."""


@dataclass(frozen=True, eq=False)
class ChannelMotion:
    """Positions, velocities, accelerations and one torque channel, (K, n) each."""

    q: Array
    v: Array
    a: Array
    reading: Array
    """NaN where there is none."""
    channel: str
    duration: float
    """Time from the first row to the last [s]."""
    size: Array
    """Standard deviation of what is recorded, in the unit of the reading, (n,): of a torque in another unit, say."""
    count: Array
    """Independent measurements of each reading, (n,)."""
    least: Array
    """Least that models of sound arms leave of each reading, standard deviation (n,)."""
    idle: Mask
    """Whether each reading may have nothing of the model's torque, (n,): of a motor that is idle, a dead sensor."""
    rubs: bool = True
    """Whether the friction of gears may be in the readings, as in a motor's."""

    @property
    def direction(self) -> Array:
        """Sign of the velocity, rounded off around zero (K, n)."""
        return np.clip(self.v / CREEP, -1.0, 1.0)

    @property
    def telling(self) -> Mask:
        """Rows that tell something of each joint, (K, n): friction at rest, which a motor holds, takes any value."""
        return _telling(self.v, self.reading, self.channel == "tau")

    def thinned(self, count: int) -> "ChannelMotion":
        """Some `count` of its rows or more, evenly spread."""
        step = max(1, len(self.q) // count)
        q, v, a, reading = (x[::step] for x in (self.q, self.v, self.a, self.reading))
        return replace(self, q=q, v=v, a=a, reading=reading)


def _telling(v: Array, reading: Array, of_sensor: Mask | bool) -> Mask:
    return np.asarray(((np.abs(v) > CREEP) | of_sensor) & np.isfinite(reading))


def motion_of(s: PreparedSignals, channel: str) -> ChannelMotion:
    """The compared rows of a recording, thinned to about `ROWS`. A sensor on the link feels no gear; where the motor's
    torque is recorded too, what it feels is behind it. Models leave the noise and a share of the torques of gravity and
    inertia, which may be more than their sum."""
    t = s.filtered(s.t)
    thin = slice(None, None, max(1, len(t) // ROWS))
    q, v, a, reading = (s.filtered(x)[thin] for x in (s.q, s.v, s.a, s.reading[channel]))
    size, idle = reading.std(0), np.ones(reading.shape[1], bool)
    rubs = channel != "tau" or "tau_motor" in s.reading
    model, weight = s.arm.carried(q, v, a), s.arm.gravity_torque(q)
    parts = np.hypot(weight.std(0), (model - weight).std(0)) / np.maximum(model.std(0), SMALLEST_TORQUE)
    least = np.hypot(s.noise[channel], LEAST_RESIDUAL * np.maximum(size, SMALLEST_TORQUE) * np.maximum(parts, 1.0))
    count = measurements(q, v, size, duration := float(t[-1] - t[0]))
    return ChannelMotion(q, v, a, reading, channel, duration, size, count, least, idle, rubs)


ERROR_STD = 0.3
"""Standard deviation of gains, masses, springs and offsets of sound arms, as a share of what they change; of the
direction of gravity and of zeros [rad]."""
BEARING_FRICTION_STD = 0.01
"""The same of the friction that sensors on the links feel, over the torque of the arm stretched out: 0.3 N·m of 72 on
Panda, 0.2 of 79 on LWR4+; bearings and seals differ from joint to joint."""
LEAST_RESIDUAL = 0.14
"""Least share of a reading's standard deviation that models of sound arms leave, with these effects."""
MEASUREMENTS_PER_STROKE, MOST_MEASUREMENTS = 6.0, 100.0
"""Independent measurements in a stroke of twice the standard deviation of a joint's positions, for what is left is a
function of the pose; most of a recording."""
LEAST_TORQUE_SHARE = 0.1
"""Errors of a joint that carries next to nothing, over those of the one that carries most: sensors, cables and tools
pull at a slim wrist, too."""
LOAD_DISTANCE_STD = 0.2
"""Standard deviation of the distance of a load from the last joint, over the arm's length."""
LOAD_GYRATION = 0.5
"""Radius of gyration of a load about the last link's frame, over LOAD_DISTANCE_STD."""
INERTIA_DIAGONAL = np.isin(INERTIAL[4:], ("ixx", "iyy", "izz"))
"""Which inertias of a link are moments, of which a load cannot take off more than there is."""
SMALLEST_STROKE, SMALLEST_MOVING_SHARE = 0.05, 0.1
"""Stroke from which a joint moves [rad], and share of the rows in which it must."""
SMALLEST_TORQUE = 1e-9
"""Standard deviation from which a reading changes [N·m]."""
ERROR_LIMITS = {"gain": (-0.35, 1.0), "mass": (-0.3, 0.3)}
"""Least and largest such error of a sound arm, as a share: a torque below a third of the model's is in another unit."""
IDLE_COST = 4.0 * PRICE
"""Negative log likelihood of a motor that is idle, or of a dead sensor: the price of an effect that few arms have."""
CERTAIN_COST = 5.0 * PRICE
"""Negative log likelihood of what no sound arm has, such as a joint beyond its range: as rare an effect as any of the
library has paid then, and the choice among the hundred changes that are looked at."""
JOINT_EFFECTS, FRICTION_EFFECTS, CARRIED = 6, 3, (0, 2)
"""Effects of a joint that act on it alone; those of them that are friction and a rotor; places of those in which the
pose shows, which an idle motor or a dead sensor has not: the model's torque and a spring."""
BOUND_WEIGHT = 1e12
"""Weight of a coefficient that is held at a bound."""
ROWS_AT_ONCE = 60_000
"""Rows of joints that are fitted in one array."""


def measurements(q: Array, v: Array, size: Array, duration: float) -> Array:
    """Independent measurements of each joint (n,), by the way that the joints make, in strokes; none of one that hardly
    moves (q, v (K, n)) or whose reading (of standard deviation `size`) never changes."""
    stroke = 2.0 * q.std(0)
    moving = (stroke > SMALLEST_STROKE) & (np.mean(np.abs(v) > CREEP, axis=0) > SMALLEST_MOVING_SHARE)
    strokes = np.where(moving, 1.0 / np.maximum(stroke, SMALLEST_STROKE), 0.0)
    squares = ((v * strokes) ** 2).sum(1) / max(int(moving.sum()), 1)
    count = min(MEASUREMENTS_PER_STROKE * float(np.sqrt(squares).mean()) * duration, MOST_MEASUREMENTS)
    return np.asarray(count * (moving & (size > SMALLEST_TORQUE)))


def _own_columns(
    scale: Array, most: Array, rubs: Mask, model: Array, reading: Array, q: Array, v: Array, a: Array
) -> tuple[Array, Array]:
    """Columns of the P own effects of each joint (…, n, P, K), friction and rotor at the end, which are not negative,
    and their standard deviations (…, n, P), of arrays (…, K, n); `scale` (…, n) by `_model_size`, `most` (…, 1) the
    torque of the arm stretched out or more, `rubs` (…) as in `ChannelMotion`."""
    turned, direction = q - q.mean(-2, keepdims=True), np.clip(v / CREEP, -1.0, 1.0)
    turned = turned / np.maximum(turned.std(-2, keepdims=True), 1e-9)
    own = [model / scale[..., None, :], np.ones_like(q), turned, direction, v, a]
    columns = np.moveaxis(np.stack(own, axis=-3), -1, -3)
    rubbing = np.maximum(np.stack([x.std(-2) for x in own[JOINT_EFFECTS - FRICTION_EFFECTS :]], axis=-1), 1e-9)
    pulled = np.maximum(scale, np.sqrt(np.mean(reading**2, axis=-2)))  # by springs, whatever the links weigh
    friction = most[..., None] * np.where(rubs, 1.0, BEARING_FRICTION_STD)[..., None, None] / rubbing
    usual = ERROR_STD * np.stack([scale, pulled, pulled], axis=-1)
    return columns, np.concatenate([usual, friction], axis=-1)


def quick_costs(arm: RigidArm, models: Array, motions: Sequence[ChannelMotion], moved: Sequence[int]) -> Array:
    """Negative log likelihood of each of several motions, by each joint's own effects alone, (M,); model torques
    (M, K, n). All but those numbered in `moved` differ from the first in some readings alone."""
    reading = np.array([motion.reading for motion in motions])
    own = np.any((reading != reading[0]) & ~(np.isnan(reading) & np.isnan(reading[0])), axis=1)
    own[[0, *moved]] = True
    scale = _model_size(models)
    most = np.maximum(arm.stretched_torque, scale.max(-1, keepdims=True))
    costs, pairs = np.zeros(own.shape), np.argwhere(own)
    for part in np.array_split(pairs, -(-len(pairs) * models.shape[1] // ROWS_AT_ONCE)):
        which, joint = part.T
        model = models[which, :, joint][:, :, None]
        costs[which, joint] = _stacked_costs(model, scale[which, joint][:, None], most[which], motions, which, joint)
    beyond = {k: CERTAIN_COST * beyond_range(arm, motions[k].q) for k in {0, *moved}}
    costs += np.array([beyond.get(k, beyond[0]) for k in range(len(motions))])
    return np.asarray(np.where(own, costs, costs[0]).sum(1))


def _stacked_costs(
    model: Array,
    scale: Array,
    most: Array,
    motions: Sequence[ChannelMotion],
    which: NDArray[np.intp],
    joint: NDArray[np.intp],
) -> Array:
    """The same of some joints of some motions within their ranges, (P,): arrays of one joint each, (P, K, 1); `scale`
    and `most` (P, 1) as in `_own_columns`."""
    size, count, floor, idle = (
        np.array([getattr(motions[m], name)[j] for m, j in zip(which, joint, strict=True)])[:, None]
        for name in ("size", "count", "least", "idle")
    )
    q, v, a, read = (
        np.array([getattr(motions[m], name)[:, j] for m, j in zip(which, joint, strict=True)])[:, :, None]
        for name in ("q", "v", "a", "reading")
    )
    rubs, of_sensor = np.array([(motions[m].rubs, motions[m].channel == "tau") for m in which]).T
    telling = _telling(v, read, of_sensor[:, None, None])
    reading = np.where(np.isfinite(read), read, model)
    columns, spread = _own_columns(scale, most, rubs, model, reading, q, v, a)
    own = np.concatenate([columns, (reading - model).swapaxes(1, 2)[:, :, None]], axis=2)
    weight = telling / np.maximum(telling.sum(1, keepdims=True), 1)
    gram = (own * weight.swapaxes(1, 2)[:, :, None]) @ own.swapaxes(2, 3)
    low, high = _own_limits(spread)
    whole = _fitted_cost(gram, spread, low, high, count, floor)
    turn = np.broadcast_to(np.eye(JOINT_EFFECTS + 1), gram.shape).copy()
    turn[..., JOINT_EFFECTS, 0] = scale
    without = turn @ gram @ turn.swapaxes(2, 3)  # with the reading itself in place of what the model leaves of it
    without[..., CARRIED, :], without[..., :, CARRIED] = 0.0, 0.0
    other = _fitted_cost(without, spread, np.full_like(low, -np.inf), high, count, floor) + IDLE_COST
    whole = np.where(idle & (reading.std(1) < model.std(1)), np.minimum(whole, other), whole)
    return np.asarray((whole - count * np.log(np.maximum(size, SMALLEST_TORQUE)))[:, 0])


def _model_size(model: Array) -> Array:
    """Torque in proportion to which each joint of a sound arm has its errors, (…, n); model torques (…, K, n)."""
    size = model.std(-2)
    return np.asarray(np.maximum(size, np.maximum(LEAST_TORQUE_SHARE * size.max(-1, keepdims=True), 1e-9)))


def _fitted_cost(gram: Array, spread: Array, low: Array, high: Array, count: Array, floor: Array) -> Array:
    """Negative log likelihood of a joint's own effects, from the mean products of columns and reading, (…)."""
    squares, side, total = gram[..., :JOINT_EFFECTS, :JOINT_EFFECTS], gram[..., :JOINT_EFFECTS, -1], gram[..., -1, -1]
    variance, held, at = total + floor**2, np.zeros(side.shape, bool), np.zeros_like(side)
    for _ in range(REWEIGHINGS):
        prior = variance[..., None] / spread**2 / np.maximum(count, 1e-9)[..., None]
        aim = np.where(held, BOUND_WEIGHT * at, side)
        solved = np.linalg.solve(
            squares + np.where(held, BOUND_WEIGHT, prior)[..., None] * np.eye(JOINT_EFFECTS), aim[..., None]
        )[..., 0]
        at = np.clip(solved, low, high)
        held |= at != solved
        left = total - 2.0 * (at * side).sum(-1) + ((squares @ at[..., None])[..., 0] * at).sum(-1)
        variance = np.maximum(left, 0.0) + floor**2
    return np.asarray(0.5 * count * np.log(variance) + 0.5 * ((at / spread) ** 2).sum(-1))


def _own_limits(spread: Array) -> tuple[Array, Array]:
    """Least and largest of each joint's own coefficients, (…, P)."""
    low, high = np.full(spread.shape, -np.inf), np.full(spread.shape, np.inf)
    low[..., -FRICTION_EFFECTS:] = 0.0
    for limits, share in zip((low, high), ERROR_LIMITS["gain"], strict=True):
        limits[..., 0] = share / ERROR_STD * spread[..., 0]
    return low, high


@dataclass(frozen=True, eq=False)
class ChannelLikelihood:
    """Negative log likelihood of a channel under a sound arm."""

    costs: Array
    """Of each joint in each held-out part, (n, F)."""
    idle: Mask
    """Whether each reading has nothing of the model's torque, (n,)."""


def likelihood(arm: RigidArm, motion: ChannelMotion) -> ChannelLikelihood:
    """Likelihood of held-out parts of a channel, by the likelier of the arm as modelled and as it seems to hang."""
    own = _likelihood(arm, motion)
    turned = _turned_arm(arm, motion)
    if turned is None:
        return own
    other = _likelihood(turned, motion)
    return other if other.costs.sum() + 2.0 * PRICE < own.costs.sum() else own


def _likelihood(arm: RigidArm, motion: ChannelMotion) -> ChannelLikelihood:
    """The same of the arm as it is given. The reading of a motor that is idle, or of a dead sensor, is less than the
    model's torque and has nothing of it, at a price."""
    model = arm.carried(motion.q, motion.v, motion.a)
    reading = np.where(np.isfinite(motion.reading), motion.reading, model)
    scale = _model_size(model)
    most = np.maximum(arm.stretched_torque, scale.max(-1, keepdims=True))
    own, spread = _own_columns(scale, most, np.array(motion.rubs), model, reading, motion.q, motion.v, motion.a)
    limits = _own_limits(spread)
    shared = _shared_columns(arm, motion)
    left = (reading - model).T
    costs = _fit(motion, left, own, spread, limits, shared)
    idle = motion.idle & (reading.std(0) < model.std(0))
    if idle.any():
        kept = np.setdiff1d(np.arange(JOINT_EFFECTS), CARRIED)
        free = np.full_like(spread[:, kept], -np.inf), np.full_like(spread[:, kept], np.inf)
        none = np.zeros((0, *left.shape)), np.zeros(0), np.zeros((2, 0))
        without = _fit(motion, reading.T, own[:, kept], spread[:, kept], free, none) + IDLE_COST / FOLDS
        idle &= without.sum(1) < costs.sum(1)
    if idle.any():
        costs = np.where(idle[:, None], without, _fit(motion, left, own, spread, limits, shared, ~idle))
    return ChannelLikelihood(costs + CERTAIN_COST / FOLDS * beyond_range(arm, motion.q)[:, None], idle)


Columns = tuple[Array, Array, Array]
"""Columns (S, n, K) of effects of all joints, their standard deviations (S,) and limits (2, S)."""


def _fit(
    motion: ChannelMotion,
    reading: Array,
    own: Array,
    own_spread: Array,
    own_limits: tuple[Array, Array],
    of_all: Columns,
    counted: Mask | bool = True,
) -> Array:
    """Negative log likelihood of readings (n, K) by columns of each joint's own (n, P, K) and of all joints; of joints
    that are not `counted` nothing follows for the others."""
    shared, shared_spread, shared_limits = of_all
    n, width, _ = own.shape
    telling = motion.telling
    spread = np.concatenate([own_spread.ravel(), shared_spread])
    read = np.cumsum(np.isfinite(motion.reading).any(1))
    fold = np.maximum(read - 1, 0) * FOLDS // read[-1]
    weight = telling.T * (motion.count / np.maximum(telling.sum(0), 1) * counted)[:, None]
    alone, common = np.arange(width), n * width + np.arange(len(shared))
    acting = tuple(np.concatenate([j * width + alone, common]) for j in range(n))
    columns = (-np.vstack([own[j], shared[:, j]]) for j in range(n))
    squares, products, totals, counts = fold_sums(columns, reading, weight, fold)
    low, high = (np.concatenate([x.ravel(), y]) for x, y in zip(own_limits, shared_limits, strict=True))
    none = np.zeros(len(spread))
    terms = LinearTerms(
        none, acting, squares, products, totals, counts, motion.least**2, motion.least, none,
        1.0 / spread**2, none, low, high,
    )  # fmt: skip
    every = range(len(spread))
    terms = terms.reweighed(every)
    usual = 0.5 * terms.prior * terms.fit(every) ** 2
    by_joint = usual[: n * width].reshape(n, width).sum(1) + usual[n * width :].sum() / n
    left = np.stack([terms.left(terms.fit(every, f), f) for f in range(FOLDS)], axis=1)
    size = np.sqrt(left / np.maximum(terms.counts, 1e-9) + motion.least[:, None] ** 2)
    share = size / np.maximum(motion.size, SMALLEST_TORQUE)[:, None]
    return np.asarray(terms.counts * np.log(share) + by_joint[:, None] / FOLDS)


def _shared_columns(arm: RigidArm, motion: ChannelMotion) -> Columns:
    """The mass moments of every link, a load at the last one, and gravity's direction."""
    links = arm.motion(motion.q, motion.v, motion.a)
    lengths, masses = np.linalg.norm(arm.offset, axis=1), arm.inertial[:, 0]
    reach, load = LOAD_DISTANCE_STD * float(lengths[1:].sum()), ERROR_STD * float(masses.sum())
    columns, spread, limits = list[Array](), list[float](), list[tuple[float, float]]()
    for j in range(arm.n):
        beyond = [lengths[k] for k in range(arm.n) if arm.parent[k] == j]
        own = arm.link_regressor(links, j).transpose(2, 1, 0)
        moment = float(np.linalg.norm(arm.inertial[j, 1:4]))
        size = ERROR_STD * max(moment, 0.5 * masses[j] * max(beyond, default=0.0), 1e-9)
        if beyond:
            low, high = ERROR_LIMITS["mass"]
            limits += 3 * [(low / ERROR_STD * size, high / ERROR_STD * size)]
        else:
            size = max(size, load * reach)
            columns += [own[0], *own[4:]]
            spread += [max(load, 1e-9), *6 * [max(load * LOAD_GYRATION**2 * reach**2, 1e-9)]]
            least = np.where(INERTIA_DIAGONAL, -arm.inertial[j, 4:], -np.inf)
            limits += [(-masses[j], np.inf), *((low, np.inf) for low in least.tolist()), *3 * [(-np.inf, np.inf)]]
        columns += [*own[1:4]]
        spread += 3 * [size]
    weight = float(np.linalg.norm(arm.gravity))
    if weight > 0.0:
        for axis in np.linalg.svd(arm.gravity[None])[2][1:]:  # across gravity, whose size does not change
            columns.append(arm.gravity_torque(motion.q, axis).T)
            spread.append(ERROR_STD * weight)
            limits.append((-np.inf, np.inf))
    return np.array(columns), np.array(spread), np.array(limits).T


def _turned_arm(arm: RigidArm, motion: ChannelMotion) -> RigidArm | None:
    """The arm with gravity along the axis that fits best; None without any, or where it hangs as modelled."""
    weightless = arm.torque(motion.q, motion.v, motion.a, np.zeros(3)) + arm.spring_torque(motion.q)
    columns = np.stack([arm.gravity_torque(motion.q, axis) for axis in np.eye(3)], axis=-1)
    weight = motion.telling / (np.nanstd(motion.reading, axis=0) + 1e-9)
    left = (np.nan_to_num(motion.reading - weightless) * weight).ravel()
    gravity = np.linalg.lstsq((columns * weight[:, :, None]).reshape(-1, 3), left, rcond=None)[0]
    size, nominal = float(np.linalg.norm(gravity)), float(np.linalg.norm(arm.gravity))
    if size < 1e-6 or nominal < 1e-6 or float(gravity @ arm.gravity) > np.cos(ERROR_STD) * size * nominal:
        return None
    return replace(arm, gravity=gravity * nominal / size)
