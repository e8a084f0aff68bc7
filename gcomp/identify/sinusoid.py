"""Fit of the sinusoid that one joint's sweep traces, with covariance (docs/theory.md, section 5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arrays import Array, as_array
from gcomp.errors import BadArray

GAIN_SEARCH = np.linspace(0.7, 1.3, 61)
"""Position gains tried before the refinement: a sweep of less than a turn has local minima (docs/theory.md, 5.2)."""


@dataclass(frozen=True, eq=False)
class SinusoidFit:
    """v = amplitude · sin(position_gain · φ + phase) + offset [+ friction · direction], fitted to one sweep."""

    amplitude: float
    """A ≥ 0 [N·m]."""
    phase: float
    """Φ in (-π, π] [rad]."""
    offset: float
    """o [N·m]."""
    position_gain: float
    """c; 1 unless fitted."""
    friction: float
    """Half the difference between the two approach directions [N·m]; 0 unless directions were given."""
    names: tuple[str, ...]
    """Parameters of `covariance`, in order."""
    covariance: Array
    """Covariance for the given sigma, in units of the parameters."""
    residual: Array
    """v minus the fit (K,) [N·m]."""

    def std(self, name: str) -> float:
        """Standard deviation of one fitted parameter; raises KeyError if it was not fitted."""
        if name not in self.names:
            raise KeyError(f"{name} was not fitted; there are {', '.join(self.names)}")
        return float(np.sqrt(self.covariance[self.names.index(name), self.names.index(name)]))


def fit_sinusoid(
    position: ArrayLike,
    torque: ArrayLike,
    sigma: ArrayLike,
    *,
    direction: ArrayLike | None = None,
    fit_position_gain: bool = False,
) -> SinusoidFit:
    """Fit one joint's sweep: positions φ (K,) [rad], readings v (K,) [N·m], their standard deviation () or (K,).

    `direction` (K,), ±1, is the side of approach of each step; with it a friction column is fitted as well.
    Raises BadArray if the sweep does not determine the parameters asked for.
    """
    phi = as_array("position", position, (None,))
    v = as_array("torque", torque, (len(phi),))
    weight = 1 / np.broadcast_to(as_array("sigma", np.broadcast_to(sigma, phi.shape), (len(phi),)), phi.shape)
    extra = [] if direction is None else [as_array("direction", direction, (len(phi),))]
    gain = _refine_gain(phi, v, weight, extra) if fit_position_gain else 1.0
    linear, _ = _linear_fit(gain, phi, v, weight, extra)
    along_sin, along_cos, offset, *friction = linear
    amplitude, phase = float(np.hypot(along_sin, along_cos)), float(np.arctan2(along_cos, along_sin))
    names = ("amplitude", "phase", "offset") + ("friction",) * len(extra) + ("position_gain",) * fit_position_gain
    angle = gain * phi + phase
    columns = [np.sin(angle), amplitude * np.cos(angle), np.ones_like(phi), *extra]
    if fit_position_gain:
        columns.append(amplitude * np.cos(angle) * phi)
    jacobian = np.stack(columns, axis=1) * weight[:, None]
    scale = np.linalg.norm(jacobian, axis=0)
    if np.any(scale == 0) or len(phi) < len(names) or np.linalg.cond(jacobian / scale) > 1e9:
        raise BadArray(
            f"{len(phi)} steps over {np.ptp(phi):.3f} rad do not determine {', '.join(names)}: sweep a wider range"
        )
    covariance = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    residual = (
        v - amplitude * np.sin(angle) - offset - sum((f * e for f, e in zip(friction, extra, strict=True)), 0 * v)
    )
    return SinusoidFit(
        amplitude,
        phase,
        float(offset),
        float(gain),
        float(friction[0]) if friction else 0.0,
        names,
        covariance,
        residual,
    )


def _linear_fit(gain: float, phi: Array, v: Array, weight: Array, extra: list[Array]) -> tuple[Array, float]:
    """The best (sin, cos, 1, …) coefficients at a position gain, and their weighted sum of squares."""
    columns = np.stack([np.sin(gain * phi), np.cos(gain * phi), np.ones_like(phi), *extra], axis=1) * weight[:, None]
    solution: Array = np.linalg.lstsq(columns, v * weight, rcond=None)[0].astype(np.float64)
    return solution, float(np.sum((columns @ solution - v * weight) ** 2))


def _refine_gain(phi: Array, v: Array, weight: Array, extra: list[Array]) -> float:
    """The position gain of least weighted squares: a search, then Gauss-Newton steps on all parameters."""
    gain = float(min(GAIN_SEARCH, key=lambda c: _linear_fit(c, phi, v, weight, extra)[1]))
    cost = _linear_fit(gain, phi, v, weight, extra)[1]
    for _ in range(50):
        linear, _ = _linear_fit(gain, phi, v, weight, extra)
        sin, cos = np.sin(gain * phi), np.cos(gain * phi)
        slope = (linear[0] * cos - linear[1] * sin) * phi
        columns = np.stack([sin, cos, np.ones_like(phi), *extra, slope], axis=1) * weight[:, None]
        residual = v * weight - columns[:, :-1] @ linear
        step = float(np.linalg.lstsq(columns, residual, rcond=None)[0][-1])
        while abs(step) > 1e-14:
            trial = _linear_fit(gain + step, phi, v, weight, extra)[1]
            if trial < cost:
                break
            step /= 2
        else:
            return gain
        gain, cost = gain + step, trial
    return gain
