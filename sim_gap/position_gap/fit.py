"""Output-error fit: parameters of all joints by Gauss-Newton on simulated minus measured positions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.parameters import (
    FARTHEST,
    LOGARITHMIC,
    PARAMETERS,
    Scales,
    gain_companions,
    relative_step,
    step_parameter,
)
from sim_gap.position_gap.simulate import simulate
from sim_gap.position_gap.windows import Windows, choose_joints

DAMPINGS = (1e-6, 1e-2, 0.1, 1.0, 10.0, 100.0)
"""Levenberg-Marquardt dampings tried together in every step."""
STILL = 1e-3
"""Relative fall of the cost below which a joint's fit ends."""
DIFFERENCE = 0.02
"""Step of a finite difference, in units of the size at which a parameter is tried."""

Point = Mapping[str, Array]
"""Parameter → (J,)."""


@dataclass(frozen=True, eq=False)
class LoopFit:
    """Parameters of all joints, those that were fitted, and what they leave."""

    point: dict[str, Array]
    active: tuple[tuple[str, ...], ...]
    """Names fitted at each joint."""
    shared: tuple[str, ...] = ()
    """Names of columns with one coefficient for the whole arm."""
    rms: Array | None = None
    """RMS of the residual per joint and window [rad], (J, W)."""

    def with_values(self, **values: Array) -> "LoopFit":
        return replace(self, point={**self.point, **values})


def coordinate(fit: LoopFit, scales: Scales, joint: int, name: str) -> float:
    """A fit's value of a parameter in its own coordinate; `joint` is −1 for the whole arm."""
    value = float(fit.point[name][max(joint, 0)])
    if joint < 0:
        return value
    return float(np.log(value)) if name in LOGARITHMIC else value / float(scales.of(name)[joint])


def residuals(data: Windows, values: Mapping[str, Array]) -> Array:
    """Simulated minus measured positions, as far as they count, (P, To, J, W)."""
    return (simulate(data, values) - data.measured) * data.weight


def root_mean_squares(data: Windows, residual: Array) -> Array:
    """RMS over the time of each window, (…, J, W); 0 for one without samples."""
    count = data.weight.sum(0)
    total = np.einsum("...tjw,...tjw->...jw", residual, residual)
    return np.asarray(np.sqrt(total / np.maximum(count, 1.0)))


def batch(points: Sequence[Point]) -> dict[str, Array]:
    """Parameter → (P, J) from points that have the same names."""
    return {name: np.stack([point[name] for point in points]) for name in points[0]}


def evaluate(data: Windows, fit: LoopFit) -> LoopFit:
    return replace(fit, rms=root_mean_squares(data, residuals(data, batch([fit.point])))[0])


def jacobian(
    data: Windows, fit: LoopFit, scales: Scales, names: Sequence[Sequence[str]], shared: Sequence[str] = ()
) -> tuple[Array, list[Array]]:
    """Residual now (To, J, W), and per joint its derivatives (K_j + S, To, W) in the parameters' own coordinates.

    That by a gain is the difference by the gain and all that goes with it, less the derivatives by the latter: their
    common scale changes next to nothing of the motion, and differences of each alone, which sticking and slipping
    roughen, do not add up to that.
    """
    width = max((len(each) for each in names), default=0)
    steps = [[_difference(name, fit.point[name][j], scales, j) for name in own] for j, own in enumerate(names)]
    points = [dict(fit.point)]
    for k in range(width):
        point = {name: values.copy() for name, values in fit.point.items()}
        for j, own in enumerate(names):
            if k < len(own):
                point[own[k]][j] = step_parameter(own[k], fit.point[own[k]][j], steps[j][k], scales, j)
                for name in gain_companions(own) if own[k] == "kp" else ():
                    point[name][j] *= np.exp(steps[j][k])
        points.append(point)
    points += [{**fit.point, name: fit.point[name] + DIFFERENCE} for name in shared]
    all_residuals = residuals(data, batch(points))
    now, out = all_residuals[0], []
    for j, own in enumerate(names):
        columns = [(all_residuals[1 + k][:, j] - now[:, j]) / step for k, step in enumerate(steps[j])]
        for name in gain_companions(own):
            share = relative_step(name, fit.point[name][j], scales, j)
            columns[own.index("kp")] -= share * columns[own.index(name)]
        columns += [(all_residuals[1 + width + s][:, j] - now[:, j]) / DIFFERENCE for s in range(len(shared))]
        out.append(np.stack(columns) if columns else np.zeros((0, *now[:, j].shape)))
    return now, out


def _difference(name: str, value: float, scales: Scales, joint: int) -> float:
    """Step of a finite difference in the parameter's own coordinate, away from the highest value where that is near."""
    step = 0.01 if name in LOGARITHMIC else DIFFERENCE
    return -step if step_parameter(name, value, step, scales, joint) >= PARAMETERS[name].high else step


