"""Parameters of all joints fitted to simulated minus measured positions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.problem import FREEDOM, EstimationProblem, FittedParameter, Linearised, linearise
from gcomp.estimate.solve import solve
from sim_gap.position_gap.parameters import (
    INVERSE,
    LOGARITHMIC,
    PARAMETERS,
    WITH_TORQUE,
    Scales,
    from_coordinate,
    range_of,
    size_of,
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
"""Joint, −1 for the whole arm, and name of a parameter."""


@dataclass(frozen=True, eq=False)
class LoopFit:
    """Parameters of all joints, and those that were fitted."""

    point: dict[str, Array]
    active: tuple[tuple[str, ...], ...]
    """Names fitted at each joint."""
    shared: tuple[str, ...] = ()
    """Names of parameters with one value for the whole arm."""

    def with_values(self, **values: Array) -> "LoopFit":
        return replace(self, point={**self.point, **values})

    @property
    def places(self) -> list[Place]:
        """Fitted parameters: those of the joints, then the whole arm's."""
        return [(j, name) for j, own in enumerate(self.active) for name in own] + [(-1, name) for name in self.shared]

    def has(self, place: Place) -> bool:
        joint, name = place
        return name in (self.active[joint] if joint >= 0 else self.shared)


def batch(points: Sequence[Point]) -> dict[str, Array]:
    """Parameter → (P, J) from points that have the same names."""
    return {name: np.stack([point[name] for point in points]) for name in points[0]}


def residuals(data: Windows, points: Sequence[Point]) -> Array:
    """Simulated minus measured positions, as far as they count, (P, To, J, W). Those of one point are kept."""
    key = b"".join(name.encode() + values.tobytes() for name, values in sorted(points[0].items()))
    if len(points) > 1 or key not in data.known:
        left = (simulate(data, batch(points)) - data.measured) * (data.weight > 0.0)
        if len(points) > 1:
            return np.asarray(left)
        data.known[key] = left
    return data.known[key]


def joint_rms(data: Windows, residual: Array) -> Array:
    """RMS of a residual (…, To, J, W) over all windows of each joint, (…, J) [rad]."""
    squares = np.einsum("...tjw,tjw->...j", residual**2, data.weight)
    return np.asarray(np.sqrt(squares / np.maximum(data.weight.sum((0, 2)), 1.0)))


def rms_on(data: Windows, fit: LoopFit) -> Array:
    """RMS of the position gap of each joint [rad], (J,)."""
    return joint_rms(data, residuals(data, [fit.point])[0])


