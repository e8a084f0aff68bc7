"""Parameters of all joints fitted to simulated minus measured positions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array
from gcomp.estimate.problem import FREEDOM, EstimationProblem, FittedParameter, linearise
from gcomp.estimate.solve import solve
from sim_gap.position_gap.parameters import (
    EFFECTS,
    INVERSE,
    LOGARITHMIC,
    PARAMETERS,
    WITH_TORQUE,
    Scales,
    from_coordinate,
    range_of,
    shared_effects,
    size_of,
    to_coordinate,
)
from sim_gap.position_gap.plant import Point
from sim_gap.position_gap.simulation import simulate
from sim_gap.position_gap.windows import Windows

INDEPENDENT_S = 0.5
"""Time over which residuals are correlated [s]."""
DIFFERENCE, RELATIVE = 0.05, 0.02
"""Steps of finite differences: in units of the size at which a parameter is tried, and of a logarithm."""
PRIOR_RELATIVE = 3.0
"""Standard deviation of the logarithm of a gain before any recording."""
Place = tuple[int, str]
"""Joint, or −1 for the whole arm, and name of a parameter."""
Group = tuple[str, tuple[int, ...]]
"""An effect with the joints that have it; no joints for one of the whole arm."""


@dataclass(frozen=True, eq=False)
class LoopFit:
    """Parameters of all joints, and those that were fitted."""

    point: dict[str, Array]
    free: tuple[Place, ...] = ()
    """The fitted ones: those of the first joint first, those of the whole arm last."""

    def at(self, joint: int) -> tuple[str, ...]:
        """Names that were fitted at a joint, or with −1 of the whole arm."""
        return tuple(name for j, name in self.free if j == joint)

    def freed(self, places: Iterable[Place]) -> "LoopFit":
        """The same with these places fitted and no others."""
        free = sorted(dict.fromkeys(places), key=lambda place: (place[0] < 0, place[0]))
        return replace(self, free=tuple(free))

    def with_values(self, **values: Array) -> "LoopFit":
        return replace(self, point={**self.point, **values})


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

    @property
    def arm(self) -> RigidArm:
        return self.data.plant.sim.arm

    def places_of(self, group: Group) -> list[Place]:
        effect, joints = group
        if joints:
            return [(j, name) for j in joints for name in EFFECTS[effect].parameters]
        return [(-1, name) for name in shared_effects(self.arm)[effect]]

    def score(self, point: Point) -> Array:
        """Half the logarithm of the mean square, times independent samples, per joint (J,); less is better."""
        return np.asarray(0.5 * self.samples * np.log(rms_on(self.data, point) ** 2 + self.floor**2))

    @property
    def samples(self) -> Array:
        """Independent samples of each joint, (J,)."""
        return np.asarray(self.data.weight.sum((0, 2)) * min(self.data.judged_s / INDEPENDENT_S, 1.0))

    def size_of(self, name: str) -> Array:
        """Unit of the levels of a limit, (J,): the highest speed, if a joint moves at all, or the usual size."""
        if name != "slew":
            return self.scales.of(name)
        return np.asarray(np.maximum(np.abs(self.data.v).max(axis=(0, 2)), PARAMETERS["slew"].low))

    def improve(self, fit: LoopFit, iterations: int = 5, freedom: float = FREEDOM) -> LoopFit:
        """The most probable values of what is free, from a fit on; `freedom` is that of the residuals' distribution."""
        if not fit.free:
            return fit
        layout = Layout(self, fit.point, fit.free)
        problem = replace(layout.problem(), freedom=freedom)
        found = solve(problem, layout.theta, range(len(fit.free)), iterations)
        return replace(fit, point=layout.at(found.theta))


def residuals(data: Windows, points: Sequence[Point]) -> Array:
    """Simulated minus measured positions, as far as they count, (P, To, J, W)."""
    return (simulate(data, points) - data.measured) * (data.weight > 0.0)


def root_mean_squares(data: Windows, residual: Array) -> Array:
    """RMS over the time of each window, (…, J, W); 0 for one without samples."""
    total = np.einsum("...tjw,tjw->...jw", residual**2, data.weight)
    return np.asarray(np.sqrt(total / np.maximum(data.weight.sum(0), 1.0)))


