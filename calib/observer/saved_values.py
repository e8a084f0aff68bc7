"""The rule by which the parts of the observer are saved: JSON values, read back whole or not at all.

Every part has `save() -> dict` and `restore(values)`, which raises one of UNREADABLE where the values do not fit: the
observer restores copies of its parts, and keeps them if all fit. Times are not saved, because clocks restart with the
machine.
"""

from copy import copy
from typing import Any, Protocol, TypeVar

import numpy as np

from calib.motion.static_reading import StaticReading
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
    """Rows as JSON values. Of a rest: time, position, torque, side of approach, and temperature if a drive tells it. Of
    a joint in motion: joint, position, torque, velocity, temperature."""
    return [_saved(row) for row in rows]


def _saved(row: StaticReading) -> list[Any]:
    if row.joint is None:
        warm = [known(row.temperature)] if np.isfinite(row.temperature).any() else []
        return [row.t, row.position.tolist(), row.torque.tolist(), row.direction.tolist(), *warm]
    j, velocity = row.joint, float((row.speed or 0.0) * row.direction[row.joint])
    return [j, row.position.tolist(), float(row.torque[j]), velocity, known(row.temperature)[j]]


def read_rows(values: Any, n: int) -> list[StaticReading]:
    """The rows of n joints that `save_rows` wrote; raises one of UNREADABLE."""
    return [_row(n, *row) for row in values]


def _row(n: int, first: Any, position: Any, torque: Any, motion: Any, temperature: Any = None) -> StaticReading:
    if isinstance(torque, int | float):
        if not 0 <= int(first) < n:
            raise ValueError(f"joint {first} of {n}")
        warm = np.nan if temperature is None else float(temperature)
        where = as_array("position", position, (n,))
        return StaticReading.of_motion(0.0, int(first), where, float(torque), float(motion), warm)
    position, torque, direction = (as_array("row", column, (n,)) for column in (position, torque, motion))
    untold = np.full(n, np.nan)
    told = as_array("row", untold if temperature is None else temperature, (n,), finite=False)
    return StaticReading.of(float(first), position, torque, direction, temperature=told)


def known(values: Array) -> Any:
    """An array as JSON values, null for NaN; `as_array` reads it back."""
    kept = values.astype(object)
    kept[np.isnan(values)] = None
    return kept.tolist()