class Layout:
    """Parameters of joints and of the whole arm in the order of an `EstimationProblem`."""

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

    def rows(self, residual: Array) -> Array:
        """Residuals (…, To, J, W) by channel, (…, J, N)."""
        return np.moveaxis(residual, -2, -3).reshape(*residual.shape[:-3], self.data.joints, -1)

    def problem(
        self, nominal: Point, floor: Array, steps: Mapping[Place, float] | None = None, freedom: float = FREEDOM
    ) -> EstimationProblem:
        """`steps` are those of differences that are not the usual ones."""
        own = steps or {}
        parameters = tuple(self._parameter(j, name, nominal, own.get((j, name))) for j, name in self.names)
        weight = self.rows(self.data.weight * min(self.data.judged_s / INDEPENDENT_S, 1.0))
        block = np.broadcast_to(np.arange(self.data.count), (len(self.data.measured), self.data.count)).ravel()

        def predict(thetas: Array) -> Array:
            return self.rows(residuals(self.data, [self.at(theta) for theta in thetas]))

        return EstimationProblem(parameters, predict, weight, block.astype(np.intp), floor, freedom)

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
        at = {place: k for k, place in enumerate(self.names)}
        others = [(j, each) for each in (WITH_TORQUE if name == "kp" else ()) if (j, each) in at]
        along = tuple((at[p], to_coordinate(p[1], float(self.point[p[1]][j]), self.size(*p))) for p in others)
        value = to_coordinate(name, float(nominal[name][j]), size)
        return FittedParameter(name, value, own, *ends, channel=j, step=step or usual, along=along)


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """Data and nominal parameters of a choice of effects."""

    data: Windows
    scales: Scales
    nominal: dict[str, Array]
    """Parameters of the nominal model, to which one returns that is taken out, (J,) each."""
    floor: Array
    """RMS below which nothing can be seen, per joint (J,) [rad]."""
    excluded: frozenset[str] = frozenset()
    """Effects that do not take part."""
    kept: frozenset[str] = frozenset()
    """Effects that are not taken out."""
    resting: frozenset[int] = frozenset()
    """Joints of which nothing is fitted."""
    open_controller: bool = False
    """Whether the nominal model has no controller, so that the fitted one is no cause of a gap."""
    slopes: Mapping[Place, Array] = field(default_factory=dict)
    """Derivatives of the residual as they were last found, in the parameters' own coordinates: (N,) of the joint, or
    (J, N)."""

    @property
    def samples(self) -> Array:
        """Independent samples of each joint, (J,)."""
        return np.asarray(self.data.weight.sum((0, 2)) * min(self.data.judged_s / INDEPENDENT_S, 1.0))

    def size_of(self, name: str) -> Array:
        """Unit of the levels of a limit, (J,): the highest speed, if a joint moves at all, or the usual size."""
        if name != "slew":
            return self.scales.of(name)
        return np.asarray(np.maximum(np.abs(self.data.v).max(axis=(0, 2)), PARAMETERS["slew"].low))

    def layout(self, point: Point, places: Iterable[Place] = ()) -> Layout:
        return Layout(self.data, self.scales, point, places)

    def looked(self, fit: LoopFit, places: Iterable[Place], steps: Mapping[Place, float] | None = None) -> "LoopSearch":
        """The same with derivatives by these parameters about a fit."""
        layout = self.layout(fit.point, places)
        problem = layout.problem(self.nominal, self.floor, steps)
        now = layout.rows(residuals(self.data, [fit.point]))[0]
        about = linearise(problem, layout.theta(layout.point), range(len(layout.names)), now)
        found = dict(self.slopes) | {place: np.zeros_like(now) for place in layout.names if place[0] < 0}
        for c, (index, rows) in enumerate(zip(about.acting, about.slopes, strict=True)):
            for k, row in zip(index.tolist(), rows, strict=True):
                if layout.names[k][0] < 0:
                    found[layout.names[k]][c] = row
                else:
                    found[layout.names[k]] = row
        return replace(self, slopes=found)

    def linear(self, fit: LoopFit, places: Sequence[Place]) -> Linearised:
        """The residual about a fit, with the derivatives that are known; others are found."""
        missing = [place for place in places if place not in self.slopes]
        slopes = (self.looked(fit, missing) if missing else self).slopes
        layout = self.layout(fit.point, places)
        now = layout.rows(residuals(self.data, [fit.point]))[0]
        acting = [np.array([k for k, (j, _) in enumerate(places) if j in (c, -1)], np.intp) for c in range(len(now))]
        rows = [
            np.array([slopes[places[k]] if places[k][0] >= 0 else slopes[places[k]][c] for k in own]).reshape(
                len(own), now.shape[1]
            )
            for c, own in enumerate(acting)
        ]
        return Linearised(layout.theta(layout.point), now, tuple(acting), tuple(rows))

    def improve(self, fit: LoopFit, iterations: int = 5, freedom: float = FREEDOM) -> LoopFit:
        """The most probable values of what is active, from a fit on, under Student's t of this `freedom`."""
        places = fit.places
        if not places:
            return fit
        layout = self.layout(fit.point, places)
        problem = layout.problem(self.nominal, self.floor, freedom=freedom)
        theta = problem.within(layout.theta(layout.point))
        known = all(place in self.slopes for place in places)
        about = self.linear(replace(fit, point=layout.at(theta)), places) if known else None
        return replace(fit, point=layout.at(solve(problem, theta, range(len(places)), iterations, about)))
