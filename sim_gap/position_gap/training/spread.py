"""Spread of the parameters that recordings leave open: covariance, intervals, and the fits of other choices of effects.

A position alone shows ratios: of gain, friction and inertia, whose common scale rests on a little inertia. Along such a
direction the score is flat, a fit stops anywhere, and a fit without one recording stops beside it. So parameters are
not fitted again but follow in one step (`jackknife`) where windows are left out, and where whole recordings are: each
motion shows what the model lacks in another way, and the parameters take it up.

An interval about one choice says how well its parameters are known if that choice is right. A spring in place of a part
of gravity, or a payload beside it, changes gain, friction and inertia together by factors, while each choice by itself
is told well. So parameters are distributed about several fits (averaging over models; Hoeting and others, Statistical
Science 14, 1999).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm, t

from gcomp.arrays import Array
from sim_gap.position_gap.columns import UNIT
from sim_gap.position_gap.doubt import LEAST_FREEDOM, Other
from sim_gap.position_gap.fit import LoopFit, coordinate
from sim_gap.position_gap.judge import rms_on
from sim_gap.position_gap.parameters import FARTHEST, PARAMETERS, relative_step, step_parameter
from sim_gap.position_gap.search import LoopSearch
from sim_gap.position_gap.sound_arm import APART_S, FRICTION_NM, FRICTION_SHARE, LATE_S, errors_of
from sim_gap.position_gap.training.jackknife import jackknifed, recordings_or_thirds, terms_of
from sim_gap.position_gap.training.unreached_limits import LIMITS, Unreached

LEAST_PROBABILITY = 0.005
"""Probability below which another choice of effects is none."""
INSIDE = 0.95
"""Probability of an interval."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another fit that the parameters of one joint may be distributed about, or those of the whole arm."""

    joint: int
    """−1: all joints, and the parameters of the whole arm."""
    odds: float
    """Probability over that of the fit itself."""
    fit: LoopFit


def alternatives(others: Sequence[Other]) -> tuple[Alternative, ...]:
    """The other choices that are not beyond doubt."""
    return tuple(
        Alternative(joints[0] if joints else -1, each.likely / (1.0 - each.likely), each.fit)
        for each, joints in ((each, each.group[1]) for each in others)
        if LEAST_PROBABILITY < each.likely < 1.0
    )


def quantiles(shifts: Array, odds: Array, deviation: float) -> tuple[float, float]:
    """Ends of the INSIDE interval of a mixture of normal distributions with one standard deviation, about 0 and about
    `shifts`, the latter with `odds` over the first."""
    means, weights = np.append(0.0, shifts), np.append(1.0, odds) / (1.0 + odds.sum())
    deviation = max(deviation, 1e-12)
    far = norm.isf(0.25 * (1.0 - INSIDE) * weights[0]) * deviation

    def end(share: float) -> float:
        def above(x: float) -> float:
            return float(weights @ norm.cdf((x - means) / deviation)) - share

        return float(brentq(above, means.min() - far, means.max() + far))

    return end(0.5 - 0.5 * INSIDE), end(0.5 + 0.5 * INSIDE)


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
LOOSE = 0.35
"""Relative standard deviation of a gain from which its scale is not decided."""
WIDEST = 100.0
"""Standard deviation of a parameter that nothing shows, in its own coordinate."""
ANYTHING = float(np.log(1e3))
"""Logarithm of the factor to either side of a gain of which nothing is known."""
LEAST_MOMENT = 1e-8
"""Standard deviation of a mass moment of a link without mass [kg·m]."""
LIGHTEST = 1e-3
"""Mass of a payload [kg] that its moment is divided by at least."""
SHARE = 0.975
"""Quantile of Student's distribution that the spread over recordings is widened to, as it rests on few of them."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the parameters in their own coordinates about the fit and about those without an effect that is in
    doubt, and the limits that no recording reaches."""

    names: list[tuple[int, str]]
    """Joint (−1: whole arm) and name."""
    matrix: Array
    limits: tuple[Unreached, ...] = ()
    others: tuple[Alternative, ...] = ()

    def of_joint(self, joint: int) -> Array:
        """The part of one joint's own parameters and then those of the whole arm."""
        at = [k for k, (j, _) in enumerate(self.names) if j in (joint, -1)]
        return self.matrix[np.ix_(at, at)]


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
        few = float(t.ppf(SHARE, max(number - 1, LEAST_FREEDOM)) / norm.ppf(SHARE))
        matrix += few**2 * jackknifed(terms, known, groups)
    told = [k for k, (j, name) in enumerate(terms.names) if _told(fit, j, name)]
    names = [terms.names[k] for k in told]
    matrix = matrix[np.ix_(told, told)]
    matrix += _systematic(search, free, names) + _besides(search, names) + _of_one_motion(search, free, names)
    return Covariance(names, matrix)


