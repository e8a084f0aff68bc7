"""Corrections of a recording that its user states, or that a check has found: order, sign, unit, zero, clock, source.

Each is an option of `armlink gap diagnose` in text form, so that what a check reports can be pasted into a command.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armlink.arrays import Array
from armlink.errors import BadInput
from armlink.recording.recording import COLUMNS, Recording, channel_column

ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "turn": 2.0 * math.pi}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TORQUE_UNITS = {"N·m": 1.0, "Nm": 1.0, "mN·m": 1e-3, "mNm": 1e-3}
_ANGLES = ("q", "dq", "q_cmd")
_TORQUES = ("tau", "tau_motor", "tau_cmd")


@dataclass(frozen=True)
class Corrections:
    """Corrections by column (`tau_3`) or by channel for all joints (`tau`); empty: the recording as it is."""

    columns: Mapping[str, str] = field(default_factory=dict)
    """Column of docs/formats.md → the file's own name of the column that holds it."""
    header: tuple[str, ...] = ()
    """Names of the columns of a table that has no header row; empty: it has one."""
    order: Mapping[str, str] = field(default_factory=dict)
    """Column of docs/formats.md → the one of these whose values it takes."""
    sign: Mapping[str, float] = field(default_factory=dict)
    """1 or −1."""
    units: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Factor into SI of each joint, or one for all."""
    zero: Mapping[str, float] = field(default_factory=dict)
    """Angle to add to a position [rad]."""
    clock: Mapping[str, float] = field(default_factory=dict)
    """Time to add to the stamps of a channel [s]."""
    effort: str = ""
    """`motor` or `link`: source of the efforts, if it is stated."""
    without_gravity: bool = False
    """Whether gravity was taken off the efforts before they were recorded; the model's is added again."""
    joints: tuple[str, ...] = ()
    """Names of the joints to take, base to tip."""
    topic: str = ""
    """Topic of a bag that holds the joint states."""

    def states(self, kind: str, column: str) -> bool:
        """Whether the user stated a correction of this kind (`sign`, `units`, …) for a column or its channel."""
        stated: Mapping[str, object] = getattr(self, kind)
        return column in stated or column.rpartition("_")[0] in stated

    def of_reading(self) -> "Corrections":
        """Those that say what of a file is read. The others number the joints from base to tip, in which order a file
        whose joints have names need not have them."""
        return Corrections(columns=self.columns, header=self.header, joints=self.joints, topic=self.topic)

    def apply(self, recording: Recording, source: str) -> Recording:
        """The corrected recording; raises BadInput for a column that it does not have."""
        channels = {COLUMNS[name]: values.copy() for name, values in recording.channels().items()}
        before = {prefix: values.copy() for prefix, values in channels.items()}
        for column, other in self.order.items():
            (channel, to), (source_channel, of) = (_place(before, name, source, "--map") for name in (column, other))
            channels[channel][:, to] = before[source_channel][:, of]
        for column, factor in self.sign.items():
            _scale(channels, column, (factor,), source, "--sign")
        units = {column: factors for column, factors in self.units.items() if column != "t"}
        for column, factors in units.items():
            _scale(channels, column, factors, source, "--units", beside=units)
        for column, angle in self.zero.items():
            channel, joints = _place(channels, column, source, "--zero")
            channels[channel][:, joints] += angle
        for channel, shift in self.clock.items():
            if channel == "t":
                continue  # the times as they stand
            _place(channels, channel, source, "--clock")
            channels[channel] = _shifted(recording.t, channels[channel], shift)
        if self.effort == "motor" and "tau" in channels:
            effort = channels.pop("tau")
            channels.setdefault("tau_motor", effort)
        if self.effort == "link" and "tau_motor" in channels and "tau" not in channels:
            channels["tau"] = channels.pop("tau_motor")
        t = recording.t * self.units["t"][0] if "t" in self.units else recording.t
        return replace(recording, t=t, **{name: channels.get(prefix) for name, prefix in COLUMNS.items()})  # type: ignore[arg-type]


AS_IT_IS = Corrections()
WITHOUT_GRAVITY = "without-gravity"
"""Efforts from which the controller's model of gravity was subtracted, as some drivers publish them."""


def parse_corrections(
    columns: Sequence[str] | None = None,
    header: str = "",
    sign: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    zero: Sequence[str] | None = None,
    clock: Sequence[str] | None = None,
    effort_is: str = "",
    joints: str = "",
    topic: str = "",
) -> Corrections:
    """Read the options of a command, each `COLUMN=VALUE`, several separated by commas.

    `units` takes `q=deg`, `tau_motor=mN·m`, `tau_motor=A:K` or `tau_motor=A:K1;K2;…` (torque constants at the joint
    [N·m/A]), `q=counts:N` (counts a turn) and `q=percent:D` (100 is an angle of D degrees, as LeRobot's normalised
    ranges have it); a unit of one joint goes before that of its channel. Raises BadInput for anything else.
    """
    stated = effort_is.split(",") if effort_is else []
    source = [each for each in stated if each != WITHOUT_GRAVITY]
    if source not in ([], ["motor"], ["link"]) or len(stated) > len(source) + 1:
        raise BadInput(f"--effort-is {effort_is}: expected motor, link, {WITHOUT_GRAVITY}, or motor,{WITHOUT_GRAVITY}")
    mapped = _pairs("--map", columns)
    return Corrections(
        columns={column: other for column, other in mapped if channel_column(other) is None},
        header=_header(header),
        order={column: other for column, other in mapped if channel_column(other) is not None},
        sign={column: _sign(column, text) for column, text in _pairs("--sign", sign)},
        units={column: _factors(column, text) for column, text in _pairs("--units", units)},
        zero={column: _number("--zero", column, text) for column, text in _pairs("--zero", zero)},
        clock={column: _number("--clock", column, text) for column, text in _pairs("--clock", clock)},
        effort="".join(source),
        without_gravity=WITHOUT_GRAVITY in stated,
        joints=tuple(name.strip() for name in joints.split(",") if name.strip()),
        topic=topic,
    )


