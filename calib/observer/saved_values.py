"""The rule by which the parts of the observer are saved: JSON values, read back whole or not at all.

Every part has `save() -> dict` and `restore(values) -> bool`; `restore` returns False and changes nothing if the values
do not fit. Times are not saved, because clocks restart with the machine.
"""

from typing import Any

from calib.motion.static_reading import StaticReading
from gcomp.arrays import as_array

UNREADABLE = (LookupError, TypeError, ValueError, OverflowError)
"""Raised while values are read that are missing, of another type or of another shape (BadArray is a ValueError)."""


def save_rows(rows: list[StaticReading]) -> list[list[Any]]:
    """Rows as JSON values: time, position, torque and side of approach."""
    return [[row.t, row.position.tolist(), row.torque.tolist(), row.direction.tolist()] for row in rows]


def read_rows(values: Any, n: int) -> list[StaticReading]:
    """The rows of n joints that `save_rows` wrote; raises one of UNREADABLE."""
    return [
        StaticReading.of(float(t), *(as_array("row", column, (n,)) for column in (position, torque, direction)))
        for t, position, torque, direction in values
    ]
