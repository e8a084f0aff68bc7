"""Which effects are worth a fit: the fall of the score to be expected, from one simulation of each."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.fit import Fit, batch, jacobian, residuals
from sim_gap.closed_loop.parameters import EFFECTS, PARAMETERS
from sim_gap.closed_loop.search import LEVELS, PRICE, Search, acts, effect_there, level_of, start_of


def ranked(search: Search, fit: Fit, own: Sequence[str]) -> list[list[tuple[float, str]]]:
    """Candidates of each joint with the expected fall of its score, best first."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, fit.shared)
    falls: list[list[tuple[float, str]]] = [[] for _ in range(search.data.joints)]
    changes = {effect: _change(search, fit, effect) for effect in own}
    points = [point for each in changes.values() for point in each]
    if not points:
        return falls
    answers = residuals(search.data, batch(points)) - now
    at = 0
    for effect, each in changes.items():
        columns = answers[at : at + len(each)]
        at += len(each)
        for j in range(search.data.joints):
            if effect_there(fit, effect, j) or not all(acts(fit.point, need, j) for need in EFFECTS[effect].needs):
                continue
            share = _explained(now[:, j], slopes[j], columns[:, :, j], signed=_one_sided(fit, effect, j))
            expected = -0.5 * float(search.samples[j]) * np.log(max(1.0 - share, 1e-6))
            falls[j].append((expected - PRICE * len(each), effect))
    return [sorted(each, reverse=True) for each in falls]


def _one_sided(fit: Fit, effect: str, joint: int) -> bool:
    """Whether the effect's first parameter can only grow from where it is, or is a limit."""
    first = PARAMETERS[EFFECTS[effect].parameters[0]]
    return bool(fit.point[first.name][joint] <= first.low or np.isinf(first.neutral))


def _change(search: Search, fit: Fit, effect: str) -> list[dict[str, Array]]:
    """Points that differ from the fit by one parameter of the effect at every joint."""
    out = []
    for name in EFFECTS[effect].parameters:
        if name == "stribeck_velocity":
            continue
        point = dict(fit.point)
        start = np.array([start_of(search, name, j) for j in range(search.data.joints)])
        if name in LEVELS:
            point[name] = level_of(search, fit, name)
        elif name == "gain":
            point[name] = fit.point[name] * 1.05
        else:
            point[name] = fit.point[name] + start * (0.5 if PARAMETERS[name].low == PARAMETERS[name].neutral else 0.1)
        out.append(point)
    return out


def _explained(residual: Array, known: Array, columns: Array, signed: bool) -> float:
    """Share of a residual's square that columns explain beyond those that are fitted anyway."""
    r = residual.ravel()
    a, c = known.reshape(len(known), r.size), columns.reshape(len(columns), r.size)
    if len(a):
        inverse = np.linalg.pinv(a @ a.T, rcond=1e-8, hermitian=True)
        r = r - (r @ a.T) @ inverse @ a
        c = c - (c @ a.T) @ inverse @ a
    normal = c @ c.T
    if float(np.trace(normal)) <= 1e-18 * max(float(r @ r), 1e-300):
        return 0.0
    step = -np.linalg.pinv(normal, rcond=1e-8, hermitian=True) @ (c @ r)
    if signed and len(step) == 1 and step[0] < 0.0:
        return 0.0
    total = float(residual.ravel() @ residual.ravel())
    return float(step @ normal @ step) / max(total, 1e-300)


def expected_shared(
    search: Search, fit: Fit, now: Array, slopes: list[Array], columns: tuple[str, ...], names: tuple[str, ...]
) -> float:
    """Expected fall of the score by coefficients that all joints share."""
    total = len(names)
    normal, right, projected = np.zeros((total, total)), np.zeros(total), []
    for j, all_slopes in enumerate(slopes):
        own = len(fit.active[j]) + len(fit.shared)
        r = now[:, j].ravel()
        flat = all_slopes.reshape(len(all_slopes), r.size)
        a, c = flat[:own], flat[[own + columns.index(name) for name in names]]
        if len(a):
            inverse = np.linalg.pinv(a @ a.T, rcond=1e-8, hermitian=True)
            r, c = r - (r @ a.T) @ inverse @ a, c - (c @ a.T) @ inverse @ a
        weight = search.samples[j] / max(float(now[:, j].ravel() @ now[:, j].ravel()), 1e-300)
        normal += weight * c @ c.T
        right -= weight * (c @ r)
        projected.append((r, c))
    step = np.linalg.pinv(normal, rcond=1e-8, hermitian=True) @ right
    fall = 0.0
    for j, (r, c) in enumerate(projected):
        after = r + step @ c
        ratio = max(float(after @ after), 1e-300) / max(float(r @ r), 1e-300)
        fall -= 0.5 * float(search.samples[j]) * float(np.log(ratio))
    return fall - PRICE * total
