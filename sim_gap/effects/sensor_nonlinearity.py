"""Torque sensors that bend the signal: crosstalk, hysteresis, dead band, saturation."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim_gap.effects.drive import CLIPPED
from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

PLAY_HZ = 50.0
"""Rate at which a play is followed; smooth torques change little from one sample to the next."""


def largest(signals: Sequence[Signals], joint: int, share: float = 0.98) -> float:
    """Model torque of a joint that is exceeded only in the rest of the time [N·m]."""
    return float(np.quantile(np.concatenate([np.abs(s.model[:, joint]) for s in signals]), share))


class Crosstalk(Effect):
    """The reading takes in a share of another joint's torque."""

    id = "torque.crosstalk"
    parameters = (Parameter("coefficient", "N·m/(N·m)"), Parameter("source", "joint number"))
    counted = frozenset({0})

    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.sensor else 0)

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        return tuple((float(source + 1),) for source in range(signals[0].n) if source != place)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, signals.model[:, int(shape[0]) - 1, None])

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(abs(coefficients[0]) < 0.5)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([coefficients[0], shape[0]])


class _Bent(Effect):
    """An effect whose one parameter is its shape; its coefficient is what the shape says, or near it."""

    shares: tuple[float, ...]
    """Starting shapes as shares of the joint's usual largest torque."""

    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.sensor else 0)

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        return tuple((share * largest(signals, place),) for share in self.shares)

    def missing(self, torque: Array, level: float, rate: float) -> Array:
        """Reading less true torque, (K,)."""
        raise NotImplementedError

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        bent = self.missing(signals.smooth_model[:, place], shape[0], signals.rate)
        return layout.sensor_columns(place, bent[:, None])

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(0.6 < coefficients[0] < 1.6)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([shape[0]])


class Hysteresis(_Bent):
    """The reading stays behind the torque: a play of half width `width`."""

    id = "torque.hysteresis"
    parameters = (Parameter("width", "N·m"),)
    shares = (0.01, 0.03, 0.06, 0.12, 0.25)

    def missing(self, torque: Array, level: float, rate: float) -> Array:
        return play(torque, level, rate) - torque

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        """How far it stays behind after a long way: real hysteresis comes there less abruptly than a play."""
        return np.array([coefficients[0] * shape[0]])


class Deadband(_Bent):
    """Torques smaller than the half width do not show, larger ones show less by it."""

    id = "torque.deadband"
    parameters = (Parameter("width", "N·m"),)
    shares = (0.02, 0.05, 0.1, 0.2, 0.4)

    def missing(self, torque: Array, level: float, rate: float) -> Array:
        return -np.clip(torque, -level, level)


class Saturation(_Bent):
    """The reading does not exceed a limit."""

    id = "torque.saturation"
    parameters = (Parameter("limit", "N·m"),)
    shares = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.995, 0.999)
    usual = 1.0

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        """Levels that the torque exceeds during some of the time."""
        return tuple((largest(signals, place, share),) for share in self.shares)

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(1, CLIPPED)

    def missing(self, torque: Array, level: float, rate: float) -> Array:
        return np.clip(torque, -level, level) - torque


def play(x: Array, half: float, rate: float) -> Array:
    """Output of a play (backlash operator) of half width `half` that starts in its middle, (K,)."""
    step = max(1, int(rate / PLAY_HZ))
    coarse = x[::step]
    out, at = np.empty_like(coarse), float(coarse[0])
    for k, value in enumerate(coarse.tolist()):
        at = min(max(at, value - half), value + half)
        out[k] = at
    return np.interp(np.arange(len(x)), np.arange(len(coarse)) * step, out)


EFFECTS: tuple[Effect, ...] = (Crosstalk(), Hysteresis(), Deadband(), Saturation())