def joint_rms(data: Windows, rms: Array) -> Array:
    """RMS over all windows of each joint, (J,), from that of each window (J, W)."""
    count = data.weight.sum(0)
    return np.asarray(np.sqrt((rms**2 * count).sum(1) / np.maximum(count.sum(1), 1.0)))


def rms_on(data: Windows, point: Point) -> Array:
    """RMS of the position gap of each joint [rad], (J,)."""
    return joint_rms(data, root_mean_squares(data, residuals(data, [point]))[0])


class Layout:
    """Parameters of joints and of the whole arm in the order of an `EstimationProblem`."""

    def __init__(self, search: LoopSearch, point: Point, places: Sequence[Place]) -> None:
        self.search, self.point, self.places = search, dict(point), places
        self.joints = search.data.joints
        for j, name in places:
            if j < 0:
                self.point.setdefault(name, np.zeros(self.joints))

    def size(self, j: int, name: str) -> float:
        return 1.0 if j < 0 else float(self.search.scales.of(name)[j])

    @property
    def theta(self) -> Array:
        """The coordinates of the point, (K,)."""
        values = ((j, name, float(self.point[name][max(j, 0)])) for j, name in self.places)
        return np.array([x if j < 0 else to_coordinate(name, x, self.size(j, name)) for j, name, x in values])

    def at(self, theta: Array) -> dict[str, Array]:
        """The point at coordinates (K,)."""
        point = {name: values.copy() for name, values in self.point.items()}
        for x, (j, name) in zip(theta, self.places, strict=True):
            if j < 0:
                point[name] = np.full(self.joints, x)
            else:
                point[name][j] = from_coordinate(name, np.array(x), np.array(self.size(j, name)))
        return point

    def problem(self, steps: Mapping[Place, float] | None = None) -> EstimationProblem:
        """The problem of these parameters; `steps` are those of finite differences that are not the usual ones."""
        data, shape = self.search.data, (self.joints, -1)
        parameters = tuple(self._parameter(j, name, (steps or {}).get((j, name))) for j, name in self.places)

        def predicted(data: Windows, thetas: Array) -> Array:
            left = residuals(data, [self.at(theta) for theta in thetas])
            return left.transpose(0, 2, 1, 3).reshape(len(thetas), *shape)

        weight = data.weight.transpose(1, 0, 2).reshape(shape) * min(data.judged_s / INDEPENDENT_S, 1.0)
        # where a joint rests is what friction left of its way there: that tells nothing of links, gravity or gains
        weight[sorted(self.search.resting)] = 0.0
        block = np.broadcast_to(np.arange(data.count), (len(data.measured), data.count)).ravel().astype(np.intp)
        fine, coarse = (partial(predicted, each) for each in (data, replace(data, plant=data.plant.coarser)))
        return EstimationProblem(parameters, fine, weight, block, self.search.floor, cheaper=coarse)

    def _parameter(self, j: int, name: str, step: float | None) -> FittedParameter:
        if j < 0:
            low, high = range_of(self.search.arm, name)
            size = size_of(self.search.arm, name)
            return FittedParameter(name, 0.0, 0.5 * max(-low, high), low, high, -1, step or DIFFERENCE * size)
        size = self.size(j, name)
        low, high = PARAMETERS[name].low, PARAMETERS[name].high
        if name in LOGARITHMIC:
            ends, own, usual = (float(np.log(max(low, 1e-12))), float(np.log(high))), PRIOR_RELATIVE, RELATIVE
        elif name in INVERSE:
            ends, own, usual = (0.0, size / low), PARAMETERS[name].spread, DIFFERENCE
        else:
            ends, own, usual = (low / size, high / size), PARAMETERS[name].spread, DIFFERENCE
        nominal = to_coordinate(name, float(self.search.nominal[name][j]), size)
        return FittedParameter(name, nominal, own, *ends, channel=j, step=step or usual)


def jacobian(search: LoopSearch, point: Point, places: Sequence[Place]) -> tuple[Array, list[Array]]:
    """Residual now (To, J, W), and per joint its derivatives (K_j + S, To, W) by its own parameters at these places and
    by those of the whole arm, in their own coordinates."""
    data, layout = search.data, Layout(search, point, places)
    problem, theta = layout.problem(), layout.theta
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
