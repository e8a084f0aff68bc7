"""Recordings: an arm's channels over time, and their columns in tables."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.errors import BadInput

COLUMNS = {
    "position": "q",
    "velocity": "dq",
    "torque": "tau",
    "motor_torque": "tau_motor",
    "torque_command": "tau_cmd",
    "position_command": "q_cmd",
    "temperature": "temp",
}
"""Channel name -> column prefix; joint i of 1..n has the column `PREFIX_i`."""
_INDEX = re.compile(r"[1-9][0-9]{0,8}")
MOST_JOINTS = 64
"""A recording of more joints is refused."""
MOST_COLUMNS = 1000
"""Likewise of more columns, whatever they hold."""
MOST_BYTES = 2 << 30
"""Likewise of more content than this once unpacked, as 64-bit numbers: some 9 hours of seven joints at 250 Hz."""
PIECE_BYTES = 1 << 24
"""Bytes that are unpacked at a time."""
TORQUE_CHANNELS = ("torque", "motor_torque", "torque_command")


@dataclass(frozen=True, eq=False)
class Recording:
    """Channels of n joints at K times; a missing value is NaN, a missing channel is None."""

    t: Array
    """Time, strictly increasing [s], shape (K,)."""
    position: Array
    """Position sensor readings [rad], shape (K, n)."""
    velocity: Array | None = None
    """[rad/s], shape (K, n)."""
    torque: Array | None = None
    """Joint torque sensor, link side of the transmission [N·m], shape (K, n)."""
    motor_torque: Array | None = None
    """The drive's own estimate [N·m], shape (K, n)."""
    torque_command: Array | None = None
    """Target torque [N·m], shape (K, n)."""
    position_command: Array | None = None
    """[rad], shape (K, n)."""
    temperature: Array | None = None
    """[°C], shape (K, n)."""
    names: tuple[str, ...] = ()
    """Joint names base to tip; `joint_1` … if the file has no names."""
    warning: str = ""
    """Parts of the file that were ignored or could not be read; empty if everything was read."""

    def __post_init__(self) -> None:
        if not self.names:
            object.__setattr__(self, "names", default_names(self.n))

    @property
    def n(self) -> int:
        return int(self.position.shape[1])

    def channels(self) -> dict[str, Array]:
        """The channels present, by name, each (K, n)."""
        found = {name: getattr(self, name) for name in COLUMNS}
        return {name: values for name, values in found.items() if values is not None}

    def check(self, source: str) -> "Recording":
        """Return this recording if it is valid, else raise BadInput with one line that begins with `source`."""
        if self.t.ndim != 1 or self.t.size < 2:
            raise BadInput(f"{source}: {self.t.size} rows: a recording needs at least two")
        _check_time(self.t, source)
        for name, values in self.channels().items():
            if values.shape != (self.t.size, len(self.names)):
                expected = (self.t.size, len(self.names))
                raise BadInput(f"{source}: channel {name} has shape {values.shape}, expected {expected}")
            _check_finite_or_nan(values, COLUMNS[name], source)
        if not any(getattr(self, name) is not None for name in (*TORQUE_CHANNELS, "position_command")):
            wanted = ", ".join(f"{COLUMNS[name]}_1" for name in TORQUE_CHANNELS)
            raise BadInput(f"{source}: no torque channel: at least one of {wanted} …, or q_cmd_1 …, is required")
        return self


def require_width(columns: Sequence[str], source: str) -> int:
    """The highest joint number of the columns, at least 1; raises BadInput where no recording has so many."""
    if len(columns) > MOST_COLUMNS:
        raise BadInput(f"{source}: {len(columns)} columns, expected at most {MOST_COLUMNS}")
    n = max((index for column in columns if (index := _joint_index(column)) is not None), default=1)
    if n > MOST_JOINTS:
        raise BadInput(f"{source}: has a column of joint {n}, expected at most {MOST_JOINTS} joints")
    return n