def _told(fit: LoopFit, joint: int, name: str) -> bool:
    """Whether a parameter was fitted, or sets the scale of a fitted gain."""
    if joint < 0:
        return name in fit.shared
    own = fit.active[joint]
    return name in own or ("kp" in own and name in SCALED and float(fit.point[name][joint]) > 0.0)


def covariance_within(search: LoopSearch, fit: LoopFit) -> Covariance:
    """Sandwich covariance of the fitted parameters over the windows, all else as it is: what tells an effect from none.

    Directions that the windows hardly show are held.
    """
    terms = terms_of(search, fit)
    bread, size, count = terms.squares.sum(0), len(terms.names), search.data.count
    scale = 1.0 / np.sqrt(np.maximum(np.diag(bread), 1e-300))
    held = np.diag([1e-4] * size)
    inverse = np.linalg.inv(bread * scale * scale[:, None] + held) * scale * scale[:, None]
    meat = terms.scores.T @ terms.scores
    matrix = inverse @ meat @ inverse * count / max(count - size / max(search.data.joints, 1), 1.0)
    return Covariance(terms.names, matrix + _systematic(search, fit, terms.names))


def free_all(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit with all free that may be off in a sound arm, with the stated values that set the scale of a fitted gain,
    and with the mass moments of all links where something of the whole arm was fitted."""
    open_at = (_open(search, fit, j, own) for j, own in enumerate(errors_of(search)[:-1]))
    active = tuple((*own, *more) for own, more in zip(fit.active, open_at, strict=True))
    others = [name for name in search.data.columns if name.startswith("moment") and name not in fit.shared]
    shared = (*fit.shared, *others) if fit.shared else ()
    point = {name: np.zeros(search.data.joints) for name in shared} | fit.point
    return replace(fit, point=point, active=active, shared=shared)


def _open(search: LoopSearch, fit: LoopFit, joint: int, errors: Mapping[str, float]) -> dict[str, float]:
    """Standard deviation of each parameter of a joint that was not fitted and is not known, in its own coordinate."""
    out = {name: size for name, size in errors.items() if name not in fit.active[joint]}
    for name in SCALED if "kp" in fit.active[joint] else ():
        if name not in fit.active[joint] and fit.point[name][joint] > 0.0:
            relative = STATED * float(fit.point[name][joint] / search.scales.of(name)[joint])
            out[name] = max(relative, out.get(name, 0.0))
    return out


def _stated(search: LoopSearch, fit: LoopFit, names: Sequence[tuple[int, str]]) -> Array:
    """Inverse covariance of the parameters before any recording, (K, K).

    What a model states of the same parameter of several joints is of one source, such as one rotor for all: it is off
    together.
    """
    *own, moments = errors_of(search)
    known = [_open(search, fit, j, errors) for j, errors in enumerate(own)]
    sizes = np.array(
        [
            known[j].get(name, WIDEST) if j >= 0 else WIDEST if name in fit.shared else max(moments[name], LEAST_MOMENT)
            for j, name in names
        ]
    )
    stated = [name if j >= 0 and name in SCALED and name in known[j] else str(k) for k, (j, name) in enumerate(names)]
    together = np.equal.outer(stated, stated)
    return np.linalg.inv(np.outer(sizes, sizes) * np.where(together, ALIKE, 0.0) + np.diag(sizes**2 * (1.0 - ALIKE)))


def _systematic(search: LoopSearch, fit: LoopFit, names: Sequence[tuple[int, str]]) -> Array:
    return np.diag((SYSTEMATIC * _values(search, fit, names)) ** 2)


def _of_one_motion(search: LoopSearch, fit: LoopFit, names: Sequence[tuple[int, str]]) -> Array:
    """Variances by what another motion would show where a single one was recorded, (K, K).

    Other motion turns what the fit leaves of the way to the command into other parameters.
    """
    if not search.data.of_one_recording:
        return np.zeros((len(names), len(names)))
    left = np.minimum(OTHERWISE * rms_on(search.data, fit) / search.scales.angle, STATED)
    share = np.array([left[j] if j >= 0 else left.max() for j, _ in names])
    return np.diag((share * _values(search, fit, names)) ** 2)


def _values(search: LoopSearch, fit: LoopFit, names: Sequence[tuple[int, str]]) -> Array:
    """Change of a parameter's own coordinate per relative change of it, (K,)."""
    return np.array(
        [
            coordinate(fit, search.scales, j, name)
            if j < 0
            else relative_step(name, fit.point[name][j], search.scales, j)
            for j, name in names
        ]
    )


def _besides(search: LoopSearch, names: Sequence[tuple[int, str]]) -> Array:
    """Variances by what sound arms have besides of friction and of lateness, (K, K)."""
    friction = np.minimum(FRICTION_NM, FRICTION_SHARE * search.scales.torque)
    sizes = {"coulomb": friction, "delay": np.full_like(friction, np.hypot(LATE_S, APART_S))}
    own = [sizes[name][j] / search.scales.of(name)[j] if name in sizes else 0.0 for j, name in names]
    return np.diag(np.square(own))


def shifts_of(search: LoopSearch, fit: LoopFit, spread: Covariance, joint: int, name: str) -> tuple[Array, Array]:
    """Where the other fits have a parameter, from where the fit has it, in its own coordinate, and their odds.

    Fits that have no such effect say nothing of its size.
    """
    own = coordinate(fit, search.scales, joint, name)
    told = [
        (coordinate(other.fit, search.scales, joint, name) - own, other.odds)
        for other in spread.others
        if other.joint in (joint, -1) and name in (other.fit.active[joint] if joint >= 0 else other.fit.shared)
    ]
    shifts, odds = np.array(told, float).reshape(-1, 2).T
    return shifts, odds


def undecided_scale(search: LoopSearch, fit: LoopFit, spread: Covariance) -> list[int]:
    """Joints of which only ratios of gain, friction and inertia can be told."""
    out = []
    for j, own in enumerate(fit.active):
        if "kp" in own:
            shifts, odds = shifts_of(search, fit, spread, j, "kp")
            within = float(spread.matrix[(at := spread.names.index((j, "kp"))), at])
            share, mean = odds / (1.0 + odds.sum()), float(odds @ shifts) / (1.0 + float(odds.sum()))
            if within + float(share @ shifts**2) - mean**2 > LOOSE**2:
                out.append(j)
    return out


def vague_limits(spread: Covariance) -> list[tuple[int, str]]:
    """Fitted limits (joint, name) of which the motion says next to nothing where they are."""
    deviations = np.sqrt(np.diag(spread.matrix))
    return [at for at, size in zip(spread.names, deviations, strict=True) if at[1] in LIMITS and size > FARTHEST]


def interval(
    search: LoopSearch, fit: LoopFit, spread: Covariance, joint: int, name: str
) -> tuple[float, float, float, str]:
    """Value, ends of its 95 % interval, and unit; of a limit that no motion reaches, where it may lie."""
    for limit in spread.limits:
        if (limit.joint, limit.name) == (joint, name):
            value, most = float(fit.point[name][joint]), float(limit.levels[limit.weights > 0.0].max())
            return value, limit.least, max(most, value), PARAMETERS[name].unit
    deviation = float(np.sqrt(spread.matrix[(at := spread.names.index((joint, name))), at]))
    below, above = quantiles(*shifts_of(search, fit, spread, joint, name), deviation)
    if joint < 0:
        value, (least, most) = float(fit.point[name][0]), search.data.ranges[name]
        return value, max(value + below, least), min(value + above, most), UNIT[name.partition(".")[2]]
    value = float(fit.point[name][joint])
    low, high = (step_parameter(name, value, step, search.scales, joint, ANYTHING) for step in (below, above))
    return value, low, high, PARAMETERS[name].unit


def payload_centre(fit: LoopFit, spread: Covariance, column: str) -> tuple[float, float, float, str]:
    """A coordinate of a payload's centre of mass, from its mass moment: value, ends of its 95 % interval, unit."""
    mass, moment = (float(fit.point[name][0]) for name in ("payload.mass", column))
    divisor = float(np.copysign(max(abs(mass), LIGHTEST), mass))
    centre, change = moment / divisor, np.zeros(len(spread.names))
    change[spread.names.index((-1, column))] = 1.0 / divisor
    change[spread.names.index((-1, "payload.mass"))] = -centre / divisor
    half = 2.0 * float(np.sqrt(change @ spread.matrix @ change))
    return centre, centre - half, centre + half, "m"
