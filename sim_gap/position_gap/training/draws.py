"""Draws of the parameters from what recordings leave open of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, Point, batch, residuals, stepped
from sim_gap.position_gap.search import LoopSearch, merge_joint
from sim_gap.position_gap.training.spread import Alternative, Covariance
from sim_gap.position_gap.training.unreached_limits import LIMITS, draw_limits
from sim_gap.position_gap.windows import thin


def draw(
    search: LoopSearch, fit: LoopFit, spread: Covariance, count: int, seed: int = 0, reach: Array | None = None
) -> list[dict[str, float]]:
    """Draws of all parameters from their joint distribution, within their bounds, and of the limits that no recording
    reaches: `joint.name` → value. An effect that is in doubt is absent from its share of them.

    The distribution is one of small steps. A draw whose motion is further from the fit's than `reach` (J,) [rad], RMS
    over the training motion, is shortened.
    """
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(spread.matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = random.standard_normal((count, len(values))) @ root.T
    about = _points(fit, spread, count, random)
    points = [_stepped(search, fit, spread, *each) for each in zip(about, steps, strict=True)]
    if reach is not None:
        points = _within(search, fit, spread, about, steps, points, reach)
    rows = [{_label(search, j, name): float(point[name][max(j, 0)]) for j, name in spread.names} for point in points]
    for each, drawn in zip(spread.limits, draw_limits(spread.limits, count, random), strict=True):
        for row, value in zip(rows, drawn, strict=True):
            row[_label(search, each.joint, each.name)] = float(value)
    return rows


def _within(
    search: LoopSearch,
    fit: LoopFit,
    spread: Covariance,
    about: Sequence[LoopFit],
    steps: Array,
    points: list[Point],
    reach: Array,
) -> list[Point]:
    """The points, with the steps halved of each joint that goes further than `reach`; of all, where they share some."""
    data = thin(search.data, 16)
    count = np.maximum(data.weight.sum((0, 2)), 1.0)
    unmoved = residuals(data, batch([fit.point]))[0]
    points, share = list(points), np.ones((len(points), data.joints))
    waiting: Sequence[int] = range(len(points))
    owner = np.array([j for j, _ in spread.names])
    for _ in range(5):  # halvings
        far = np.zeros_like(share, bool)
        for some in np.array_split(waiting, max(len(waiting) // 32, 1)):  # simulated at once
            apart = residuals(data, batch([points[i] for i in some])) - unmoved
            far[some] = np.sqrt(np.einsum("ptjw,ptjw->pj", apart, apart) / count) > reach
        if fit.shared:
            far = np.broadcast_to(far.any(axis=1, keepdims=True), far.shape)
        share = np.where(far, 0.5 * share, share)
        waiting = np.flatnonzero(far.any(axis=1)).tolist()
        if not waiting:
            break
        for i in waiting:
            shares = np.where(owner < 0, share[i, 0], share[i, owner])
            points[i] = _stepped(search, fit, spread, about[i], shares * steps[i])
    return points


def _stepped(search: LoopSearch, fit: LoopFit, spread: Covariance, about: LoopFit, steps: Array) -> Point:
    """The point after `steps` from where the fit `about` has the parameters; effects that it lacks stay absent."""
    joints = range(search.data.joints)
    there = [
        name in about.shared if j < 0 else name in about.active[j] or name not in fit.active[j]
        for j, name in spread.names
    ]
    steps = steps * there
    names = [[name for j, name in spread.names if j == joint] for joint in (*joints, -1)]
    parts = [steps[[j == joint for j, _ in spread.names]] for joint in (*joints, -1)]
    start = replace(about, shared=tuple(names[-1]))
    point = stepped(search.data, start, search.scales, names[:-1], parts[:-1], parts[-1])
    return {name: point[name] for name in fit.point}


def _label(search: LoopSearch, joint: int, name: str) -> str:
    return name if joint < 0 else f"{search.data.arm.names[joint]}.{name}"


def _points(fit: LoopFit, spread: Covariance, count: int, random: np.random.Generator) -> list[LoopFit]:
    """The fit that each draw is about: for the whole arm or at each joint by itself, as likely as it is."""
    there = [other for other in spread.others if _told(fit, spread, other)]
    out = []
    for _ in range(count):
        chosen = _chosen([other for other in there if other.joint < 0], random)
        point = fit if chosen is None else chosen.fit
        for j in range(len(fit.active)) if chosen is None else ():
            if (own := _chosen([other for other in there if other.joint == j], random)) is not None:
                point = merge_joint(point, own.fit, j)
        out.append(point)
    return out


def _told(fit: LoopFit, spread: Covariance, other: Alternative) -> bool:
    """Whether a draw about another fit has a number for all that it has: nothing more than the fit but what is known of
    to some extent anyway, and a limit where the fit has one."""
    joints = range(len(fit.active)) if other.joint < 0 else (other.joint,)
    more = {(j, name) for j in joints for name in {*other.fit.active[j]} - {*fit.active[j]}}
    more |= {(-1, name) for name in {*other.fit.shared} - {*fit.shared}}
    return more <= {*spread.names} and all(
        np.isfinite(other.fit.point[name][j]) == np.isfinite(fit.point[name][j]) for name in LIMITS for j in joints
    )


def _chosen(others: list[Alternative], random: np.random.Generator) -> Alternative | None:
    """One of several fits by their odds; None is the fit itself."""
    ends = np.cumsum([1.0, *(other.odds for other in others)])
    at = int(np.searchsorted(ends, ends[-1] * random.random(), side="right"))
    return others[at - 1] if at else None
