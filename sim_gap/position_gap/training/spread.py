"""Spread of the parameters that recordings leave open: covariance, intervals, and draws.

A position alone shows ratios: of gain, friction and inertia, whose common scale rests on a little inertia. Along such a
direction the score is flat, a fit stops anywhere, and a fit without one recording stops beside it. So parameters are
not fitted again but follow in one Gauss-Newton step (Bell and McCaffrey, Survey Methodology 28, 2002), as far as the
others let them, where windows are left out, and where whole recordings are: each motion shows what the model lacks in
another way, and the parameters take it up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.stats import norm, t

from gcomp.arm.inertials import LIGHT_KG
from gcomp.arrays import Array
from gcomp.estimate.solve import LONGEST_STEP, precision
from sim_gap.position_gap.choice import LOOSE
from sim_gap.position_gap.fit import Layout, LoopFit, LoopSearch, Place, acting, jacobian, rms_on
from sim_gap.position_gap.parameters import LOGARITHMIC, PARAMETERS, UNIT, WITH_TORQUE
from sim_gap.position_gap.sound_arm import errors_of, omitted_of
from sim_gap.position_gap.training.unreached_limits import Unreached
from sim_gap.position_gap.windows import Windows
from sim_gap.search.estimate import Value

INSIDE = 0.95
"""Probability of an interval."""
LEAST_FREEDOM = 2
"""Degrees of freedom that are counted at least: two recordings alone have one, whose 95 % are 13 standard errors."""
SYSTEMATIC = 0.02
"""Relative standard deviation of every parameter that no recording shows: sampling, command timing, the model's own."""
OTHERWISE = 8.0
"""Relative standard deviation of a parameter from one motion to the next, over what a fit leaves of the way to the
command, up to that of a value that the model states (STATED): of 25 recordings of an SO-101, each fitted alone, 93 % of
the differences are within two such intervals."""
SCALED = ("kd", "coulomb", "viscous", "armature")
"""Parameters whose ratio to a gain is known."""
STATED = 0.5
"""Relative standard deviation of a value of SCALED that the model states and no fit has contradicted."""
ALIKE = 0.9
"""Correlation of the errors of a value of SCALED that the model states for several joints."""
ANYTHING = float(np.log(1e3))
"""Logarithm of the factor to either side of a gain of which nothing is known."""
WIDEST = 100.0
"""Standard deviation of a parameter that nothing shows, in its own coordinate."""
LEAST_MOMENT = 1e-8
"""Standard deviation of a mass moment of a link without mass [kg·m]."""
ALONE = 0.03
"""Share of the information about a direction that the others are taken to have at least, without a group."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the parameters in their own coordinates, and the limits that no recording reaches."""

    names: Sequence[Place]
    matrix: Array
    limits: tuple[Unreached, ...] = ()

    def of_joint(self, joint: int) -> Array:
        """The part of one joint's own parameters and then those of the whole arm."""
        at = acting(self.names, joint)
        return self.matrix[np.ix_(at, at)]


# ---- windows left out


@dataclass(frozen=True, eq=False)
class WindowTerms:
    """Normal equations of each window, at all joints; of W windows and K parameters."""

    names: Sequence[Place]
    squares: Array
    """(W, K, K)."""
    scores: Array
    """(W, K)."""
    residual: Array
    """(To, J, W)."""
    slopes: list[Array]
    """Derivatives of each joint, (K_j + S, To, W)."""


def terms_of(search: LoopSearch, fit: LoopFit) -> WindowTerms:
    """Normal equations of each window of the search about a fit."""
    now, slopes = jacobian(search, fit.point, fit.free)
    size, count, weight = len(fit.free), search.data.count, search.data.weight
    squares, scores = np.zeros((count, size, size)), np.zeros((count, size))
    weights = search.samples / np.maximum((now**2 * weight).sum((0, 2)), 1e-300)
    for j, x in enumerate(slopes):
        index = acting(fit.free, j)
        counted = x * weight[:, j]
        squares[np.ix_(np.arange(count), index, index)] += weights[j] * np.einsum("atw,btw->wab", counted, x)
        scores[:, index] += weights[j] * np.einsum("atw,tw->wa", counted, now[:, j])
    return WindowTerms(fit.free, squares, scores, now, slopes)