def require_size(size: int, source: str) -> None:
    """Raise BadInput where a recording holds more bytes than it may."""
    if size > MOST_BYTES:
        raise BadInput(f"{source}: holds more than {MOST_BYTES / 1e9:.1f} GB: split it into several recordings")


def default_names(n: int) -> tuple[str, ...]:
    return tuple(f"joint_{i}" for i in range(1, n + 1))


def columns_of(recording: Recording) -> dict[str, Array]:
    """The recording as columns (docs/formats.md), `t` first, each (K,)."""
    columns = {"t": recording.t}
    for name, values in recording.channels().items():
        columns |= {f"{COLUMNS[name]}_{i + 1}": values[:, i] for i in range(recording.n)}
    return columns


def channels_of(columns: Mapping[str, Array], source: str) -> dict[str, Array | None]:
    """Group columns into channels (K, n); raises BadInput that names the first missing column."""
    n = joint_count(list(columns), source)
    grouped: dict[str, Array | None] = {}
    for name, prefix in COLUMNS.items():
        wanted = [f"{prefix}_{i}" for i in range(1, n + 1)]
        grouped[name] = np.column_stack([columns[column] for column in wanted]) if wanted[0] in columns else None
    return grouped


def joint_count(columns: list[str], source: str) -> int:
    """Number of joints that the column names describe; raises BadInput that names a missing column."""
    n = require_width(columns, source)
    present = set(columns)
    for name, prefix in COLUMNS.items():
        wanted = [f"{prefix}_{i}" for i in range(1, n + 1)]
        missing = [column for column in wanted if column not in present]
        if missing and (name == "position" or len(missing) < n):
            others = f" ({', '.join(wanted[:1] + wanted[-1:])} expected)" if n > 1 else ""
            raise BadInput(
                f"{source}: column {missing[0]} is missing: channel {name} needs one column for each joint{others}"
            )
    if "t" not in present:
        raise BadInput(f"{source}: column t is missing: it holds the time [s], which increases in every row")
    return n


def is_channel(column: str) -> bool:
    return column == "t" or _joint_index(column) is not None


def take_joints(recording: Recording, order: Sequence[int], names: tuple[str, ...] = ()) -> Recording:
    """Some of a recording's joints, in another order; `names` replaces theirs."""
    channels = {name: values[:, list(order)] for name, values in recording.channels().items()}
    return replace(recording, names=names or tuple(recording.names[i] for i in order), **channels)  # type: ignore[arg-type]


def slice_rows(recording: Recording, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Recording:
    """Some rows of a recording, with their times unchanged."""
    values = {field.name: getattr(recording, field.name) for field in fields(recording)}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = value[rows]
    return Recording(**values)


def channel_column(column: str) -> tuple[str, int] | None:
    """Channel prefix and joint number from 1 of a column's name, or None if it is not that of a channel."""
    prefix, _, index = column.rpartition("_")
    known = prefix in COLUMNS.values() and _INDEX.fullmatch(index) is not None
    return (prefix, int(index)) if known else None


def _joint_index(column: str) -> int | None:
    place = channel_column(column)
    return place[1] if place else None


def _check_time(t: Array, source: str) -> None:
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise BadInput(f"{source}: row {bad[0] + 1}: t is {t[bad[0]]}, expected a time [s]")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        row = back[0] + 1
        remedy = " (write times with more digits, or the times of sampling instead of the times of receipt)"
        alike = remedy if t[row] == t[row - 1] else ""
        raise BadInput(
            f"{source}: row {row + 1}: t is {t[row]:.9g} after {t[row - 1]:.9g}, but time must increase{alike}"
        )


def _check_finite_or_nan(values: Array, prefix: str, source: str) -> None:
    bad = np.argwhere(np.isinf(values))
    if bad.size:
        row, joint = bad[0]
        raise BadInput(f"{source}: row {row + 1}: {prefix}_{joint + 1} is infinite, expected a number or NaN")
