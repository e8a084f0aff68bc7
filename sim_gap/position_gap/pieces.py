"""A part of a recording without a break, and its command at any time."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array, Mask


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a recording without a break: commands as they were held from row to row."""

    ends: Array
    """Times at which each command begins, and the last ends [s], (K + 1,)."""
    area: Array
    """Integral of the command up to each of them [rad·s], (K + 1, n)."""
    served: Mask
    """Whether each row is commanded, (K, n)."""
    position: Array
    """Position at the beginning, (n,) [rad]."""
    asked: Array
    """Torque that gravity and springs ask for there, (n,) [N·m]."""
    rests: Mask
    """Whether each joint rests there, (n,)."""

    def command(self, edges: Array, delay: Array, earlier: Array) -> Array:
        """Mean command between the times `edges` (T + 1,), each joint's later by its `delay` (n,) [s]; (T, n).

        `earlier` is the command before the first row, (n,).
        """
        made = [np.interp(edges - late, self.ends, column) for late, column in zip(delay, self.area.T, strict=True)]
        # after the last row the last command holds
        outside = [
            np.minimum(edges - late - self.ends[0], 0.0) * first + np.maximum(edges - late - self.ends[-1], 0.0) * last
            for late, first, last in zip(delay, earlier, self.held[1], strict=True)
        ]
        return np.asarray(np.diff(np.column_stack(made) + np.column_stack(outside), axis=0) / np.diff(edges)[:, None])

    @property
    def held(self) -> tuple[Array, Array]:
        """First and last command, (n,) each."""
        rates = np.diff(self.area, axis=0) / np.diff(self.ends)[:, None]
        return rates[0], rates[-1]

    def served_at(self, times: Array) -> Mask:
        """Whether each joint is commanded at each time, (T, n)."""
        rows = np.searchsorted(self.ends, times + 1e-9, side="right") - 1
        return np.asarray(self.served[np.clip(rows, 0, len(self.served) - 1)])
