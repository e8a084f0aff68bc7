"""Drives that do not make the torque they are asked for: they show in the command against the drive's own estimate.

Where a recording has a command but no estimate, they show in the command against the sensor or the model.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.signal import lfilter

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

SHORTEST, LONGEST = 1e-3, 0.2
"""Times that count as a lag or delay [s]."""
CLIPPED = 0.2
"""What is clipped is, within this, all that is above the level."""


def commanding(layout: Layout) -> str | None:
    """The channel whose residual a drive's shortcoming shows in."""
    return layout.command or ("tau_cmd" if layout.motor == "tau_cmd" else None)


class _Drive(Effect):
    def places(self, layout: Layout) -> range:
        return range(layout.n if commanding(layout) else 0)

    def missing(self, command: Array, shape: float, rate: float) -> Array:
        """Command less torque made, (K,), for the whole shape."""
        raise NotImplementedError

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        channel = commanding(layout)
        assert channel is not None
        lost = self.missing(signals.reading["tau_cmd"][:, place], shape[0], signals.rate)
        return {(channel, place): lost[:, None]}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(0.6 < coefficients[0] < 1.6)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([shape[0]])


class _Late(_Drive):
    parameters = (Parameter("time", "s"),)
    shapes = ((0.01,),)
    secant = True

    def resized(self, coefficients: Array, shape: Shape) -> Shape:
        return (float(np.clip(shape[0] * coefficients[0], SHORTEST, LONGEST)),)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(SHORTEST < coefficients[0] * shape[0] < LONGEST)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return coefficients * shape[0]


class Lag(_Late):
    """A first-order lag behind the command."""

    id = "actuator.lag"

    def missing(self, command: Array, shape: float, rate: float) -> Array:
        """By the trapezoidal rule, whose lag is exactly the shape however few samples it spans."""
        pole = (2.0 * rate * shape - 1.0) / (2.0 * rate * shape + 1.0)
        gain = 0.5 * (1.0 - pole)
        follow, _ = lfilter([gain, gain], [1.0, -pole], command, zi=[(1.0 - gain) * command[0]])
        return np.asarray(command - follow)


class Delay(_Late):
    """The command carried out late."""

    id = "actuator.delay"

    def missing(self, command: Array, shape: float, rate: float) -> Array:
        t = np.arange(len(command)) / rate
        return np.asarray(command - np.interp(t - shape, t, command))


class Saturation(_Drive):
    """Torque clipped at a limit."""

    id = "actuator.saturation"
    parameters = (Parameter("limit", "N·m"),)
    usual = 1.0

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        asked = np.concatenate([np.abs(s.reading["tau_cmd"][:, place]) for s in signals])
        return tuple(
            (float(level),) for level in np.quantile(asked, (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.995, 0.999))
        )

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(1, CLIPPED)

    def missing(self, command: Array, shape: float, rate: float) -> Array:
        return np.asarray(command - np.clip(command, -shape, shape))


EFFECTS: tuple[Effect, ...] = (Lag(), Delay(), Saturation())
