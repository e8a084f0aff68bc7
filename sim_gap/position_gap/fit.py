"""Parameters of all joints fitted to simulated minus measured positions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from gcomp.estimate.problem import FREEDOM, EstimationProblem, FittedParameter, linearise
from gcomp.estimate.solve import solve
from sim_gap.position_gap.links import range_of, size_of
from sim_gap.position_gap.parameters import (
    INVERSE,
    LOGARITHMIC,
    PARAMETERS,
    WITH_TORQUE,
    Scales,
    from_coordinate,
    to_coordinate,
)
from sim_gap.position_gap.simulation import simulate
from sim_gap.position_gap.windows import Windows

INDEPENDENT_S = 0.5
"""Time over which residuals are correlated [s]."""
DIFFERENCE, RELATIVE = 0.05, 0.02
"""Steps of finite differences: in units of the size at which a parameter is tried, and of a logarithm."""
PRIOR_RELATIVE = 3.0
"""Standard deviation of the logarithm of a gain before any recording."""
Point = Mapping[str, Array]
"""Parameter → (J,)."""
Place = tuple[int, str]
"""Joint, or −1 for the whole arm, and name of a parameter."""


@dataclass(frozen=True, eq=False)
class LoopFit:
    """Parameters of all joints, those that were fitted, and what they leave."""

    point: dict[str, Array]
    free: tuple[Place, ...] = ()
    """The fitted ones: those of the first joint first, those of the whole arm last."""
    rms: Array | None = None
    """RMS of the residual per joint and window [rad], (J, W)."""

    def at(self, joint: int) -> tuple[str, ...]:
        """Names that were fitted at a joint, or with −1 of the whole arm."""
        return tuple(name for j, name in self.free if j == joint)

    def freed(self, places: Iterable[Place]) -> "LoopFit":
        """The same with these places fitted and no others."""
        free = sorted(dict.fromkeys(places), key=lambda place: (place[0] < 0, place[0]))
        return replace(self, free=tuple(free), rms=None)

    def with_values(self, **values: Array) -> "LoopFit":
        return replace(self, point={**self.point, **values})


def coordinate(fit: LoopFit, scales: Scales, joint: int, name: str) -> float:
    """A fit's value of a parameter in its own coordinate; `joint` is −1 for the whole arm."""
    value = float(fit.point[name][max(joint, 0)])
    return value if joint < 0 else to_coordinate(name, value, float(scales.of(name)[joint]))


def residuals(data: Windows, values: Mapping[str, Array]) -> Array:
    """Simulated minus measured positions, as far as they count, (P, To, J, W)."""
    return (simulate(data, values) - data.measured) * (data.weight > 0.0)


def root_mean_squares(data: Windows, residual: Array) -> Array:
    """RMS over the time of each window, (…, J, W); 0 for one without samples."""
    total = np.einsum("...tjw,tjw->...jw", residual**2, data.weight)
    return np.asarray(np.sqrt(total / np.maximum(data.weight.sum(0), 1.0)))


def batch(points: Sequence[Point]) -> dict[str, Array]:
    """Parameter → (P, J) from points that have the same names."""
    return {name: np.stack([point[name] for point in points]) for name in points[0]}


def evaluate(data: Windows, fit: LoopFit) -> LoopFit:
    return replace(fit, rms=root_mean_squares(data, residuals(data, batch([fit.point])))[0])