def improve(data: Windows, fit: LoopFit, scales: Scales, iterations: int = 6) -> LoopFit:
    """Gauss-Newton steps from a fit until nothing falls; joints are independent unless `shared` couples them."""
    moving = [j for j, own in enumerate(fit.active) if own]
    if not fit.shared and len(moving) < data.joints:
        return _improved_part(data, fit, scales, iterations, moving)
    fit = evaluate(data, fit)
    assert fit.rms is not None
    cost = (fit.rms**2 * data.weight.sum(0)).sum(1)
    busy = [bool(own) or bool(fit.shared) for own in fit.active]
    for _ in range(iterations):
        names = [own if going else () for own, going in zip(fit.active, busy, strict=True)]
        if not any(busy):
            break
        now, slopes = jacobian(data, fit, scales, names, fit.shared)
        trials = [_stepped(data, fit, names, now, slopes, damping, scales) for damping in DAMPINGS]
        left = residuals(data, batch(trials))
        costs = np.einsum("ptjw,ptjw->pj", left, left)
        best = np.full(data.joints, int(costs.sum(1).argmin())) if fit.shared else costs.argmin(0)
        chosen = costs[best, np.arange(data.joints)]
        better = chosen < cost if not fit.shared else np.full(data.joints, chosen.sum() < cost.sum())
        point = {
            name: np.where(better, np.array([trials[b][name][j] for j, b in enumerate(best)]), values)
            for name, values in fit.point.items()
        }
        fall = np.where(better, 1.0 - chosen / np.maximum(cost, 1e-300), 0.0)
        cost = np.where(better, chosen, cost)
        fit = replace(fit, point=point)
        going = fall > STILL
        busy = [b and bool(going.any() if fit.shared else g) for b, g in zip(busy, going, strict=True)]
    return evaluate(data, fit)


def _improved_part(data: Windows, fit: LoopFit, scales: Scales, iterations: int, joints: list[int]) -> LoopFit:
    """The fit improved at the joints that have parameters to fit; the others are as they were."""
    if not joints:
        return fit if fit.rms is not None else evaluate(data, fit)
    some = LoopFit({name: values[joints] for name, values in fit.point.items()}, tuple(fit.active[j] for j in joints))
    sizes = Scales(**{name: values[joints] for name, values in vars(scales).items()})
    better = improve(choose_joints(data, joints), some, sizes, iterations)
    assert better.rms is not None
    fit = fit if fit.rms is not None else evaluate(data, fit)
    assert fit.rms is not None
    point, rms = {name: values.copy() for name, values in fit.point.items()}, fit.rms.copy()
    for name, values in better.point.items():
        point[name][joints] = values
    rms[joints] = better.rms
    return replace(fit, point=point, rms=rms)


def _stepped(
    data: Windows,
    fit: LoopFit,
    names: Sequence[Sequence[str]],
    now: Array,
    slopes: list[Array],
    damping: float,
    scales: Scales,
) -> dict[str, Array]:
    """The point after one damped Gauss-Newton step."""
    return stepped(data, fit, scales, names, *solve(names, len(fit.shared), now, slopes, damping))


def stepped(
    data: Windows, fit: LoopFit, scales: Scales, names: Sequence[Sequence[str]], steps: Sequence[Array], common: Array
) -> dict[str, Array]:
    """The point after steps of each joint's own parameters and of the shared ones.

    What goes with a gain is scaled as the gain is and moved by what its step is more than that: however far the scale
    moves, ratios stay.
    """
    point = {name: values.copy() for name, values in fit.point.items()}
    for j, (own, each) in enumerate(zip(names, steps, strict=True)):
        step = dict(zip(own, each.tolist(), strict=True))
        scale = float(np.clip(step.get("kp", 0.0), -FARTHEST, FARTHEST))
        for name in set(gain_companions(own)).difference(LOGARITHMIC):
            step[name] += (np.exp(scale) - 1.0 - scale) * relative_step(name, point[name][j], scales, j)
        for name, size in step.items():
            point[name][j] = step_parameter(name, float(point[name][j]), size, scales, j)
    for name, size in zip(fit.shared, common.tolist(), strict=True):
        point[name] = np.clip(point[name] + size, *data.ranges[name])
    return point


def solve(
    names: Sequence[Sequence[str]], shared: int, now: Array, slopes: list[Array], damping: float
) -> tuple[list[Array], Array]:
    """Steps of each joint's own parameters and of the shared ones; each joint is weighted by what it leaves."""
    sizes = [len(own) for own in names]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    total = int(starts[-1]) + shared
    normal, right = np.zeros((total, total)), np.zeros(total)
    for j, x in enumerate(slopes):
        flat, r = x.reshape(len(x), now[:, j].size), now[:, j].ravel()
        weight = 1.0 / max(float(r @ r), 1e-300)
        index = np.concatenate([np.arange(starts[j], starts[j + 1]), np.arange(starts[-1], total)]).astype(int)
        normal[np.ix_(index, index)] += weight * flat @ flat.T
        right[index] -= weight * flat @ r
    diagonal = np.diag(normal).copy()
    normal[np.diag_indices(total)] += damping * diagonal + 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30)
    step: Array = np.asarray(np.linalg.solve(normal, right)) if total else np.zeros(0)
    return [step[starts[j] : starts[j + 1]] for j in range(len(names))], step[starts[-1] :]
