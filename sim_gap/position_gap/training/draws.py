"""Draws of the parameters from what recordings leave open of them."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.choice import LoopSearch
from sim_gap.position_gap.fit import Layout, LoopFit, jacobian
from sim_gap.position_gap.parameters import WITH_TORQUE
from sim_gap.position_gap.training.jackknife import acting
from sim_gap.position_gap.training.spread import Covariance
from sim_gap.position_gap.training.unreached_limits import draw_limits


def draw(
    search: LoopSearch, fit: LoopFit, spread: Covariance, count: int, seed: int = 0, reach: Array | None = None
) -> list[dict[str, float]]:
    """Draws of all parameters from their joint distribution, within their bounds, and of the limits that no recording
    reaches: `joint.name` → value.

    The distribution is one of small steps. A draw whose motion is further from the fit's than `reach` (J,) [rad], RMS
    over the training motion to first order, is shortened.
    """
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(spread.matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = random.standard_normal((count, len(values))) @ root.T
    if reach is not None:
        steps = _within(search, fit, spread, steps, reach)
    layout = Layout(search.data, search.scales, fit.point, spread.names)
    problem = layout.problem(search.nominal, {}, search.floor)
    about = layout.theta(layout.point)
    points = [layout.at(problem.within(about + step)) for step in _with_gains(spread.names, about, steps)]
    rows = [{_label(search, j, name): float(point[name][max(j, 0)]) for j, name in spread.names} for point in points]
    for each, drawn in zip(spread.limits, draw_limits(spread.limits, count, random), strict=True):
        for row, value in zip(rows, drawn, strict=True):
            row[_label(search, each.joint, each.name)] = float(value)
    return rows


def _with_gains(names: Sequence[tuple[int, str]], about: Array, steps: Array) -> Array:
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
    own = [[name for j, name in names if j == joint] for joint in range(data.joints)]
    shared = [name for j, name in names if j < 0]
    _, slopes = jacobian(data, fit, search.scales, own, shared)
    count = np.maximum(data.weight.sum((0, 2)), 1.0)
    share = np.ones((len(steps), data.joints))
    for j, x in enumerate(slopes):
        moved = np.einsum("pa,atw->ptw", steps[:, acting(names, j)], x)
        apart = np.sqrt(np.einsum("ptw,tw->p", moved**2, data.weight[:, j]) / count[j])
        share[:, j] = np.minimum(1.0, reach[j] / np.maximum(apart, 1e-12))
    if shared:
        share = np.broadcast_to(share.min(axis=1, keepdims=True), share.shape)
    return np.stack([steps[:, k] * share[:, max(j, 0)] for k, (j, _) in enumerate(names)], axis=1) if names else steps


def _label(search: LoopSearch, joint: int, name: str) -> str:
    return name if joint < 0 else f"{search.data.plant.sim.arm.names[joint]}.{name}"