def _header(text: str) -> tuple[str, ...]:
    """Names of columns, separated by commas; those to leave out (`-`) have none."""
    names = [name.strip() for name in text.split(",")] if text else []
    for name in names:
        if name not in ("t", "-") and channel_column(name) is None:
            raise BadInput(
                f"--columns {name}: a recording has no such column: give t, q_1, q_cmd_1, tau_1, …, or - for "
                "a column to leave out"
            )
        if name != "-" and names.count(name) > 1:
            raise BadInput(f"--columns {name}: this column is named twice")
    return tuple("" if name == "-" else name for name in names)


def _pairs(option: str, texts: Sequence[str] | None) -> list[tuple[str, str]]:
    """`COLUMN=VALUE` pairs of an option that may be repeated and may hold several, separated by commas."""
    found = []
    for text in (part for whole in texts or () for part in whole.split(",")):
        column, equals, value = text.strip().partition("=")
        if not equals or not column.strip() or not value.strip():
            raise BadInput(f"{option} {text.strip()}: expected COLUMN=VALUE")
        found.append((column.strip(), value.strip()))
    return found


def _sign(column: str, text: str) -> float:
    value = _number("--sign", column, text)
    if value not in (1.0, -1.0):
        raise BadInput(f"--sign {column}={text}: expected 1 or -1")
    return value


def _number(option: str, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{option} {column}={text}: expected a number")
    return value


def _factors(column: str, text: str) -> tuple[float, ...]:
    unit, _, values = text.partition(":")
    angle = _channel(column) in _ANGLES
    if values and (unit == "A" or (unit in ("counts", "percent") and angle)):
        numbers = tuple(_number("--units", column, value) for value in values.split(";"))
        if any(number == 0.0 for number in numbers):
            raise BadInput(f"--units {column}={text}: expected numbers other than 0")
        if unit == "percent":
            return tuple(math.radians(number) / 100.0 for number in numbers)
        return tuple(2.0 * math.pi / number for number in numbers) if unit == "counts" else numbers
    if column == "t":
        if unit not in TIME_UNITS or values:
            raise BadInput(f"--units t={text}: expected {', '.join(TIME_UNITS)}")
        return (TIME_UNITS[unit],)
    known = ANGLE_UNITS if angle else TORQUE_UNITS if _channel(column) in _TORQUES else {}
    if unit not in known or values:
        others = "counts:N or percent:DEGREES" if known is ANGLE_UNITS else "A:N·m-per-A"
        raise BadInput(
            f"--units {column}={text}: expected {', '.join(known) or 'a position or torque column'}, {others}"
        )
    return (known[unit],)


def _channel(column: str) -> str:
    place = channel_column(column)
    return place[0] if place else column


def _place(channels: Mapping[str, Array], column: str, source: str, option: str) -> tuple[str, Sequence[int] | slice]:
    """Channel prefix and joint indices that a column or channel name stands for."""
    if column in channels:
        return column, slice(None)
    place = channel_column(column)
    if place is None or place[0] not in channels or not 1 <= place[1] <= channels[place[0]].shape[1]:
        raise BadInput(f"{option} {column}: {source} has no such column: it has {', '.join(channels)} of each joint")
    return place[0], [place[1] - 1]


def _scale(
    channels: dict[str, Array],
    column: str,
    factors: Sequence[float],
    source: str,
    option: str,
    beside: Collection[str] = (),
) -> None:
    """Multiply a column, or the columns of a channel that are not among those `beside` it."""
    channel, joints = _place(channels, column, source, option)
    width = channels[channel][:, joints].shape[1]
    if len(factors) not in (1, width):
        raise BadInput(f"{option} {column}: {len(factors)} values are given, but {source} has {width} joints")
    values = np.broadcast_to(np.asarray(factors), width)
    if column == channel:
        values = np.where([f"{channel}_{j + 1}" in beside for j in range(width)], 1.0, values)
    channels[channel][:, joints] *= values


def _shifted(t: Array, values: Array, shift: float) -> Array:
    """Values whose stamps are `shift` later, at the times t; NaN beyond their ends."""
    out = np.full_like(values, np.nan)
    for j in range(values.shape[1]):
        there = np.isfinite(values[:, j])
        if there.sum() > 1:
            out[:, j] = np.interp(t - shift, t[there], values[there, j], left=np.nan, right=np.nan)
    return out