class Layout:
    """Parameters of joints (joint, name) and of the whole arm (−1, name) in the order of an `EstimationProblem`."""

    def __init__(self, data: Windows, scales: Scales, point: Point, names: Iterable[Place]) -> None:
        self.data, self.scales, self.point = data, scales, dict(point)
        self.names = list(names)
        for j, name in self.names:
            if j < 0:
                self.point.setdefault(name, np.zeros(data.joints))

    def size(self, j: int, name: str) -> float:
        return 1.0 if j < 0 else float(self.scales.of(name)[j])

    def theta(self, point: Point) -> Array:
        """The coordinates of a point, (K,)."""
        return np.array(
            [
                float(point[name][0]) if j < 0 else to_coordinate(name, float(point[name][j]), self.size(j, name))
                for j, name in self.names
            ]
        )

    def at(self, theta: Array) -> dict[str, Array]:
        """The point at coordinates (K,)."""
        point = {name: values.copy() for name, values in self.point.items()}
        for x, (j, name) in zip(theta, self.names, strict=True):
            if j < 0:
                point[name] = np.full(self.data.joints, x)
            else:
                point[name][j] = from_coordinate(name, np.array(x), np.array(self.size(j, name)))
        return point

    def problem(self, nominal: Point, steps: Mapping[Place, float], floor: Array) -> EstimationProblem:
        parameters = tuple(self._parameter(j, name, nominal, steps.get((j, name))) for j, name in self.names)
        shape = (self.data.joints, -1)

        def predict(thetas: Array) -> Array:
            left = residuals(self.data, batch([self.at(theta) for theta in thetas]))
            return left.transpose(0, 2, 1, 3).reshape(len(thetas), *shape)

        weight = self.data.weight.transpose(1, 0, 2).reshape(shape) * min(self.data.judged_s / INDEPENDENT_S, 1.0)
        block = np.broadcast_to(np.arange(self.data.count), (len(self.data.measured), self.data.count)).ravel()
        return EstimationProblem(parameters, predict, weight, block.astype(np.intp), floor)

    def _parameter(self, j: int, name: str, nominal: Point, step: float | None) -> FittedParameter:
        if j < 0:
            low, high = range_of(self.data.plant.sim.arm, name)
            size = size_of(self.data.plant.sim.arm, name)
            return FittedParameter(name, 0.0, 0.5 * max(-low, high), low, high, -1, step or DIFFERENCE * size)
        size = self.size(j, name)
        low, high = PARAMETERS[name].low, PARAMETERS[name].high
        if name in LOGARITHMIC:
            ends, own, usual = (float(np.log(max(low, 1e-12))), float(np.log(high))), PRIOR_RELATIVE, RELATIVE
        elif name in INVERSE:
            ends, own, usual = (0.0, size / low), PARAMETERS[name].spread, DIFFERENCE
        else:
            ends, own, usual = (low / size, high / size), PARAMETERS[name].spread, DIFFERENCE
        return FittedParameter(
            name, to_coordinate(name, float(nominal[name][j]), size), own, *ends, channel=j, step=step or usual
        )


def jacobian(data: Windows, point: Point, scales: Scales, places: Sequence[Place]) -> tuple[Array, list[Array]]:
    """Residual now (To, J, W), and per joint its derivatives (K_j + S, To, W) by its own parameters at these places and
    by those of the whole arm, in their own coordinates."""
    layout = Layout(data, scales, point, places)
    problem, theta = layout.problem(point, {}, np.zeros(data.joints)), layout.theta(layout.point)
    at = {place: k for k, place in enumerate(places)}
    parameters = list(problem.parameters)
    for (j, name), k in at.items():
        if name == "kp":
            others = tuple((at[j, each], float(theta[at[j, each]])) for each in WITH_TORQUE if (j, each) in at)
            parameters[k] = replace(parameters[k], along=others)
    about = linearise(replace(problem, parameters=tuple(parameters)), theta, range(len(places)))
    shape = (len(data.measured), data.count)
    now = about.residual.reshape(data.joints, *shape).transpose(1, 0, 2)
    return now, [x.reshape(len(x), *shape) for x in about.slopes]


def acting(places: Sequence[Place], joint: int) -> NDArray[np.intp]:
    """Numbers of the parameters that act on a joint: its own and those of the whole arm."""
    return np.array([k for k, (j, _) in enumerate(places) if j in (joint, -1)], np.intp)


def improve(
    data: Windows,
    fit: LoopFit,
    scales: Scales,
    floor: Array,
    nominal: Point,
    iterations: int = 6,
    freedom: float = FREEDOM,
) -> LoopFit:
    """The most probable values of what is active, from a fit on; `freedom` is that of the residuals' distribution."""
    if not fit.free:
        return evaluate(data, fit)
    layout = Layout(data, scales, fit.point, fit.free)
    problem = replace(layout.problem(nominal, {}, floor), freedom=freedom)
    found = solve(problem, layout.theta(layout.point), range(len(fit.free)), iterations)
    shape = (data.joints, len(data.measured), data.count)
    left = found.residual.reshape(shape).transpose(1, 0, 2)
    return replace(fit, point=layout.at(found.theta), rms=root_mean_squares(data, left))