def jackknifed(terms: WindowTerms, known: Array, groups: NDArray[np.intp]) -> Array:
    """Covariance (K, K) by leaving out one group of windows after the other; `known` is what is known beforehand.

    Where nearly all that is known of a direction is in one group, such as the limit of a speed that is reached in a
    single motion, the step of the others would be noise over nothing.
    """
    squares, scores = terms.squares.sum(0) + known, terms.scores.sum(0)
    scale = 1.0 / np.sqrt(np.diag(squares))
    least = 1e-12 * np.eye(len(known))  # what every direction has beside a parameter by itself, against rounding
    whole = squares * scale * scale[:, None] + least
    steps = []
    for own in (groups == label for label in np.unique(groups)):
        others = (squares - terms.squares[own].sum(0)) * scale * scale[:, None] + least
        told, directions = eigh(others, whole)
        step = directions.T @ (scale * (terms.scores[own].sum(0) - scores)) / np.maximum(told, ALONE)
        steps.append(scale * (directions @ step))
    apart = np.stack(steps) - np.mean(steps, axis=0)
    return np.asarray((len(steps) - 1) / len(steps) * apart.T @ apart)


def recordings_or_thirds(data: Windows) -> NDArray[np.intp]:
    """Number of the group of each window, (W,): its recording, or the third of a single one."""
    return np.arange(data.count) * 3 // data.count if data.of_one_recording else data.recording


def gaps_left_out(data: Windows, terms: WindowTerms, known: Array) -> Array:
    """Gap that a fit without its group leaves of each training window, to first order, (To, J, W) [rad]."""
    groups, out = recordings_or_thirds(data), terms.residual.copy()
    whole = terms.squares.sum(0) + known
    for group in np.unique(groups) if len(terms.names) else ():
        own = np.flatnonzero(groups == group)
        others = whole - terms.squares[own].sum(0)
        step = np.linalg.lstsq(others, terms.scores[own].sum(0) - terms.scores.sum(0), rcond=1e-9)[0]
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        for j, x in enumerate(terms.slopes):
            out[:, j, own] += np.einsum("a,atw->tw", step[acting(terms.names, j)], x[..., own])
    return out


# ---- covariance


def covariance(search: LoopSearch, fit: LoopFit) -> Covariance:
    """Covariance, by windows and recordings, of the fitted parameters and of the stated ones that a gain rests on.

    It counts how far they would move if all that may be off in a sound arm were fitted beside them.
    """
    free = free_all(search, fit)
    terms = terms_of(search, free)
    known = _stated(search, fit, terms.names)
    inverse = np.linalg.inv(terms.squares.sum(0) + known)
    aside = inverse @ terms.scores.sum(0)
    matrix = inverse @ known @ inverse + np.outer(aside, aside)
    matrix += jackknifed(terms, known, np.arange(search.data.count))
    groups = recordings_or_thirds(search.data)
    if (number := len(np.unique(groups))) > 1:
        # Student's distribution, since the spread over recordings rests on few of them
        inside = 0.5 * (1.0 + INSIDE)
        few = float(t.ppf(inside, max(number - 1, LEAST_FREEDOM)) / norm.ppf(inside))
        matrix += few**2 * jackknifed(terms, known, groups)
    told = [k for k, place in enumerate(terms.names) if place in fit.free or _sets_scale(fit, *place)]
    names = [terms.names[k] for k in told]
    besides = _systematic(search, free, names) + _besides(search, names) + _of_one_motion(search, free, names)
    return Covariance(names, matrix[np.ix_(told, told)] + np.diag(besides))


def _sets_scale(fit: LoopFit, joint: int, name: str) -> bool:
    """Whether a stated value sets the scale of a fitted gain."""
    return (joint, "kp") in fit.free and name in SCALED and float(fit.point[name][joint]) > 0.0


def known_before(search: LoopSearch, fit: LoopFit) -> Array:
    """Inverse variance of each fitted parameter before any recording, (K, K)."""
    return np.diag(precision(Layout(search, fit.point, fit.free).problem()))


