"""When is a joint at rest, and when is its average exact enough: judged from the samples, not from a fixed sleep."""

from dataclasses import dataclass

import numpy as np

from calib.arm.sweep_section import SweepSection
from gcomp.arrays import Array, Mask

DRIFT = 2.5
"""Standard errors by which the means of the window's halves may differ."""
WINDOW_TIMES = 3.0
"""Time constants of the slowest position loop in a window: what drifts more slowly is what one would call creep."""
FEWEST_READINGS = 8
"""Torque readings in a window, at the least."""
QUIET = 1.0
"""Torque scatter that is this many times the standard error asked for has settled whatever its shape."""


@dataclass(frozen=True, eq=False)
class SettleRule:
    """The rule of one arm; all arrays (n,)."""

    window: int
    """Cycles over which it judges."""
    timeout: int
    """Cycles after which a reading is taken as it is."""
    max_samples: int
    span: float
    """Half of what a joint at rest may cover during the window [rad]."""
    scatter: float
    standard_error: Array
    """Asked for [N·m]."""

    @classmethod
    def of(
        cls, section: SweepSection, standard_error: Array, period: float, slowest: float = 0.0, torque_cycles: int = 1
    ) -> "SettleRule":
        """From the sweep section; standard error (n,) [N·m] of each reading, cycle `period` [s].

        `slowest` is the longest time constant of the position loops [s], 0 where the drives close them: the window
        covers WINDOW_TIMES of it, unless the arm file names the window. A shorter one takes the slow end of a motion,
        or the turning point of a slow swing, for rest.
        """
        seconds = section.settle_window
        if "settle_window" not in section.model_fields_set:
            seconds = max(seconds, WINDOW_TIMES * slowest)
        window = max(round(seconds / period), FEWEST_READINGS * torque_cycles)
        return cls(
            window=window,
            timeout=round(section.settle_timeout / period),
            max_samples=max(section.max_samples, window),
            span=section.settle_velocity * window * period / 2,
            scatter=section.settle_scatter,
            standard_error=standard_error,
        )

    def settled(self, position: Array, torque: Array, counts: Mask, resolution: Array) -> bool:
        """Whether nothing moves any more: position and torque (W, n) of the last window.

        A joint moves if its position covers more than twice `span` and more than one step of its sensor (an overshoot
        that is turning back covers as much as one that is under way). A torque that `counts` (n,) has settled if it
        scatters no more than its own sample-to-sample noise explains (von Neumann's ratio) and does not drift between
        the window's halves, or scatters too little to matter.
        """
        covered = np.nanmax(position, axis=0) - np.nanmin(position, axis=0)
        if np.any(covered > np.maximum(2 * self.span, 1.5 * resolution)):
            return False
        joints = zip(torque.T, self.standard_error, counts, strict=True)
        return all(self._is_steady(x[np.isfinite(x)], error) for x, error, counted in joints if counted)

    def _is_steady(self, torque: Array, standard_error: float) -> bool:
        """Whether a joint's torque readings (k,) have settled."""
        half = len(torque) // 2
        if half < 2:
            return False
        drift, step = torque[half:].mean() - torque[:half].mean(), float(np.mean(np.diff(torque) ** 2)) / 2
        allowed = max(self.scatter**2 * step, (QUIET * standard_error) ** 2)
        steady = drift**2 <= DRIFT**2 * max(step, standard_error**2) * 4 / len(torque)
        return bool(steady and torque.var() <= allowed)

    def exact(self, torque: Array, counts: Mask) -> bool:
        """Whether the mean of the torque samples (K, n) is as exact as asked for, in every joint that `counts`."""
        error = np.nanstd(torque, axis=0, ddof=1) / np.sqrt(np.isfinite(torque).sum(axis=0))
        return bool(np.all((error <= self.standard_error) | ~counts))
