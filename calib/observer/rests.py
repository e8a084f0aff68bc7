"""Rest detection: turns samples into rows, one averaged row per stop of the arm; and how rows and all else are saved.

Saved are JSON values, read back whole or not at all. Every part of the observer has `save() -> dict` and
`restore(values)`, which raises one of UNREADABLE where the values do not fit: the observer restores copies of its
parts, and keeps them if all fit. Times are not saved, because clocks restart with the machine.
"""

from copy import copy
from typing import Any, Protocol, TypeVar

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.config import LONGEST_GAP, ObserverConfig
from gcomp.arrays import Array, as_array

UNREADABLE = (LookupError, TypeError, ValueError, OverflowError)
"""Raised while values are read that are missing, of another type or of another shape (BadArray is a ValueError)."""


class _Saved(Protocol):
    def restore(self, values: dict[str, Any]) -> None: ...


Part = TypeVar("Part", bound=_Saved)


def restored(part: Part, values: dict[str, Any]) -> Part:
    """A copy of a part that continues from saved values; raises one of UNREADABLE."""
    made = copy(part)
    made.restore(values)
    return made


def save_rows(rows: list[StaticReading]) -> list[list[Any]]:
    """Rows as JSON values: time, position, torque, side of approach, and temperature if a drive tells it."""
    told = ([known(row.temperature)] if np.isfinite(row.temperature).any() else [] for row in rows)
    return [
        [row.t, row.position.tolist(), row.torque.tolist(), row.direction.tolist(), *warm]
        for row, warm in zip(rows, told, strict=True)
    ]


def read_rows(values: Any, n: int) -> list[StaticReading]:
    """The rows of n joints that `save_rows` wrote; raises one of UNREADABLE."""
    return [_row(n, *row) for row in values]


def _row(n: int, t: Any, position: Any, torque: Any, direction: Any, temperature: Any = None) -> StaticReading:
    position, torque, direction = (as_array("row", column, (n,)) for column in (position, torque, direction))
    untold = np.full(n, np.nan)
    told = as_array("row", untold if temperature is None else temperature, (n,), finite=False)
    return StaticReading.of(float(t), position, torque, direction, temperature=told)


def known(values: Array) -> Any:
    """An array as JSON values, null for NaN; `as_array` reads it back."""
    kept = values.astype(object)
    kept[np.isnan(values)] = None
    return kept.tolist()


NEW_POSE = 0.05
"""A stop counts as another one once some joint has moved this far [rad]: a long rest is one row."""


class RestDetector:
    """Averages position and torque over each rest.

    Rest is detected from position alone, because velocity derived from an encoder is coarse.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._config = config
        self._anchor = np.full(n, np.nan)
        self._since, self._last = -np.inf, -np.inf
        self._last_stop = np.full(n, np.nan)
        self._direction = np.zeros(n)
        self._samples: list[tuple[float, Array, Array]] = []
        self._done = False

    def handle(self, t: float, position: Array, torque: Array) -> StaticReading | None:
        """Take one sample (SI, (n,) each, NaN if missing); returns the row of this rest once complete, else None."""
        config = self._config
        if np.isnan(position).any() or np.isnan(torque).any():
            return None
        moved = not np.abs(position - self._anchor).max() <= config.still_band
        if moved or t - self._last > LONGEST_GAP:
            self._restart(t, position, moved=moved)
        self._last = t
        if self._done or t - self._since < config.settle_time:
            return None
        self._samples.append((t, position.copy(), torque.copy()))
        if t - self._samples[0][0] < config.average_time:
            return None
        return self._complete()

    def save(self) -> dict[str, Any]:
        """Directions of the last motion and the last stop, as JSON values."""
        return {"direction": self._direction.tolist(), "left": known(self._last_stop)}

    def restore(self, values: dict[str, Any]) -> None:
        shape, stop = self._direction.shape, [np.nan if q is None else q for q in values["left"]]
        self._direction = as_array("direction", values["direction"], shape)
        self._last_stop = as_array("left", stop, shape, finite=False)

    def _restart(self, t: float, position: Array, moved: bool) -> None:
        if moved:
            step = position - self._anchor
            self._direction = np.where(np.abs(step) > self._config.still_band / 2, np.sign(step), self._direction)
        self._anchor, self._since = position.copy(), t
        self._samples.clear()
        away = np.abs(position - self._last_stop).max()
        self._done = self._done and bool(away < NEW_POSE)

    def _complete(self) -> StaticReading:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        self._samples.clear()
        half = len(times) // 2
        error = np.abs(torques[:half].mean(axis=0) - torques[half:].mean(axis=0)) / 2
        here: Array = positions.mean(axis=0)
        self._last_stop, self._done = here, True
        return StaticReading.of(
            float(times.mean()), here, torques.mean(axis=0), self._direction, count=len(times), torque_error=error
        )