def covariance_within(search: LoopSearch, fit: LoopFit, terms: WindowTerms) -> Covariance:
    """Sandwich covariance of the fitted parameters over the windows, all else as it is: what tells an effect from none.

    Directions that the windows hardly show are held.
    """
    bread, size, count = terms.squares.sum(0), len(terms.names), search.data.count
    scale = 1.0 / np.sqrt(np.maximum(np.diag(bread), 1e-300))
    held = np.diag([1e-4] * size)
    inverse = np.linalg.inv(bread * scale * scale[:, None] + held) * scale * scale[:, None]
    meat = terms.scores.T @ terms.scores
    matrix = inverse @ meat @ inverse * count / max(count - size / max(search.data.joints, 1), 1.0)
    return Covariance(terms.names, matrix + np.diag(_systematic(search, fit, terms.names)))


def free_all(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit with all free that may be off in a sound arm, with the stated values that set the scale of a fitted gain,
    and with the mass moments of all links where something of the whole arm was fitted."""
    others = [place for place in _open(search, fit) if place[0] >= 0 or fit.at(-1)]
    point = {name: np.zeros(search.data.joints) for j, name in others if j < 0} | fit.point
    return replace(fit, point=point).freed([*fit.free, *others])


def _open(search: LoopSearch, fit: LoopFit) -> dict[Place, float]:
    """Standard deviation of each parameter that was not fitted and is not known, in its own coordinate."""
    out = {place: size for place, size in errors_of(search).items() if place not in fit.free}
    for j, name in product(range(search.data.joints), SCALED):
        if (j, name) not in fit.free and _sets_scale(fit, j, name):
            relative = STATED * float(fit.point[name][j] / search.scales.of(name)[j])
            out[j, name] = max(relative, out.get((j, name), 0.0))
    return out


def _stated(search: LoopSearch, fit: LoopFit, names: Sequence[Place]) -> Array:
    """Inverse covariance of the parameters before any recording, (K, K).

    What a model states of the same parameter of several joints is of one source, such as one rotor for all: it is off
    together.
    """
    known = _open(search, fit)
    sizes = np.array([max(known.get(place, WIDEST), LEAST_MOMENT) for place in names])
    stated = [name if (j, name) in known and j >= 0 and name in SCALED else str(k) for k, (j, name) in enumerate(names)]
    together = np.equal.outer(stated, stated)
    return np.linalg.inv(np.outer(sizes, sizes) * np.where(together, ALIKE, 0.0) + np.diag(sizes**2 * (1.0 - ALIKE)))


def _systematic(search: LoopSearch, fit: LoopFit, names: Sequence[Place]) -> Array:
    return np.asarray((SYSTEMATIC * _values(search, fit, names)) ** 2)


def _of_one_motion(search: LoopSearch, fit: LoopFit, names: Sequence[Place]) -> Array:
    """Variances by what another motion would show where a single one was recorded, (K,).

    Other motion turns what the fit leaves of the way to the command into other parameters.
    """
    if not search.data.of_one_recording:
        return np.zeros(len(names))
    left = np.minimum(OTHERWISE * rms_on(search.data, fit.point) / search.scales.angle, STATED)
    share = np.array([left[j] if j >= 0 else left.max() for j, _ in names])
    return np.asarray((share * _values(search, fit, names)) ** 2)


def _values(search: LoopSearch, fit: LoopFit, names: Sequence[Place]) -> Array:
    """Change of a parameter's own coordinate per relative change of it, (K,)."""
    own = Layout(search, fit.point, names).theta
    return np.where([name in LOGARITHMIC for _, name in names], 1.0, own)


def _besides(search: LoopSearch, names: Sequence[Place]) -> Array:
    """Variances by what sound arms have besides of friction and of lateness, (K,)."""
    sizes = omitted_of(search)
    return np.square([sizes[name][j] / search.scales.of(name)[j] if name in sizes else 0.0 for j, name in names])


# ---- intervals and draws


def undecided_scale(fit: LoopFit, spread: Covariance) -> list[int]:
    """Joints of which only ratios of gain, friction and inertia can be told."""
    variances = dict(zip(spread.names, np.diag(spread.matrix).tolist(), strict=True))
    return [j for j, name in fit.free if name == "kp" and variances[j, name] > LOOSE**2]


def interval(search: LoopSearch, fit: LoopFit, spread: Covariance, joint: int, name: str) -> Value:
    """A parameter and its 95 % interval; of a limit that no motion reaches, where it may lie."""
    for limit in spread.limits:
        if (limit.joint, limit.name) == (joint, name):
            value = float(fit.point[name][joint])
            unit = search.arm.unit_at(joint, PARAMETERS[name].unit)
            return Value(value, limit.least, max(limit.most, value), unit)
    deviation = float(np.sqrt(spread.matrix[(at := spread.names.index((joint, name))), at]))
    half = float(norm.isf(0.5 * (1.0 - INSIDE))) * deviation
    half = min(half, ANYTHING) if name in LOGARITHMIC else half
    layout = Layout(search, fit.point, [(joint, name)])
    problem, about = layout.problem(), layout.theta
    points = [fit.point, *(layout.at(problem.within(about + step)) for step in (-half, half))]
    value, *ends = (float(point[name][max(joint, 0)]) for point in points)
    if joint < 0:
        return Value(value, min(ends), max(ends), UNIT[name.partition(".")[2]])
    return Value(value, min(ends), max(ends), search.arm.unit_at(joint, PARAMETERS[name].unit))


def payload_centre(fit: LoopFit, spread: Covariance, column: str) -> Value:
    """A coordinate of a payload's centre of mass, from its mass moment."""
    mass, moment = (float(fit.point[name][0]) for name in ("payload.mass", column))
    divisor = float(np.copysign(max(abs(mass), LIGHT_KG), mass))
    centre, change = moment / divisor, np.zeros(len(spread.names))
    change[spread.names.index((-1, column))] = 1.0 / divisor
    change[spread.names.index((-1, "payload.mass"))] = -centre / divisor
    half = 2.0 * float(np.sqrt(change @ spread.matrix @ change))
    return Value(centre, centre - half, centre + half, "m")


def draw(
    search: LoopSearch, fit: LoopFit, spread: Covariance, count: int, seed: int = 0, reach: Array | None = None
) -> list[dict[str, float]]:
    """Draws of all parameters from their joint distribution, within their bounds, and of the limits that no recording
    reaches: `joint.name` → value. One whose training motion is further from the fit's than `reach` (J,) [rad, RMS], to
    first order, is shortened, for the distribution is one of small steps.
    """
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(spread.matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = random.standard_normal((count, len(values))) @ root.T
    if reach is not None:
        steps = _within(search, fit, spread, steps, reach)
    layout = Layout(search, fit.point, spread.names)
    problem, about = layout.problem(), layout.theta
    points = [layout.at(problem.within(about + step)) for step in _with_gains(spread.names, about, steps)]
    rows = [{_label(search, j, name): float(point[name][max(j, 0)]) for j, name in spread.names} for point in points]
    for each in spread.limits:
        for row, value in zip(rows, each.draws(count, random), strict=True):
            row[_label(search, each.joint, each.name)] = float(value)
    return rows


def _with_gains(names: Sequence[Place], about: Array, steps: Array) -> Array:
    """The steps (P, K), in which what goes with a gain is scaled as the gain is and moved by what its step is more than
    that: however far the scale moves, ratios stay."""
    out = steps.copy()
    at = {place: k for k, place in enumerate(names)}
    for (j, name), k in at.items():
        if name in WITH_TORQUE and (j, "kp") in at:
            scale = steps[:, at[j, "kp"]]
            out[:, k] += (np.exp(scale) - 1.0 - scale) * about[k]
    return out


def _within(search: LoopSearch, fit: LoopFit, spread: Covariance, steps: Array, reach: Array) -> Array:
    """The steps (P, K), shorter for each joint that goes further than `reach`; for all, where they share some."""
    data, names = search.data, spread.names
    _, slopes = jacobian(search, fit.point, names)
    count = np.maximum(data.weight.sum((0, 2)), 1.0)
    share = np.ones((len(steps), data.joints))
    for j, x in enumerate(slopes):
        moved = np.einsum("pa,atw->ptw", steps[:, acting(names, j)], x)
        apart = np.sqrt(np.einsum("ptw,tw->p", moved**2, data.weight[:, j]) / count[j])
        share[:, j] = np.minimum(1.0, reach[j] / np.maximum(apart, 1e-12))
    if any(j < 0 for j, _ in names):
        share = np.broadcast_to(share.min(axis=1, keepdims=True), share.shape)
    return steps * share[:, [max(j, 0) for j, _ in names]]


def _label(search: LoopSearch, joint: int, name: str) -> str:
    return name if joint < 0 else f"{search.arm.names[joint]}.{name}"
