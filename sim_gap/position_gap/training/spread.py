"""Spread of the parameters that recordings leave open: covariance and intervals.

A position alone shows ratios: of gain, friction and inertia, whose common scale rests on a little inertia. Along such a
direction the score is flat, a fit stops anywhere, and a fit without one recording stops beside it. So parameters are
not fitted again but follow in one step (`jackknife`) where windows are left out, and where whole recordings are: each
motion shows what the model lacks in another way, and the parameters take it up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm, t

from gcomp.arrays import Array
from gcomp.estimate.solve import precision
from sim_gap.position_gap.choice import LoopSearch
from sim_gap.position_gap.fit import Layout, LoopFit, coordinate
from sim_gap.position_gap.judge import rms_on
from sim_gap.position_gap.links import UNIT, range_of, shared_names
from sim_gap.position_gap.parameters import PARAMETERS, relative_step, step_parameter
from sim_gap.position_gap.sound_arm import APART_S, FRICTION_NM, FRICTION_SHARE, LATE_S, errors_of
from sim_gap.position_gap.training.jackknife import WindowTerms, jackknifed, recordings_or_thirds, terms_of
from sim_gap.position_gap.training.unreached_limits import Unreached

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
    """Covariance of the parameters in their own coordinates, and the limits that no recording reaches."""

    names: list[tuple[int, str]]
    """Joint (−1: whole arm) and name."""
    matrix: Array
    limits: tuple[Unreached, ...] = ()

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


def known_before(search: LoopSearch, fit: LoopFit, names: list[tuple[int, str]]) -> Array:
    """Inverse variance of each fitted parameter before any recording, (K, K)."""
    layout = Layout(search.data, search.scales, fit.point, names)
    return np.diag(precision(layout.problem(search.nominal, {}, search.floor)))


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
    return Covariance(terms.names, matrix + _systematic(search, fit, terms.names))


def free_all(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit with all free that may be off in a sound arm, with the stated values that set the scale of a fitted gain,
    and with the mass moments of all links where something of the whole arm was fitted."""
    open_at = (_open(search, fit, j, own) for j, own in enumerate(errors_of(search)[:-1]))
    active = tuple((*own, *more) for own, more in zip(fit.active, open_at, strict=True))
    every = shared_names(search.data.plant.sim.arm)
    others = [name for name in every if name.startswith("moment") and name not in fit.shared]
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


def undecided_scale(fit: LoopFit, spread: Covariance) -> list[int]:
    """Joints of which only ratios of gain, friction and inertia can be told."""
    out = []
    for j, own in enumerate(fit.active):
        if "kp" in own:
            within = float(spread.matrix[(at := spread.names.index((j, "kp"))), at])
            if within > LOOSE**2:
                out.append(j)
    return out


def interval(
    search: LoopSearch, fit: LoopFit, spread: Covariance, joint: int, name: str
) -> tuple[float, float, float, str]:
    """Value, ends of its 95 % interval, and unit; of a limit that no motion reaches, where it may lie."""
    for limit in spread.limits:
        if (limit.joint, limit.name) == (joint, name):
            value, most = float(fit.point[name][joint]), float(limit.levels[limit.weights > 0.0].max())
            return value, limit.least, max(most, value), PARAMETERS[name].unit
    deviation = float(np.sqrt(spread.matrix[(at := spread.names.index((joint, name))), at]))
    half = float(norm.isf(0.5 * (1.0 - INSIDE))) * deviation
    below, above = -half, half
    if joint < 0:
        value, (least, most) = float(fit.point[name][0]), range_of(search.data.plant.sim.arm, name)
        return value, max(value + below, least), min(value + above, most), UNIT[name.partition(".")[2]]
    value = float(fit.point[name][joint])
    ends = (step_parameter(name, value, step, search.scales, joint, ANYTHING) for step in (below, above))
    low, high = sorted(ends)
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
