"""Frames of moteus controllers (CAN FD): register subframes of the multiplex protocol, to SI-free floats and back.

Identifier: (source | 80h where a reply is wanted) << 8 | destination; the reply's is servo << 8 | source. The payload
is a list of subframes: 00h, 04h, 08h, 0Ch write int8, int16, int32, float; 10h.. read; 20h.. reply; 30h, 31h error;
50h no operation. The two low bits are the number of registers, or 0 if a varuint says it. Source: moteus
docs/protocol/can.md and registers.md. Positions are revolutions of the output.
"""

import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

WRITE, READ, REPLY = 0x00, 0x10, 0x20
WRITE_ERROR, READ_ERROR, NOP = 0x30, 0x31, 0x50
INT8, INT16, INT32, FLOAT = 0, 1, 2, 3
LAYOUTS = (struct.Struct("<b"), struct.Struct("<h"), struct.Struct("<i"), struct.Struct("<f"))
REPLY_WANTED = 0x80
_NOPS = bytes([NOP])
LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Lengths of a CAN FD frame."""


class MoteusRegister(IntEnum):
    MODE = 0x000
    POSITION = 0x001
    VELOCITY = 0x002
    TORQUE = 0x003
    Q_CURRENT = 0x004
    MOTOR_TEMPERATURE = 0x00A
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_MAX_TORQUE = 0x025
    COMMAND_STOP_POSITION = 0x026
    COMMAND_WATCHDOG = 0x027
    COMMAND_ILIMIT_SCALE = 0x02B
    MODEL = 0x100
    FIRMWARE = 0x101
    SERIAL1 = 0x120
    SERIAL2 = 0x121
    SERIAL3 = 0x122


HOMED_AT_OUTPUT = 2
"""Home state: positions are those of the output."""


class MoteusMode(IntEnum):
    STOPPED = 0
    FAULT = 1
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    BRAKE = 15


SMALL = frozenset((MoteusRegister.MODE, MoteusRegister.HOME_STATE, MoteusRegister.FAULT))
"""Registers with whole numbers below 128."""
SCALES: dict[int, tuple[float, float, float]] = (
    dict.fromkeys((0x001, 0x006, 0x020, 0x026, 0x038, 0x03B, 0x040, 0x041), (0.01, 0.0001, 0.00001))
    | dict.fromkeys((0x002, 0x021, 0x028, 0x039, 0x03C), (0.1, 0.00025, 0.00001))
    | dict.fromkeys((0x003, 0x022, 0x025, 0x03A, 0x03D, 0x042, 0x045), (0.5, 0.01, 0.001))
    | dict.fromkeys((0x004, 0x005, 0x01C, 0x01D), (1.0, 0.1, 0.001))
    | dict.fromkeys((0x007,), (10.0, 0.05, 0.0001))
    | dict.fromkeys((0x00A, 0x00E), (1.0, 0.1, 0.001))
    | dict.fromkeys((0x00D,), (0.5, 0.1, 0.001))
    | dict.fromkeys((0x023, 0x024, 0x02B), (1 / 127, 1 / 32767, 1 / 2147483647))
    | dict.fromkeys((0x027,), (0.01, 0.001, 0.000001))
    | dict.fromkeys((0x029,), (0.05, 0.001, 0.00001))
)
"""One step of a register as int8, int16 and int32; a register that is not here is a whole number."""
NOT_A_NUMBER = (-0x80, -0x8000, -0x80000000)
"""Integers that stand for NaN in a scaled register."""


class Subframe(NamedTuple):
    """One register in a subframe; `value` is NaN where a read has none, and the error code in an error."""

    kind: int
    """WRITE, READ, REPLY, WRITE_ERROR or READ_ERROR."""
    register: int
    value: float
    resolution: int = FLOAT


class FixedPayload:
    """A payload whose registers never change, packed and unpacked in one step: the way of the cycle."""

    def __init__(self, kinds: Sequence[tuple[int, Sequence[int]]]) -> None:
        """(WRITE or REPLY, registers with values) or (READ, registers); values travel as pack() has them."""
        layout, self.heads = "<", []
        self.registers: tuple[int, ...] = ()
        for kind, registers in kinds:
            for run in _runs(Subframe(kind, each, math.nan, _form(each, FLOAT)) for each in sorted(registers)):
                head = _head(run)
                self.heads.append(head)
                layout += f"{len(head)}s"
                if kind != READ:
                    layout += LAYOUTS[run[0].resolution].format[1:] * len(run)
                    self.registers += tuple(each.register for each in run)
        self._struct = struct.Struct(layout)
        self.size = next(length for length in LENGTHS if length >= self._struct.size)
        self._fill = bytes([NOP]) * (self.size - self._struct.size)
        shape = self._struct.unpack(bytes(self._struct.size))
        self._values = [place for place, value in enumerate(shape) if not isinstance(value, bytes)]
        self._places = [place for place, value in enumerate(shape) if isinstance(value, bytes)]

    def pack(self, values: Mapping[int, float]) -> bytes:
        """The payload with these values of `registers`."""
        fields: list[float | bytes] = [0.0] * (len(self._values) + len(self._places))
        for place, head in zip(self._places, self.heads, strict=True):
            fields[place] = head
        for place, register in zip(self._values, self.registers, strict=True):
            fields[place] = values[register]
        return self._struct.pack(*fields) + self._fill

    def unpack(self, data: bytes) -> dict[int, float] | None:
        """Values by register, or None for a payload that is laid out otherwise."""
        if len(data) < self._struct.size:
            return None
        fields = self._struct.unpack_from(data)
        if [fields[place] for place in self._places] != self.heads or data[self._struct.size :].strip(_NOPS):
            return None
        return dict(zip(self.registers, (fields[place] for place in self._values), strict=True))


def identifier(source: int, destination: int, reply_wanted: bool = False) -> int:
    """Identifier of a frame; one above 7FFh goes as 29 bits."""
    return (source | REPLY_WANTED * reply_wanted) << 8 | destination


def pack(writes: Mapping[int, float], reads: Sequence[int], resolution: int = FLOAT) -> bytes:
    """Write registers, then read others; raises ValueError for more than 64 bytes."""
    frames = [Subframe(WRITE, each, writes[each], _form(each, resolution)) for each in sorted(writes)]
    return pack_subframes(frames + [Subframe(READ, each, math.nan, _form(each, resolution)) for each in sorted(reads)])


def pack_subframes(frames: Sequence[Subframe]) -> bytes:
    """Subframes, consecutive registers together, padded with NOP to a length of CAN FD.

    Raises ValueError for more than 64 bytes.
    """
    data = b""
    for run in _runs(frames):
        first = run[0]
        if first.kind in (WRITE_ERROR, READ_ERROR):
            data += bytes([first.kind]) + _varuint(first.register) + _varuint(int(first.value))
            continue
        data += _head(run)
        if first.kind != READ:
            data += b"".join(pack_value(each.register, each.value, each.resolution) for each in run)
    if len(data) > LENGTHS[-1]:
        raise ValueError(f"{len(data)} bytes do not fit a CAN FD frame")
    return data.ljust(next(length for length in LENGTHS if length >= len(data)), _NOPS)


def unpack(data: bytes) -> Iterator[Subframe]:
    """Subframes of a payload; ends at the first byte that makes no sense, and never raises."""
    place = 0
    while place < len(data):
        head, place = data[place], place + 1
        kind, resolution, count = head & 0xF0, head >> 2 & 3, head & 3
        if head == NOP:
            continue
        if head in (WRITE_ERROR, READ_ERROR):
            register, place = _read_varuint(data, place)
            code, place = _read_varuint(data, place)
            if register is None or code is None:
                return
            yield Subframe(head, register, code)
            continue
        if kind not in (WRITE, READ, REPLY):
            return
        if count == 0:
            several, place = _read_varuint(data, place)
            if several is None or several > len(data) * 8:
                return
            count = several
        first, place = _read_varuint(data, place)
        if first is None:
            return
        for register in range(first, first + count):
            if kind == READ:
                yield Subframe(READ, register, math.nan, resolution)
                continue
            if place + LAYOUTS[resolution].size > len(data):
                return
            yield Subframe(kind, register, unpack_value(register, data, place, resolution), resolution)
            place += LAYOUTS[resolution].size


def pack_value(register: int, value: float, resolution: int) -> bytes:
    """Bytes of a register's value; integers saturate, NaN is the least integer of a scaled register."""
    if resolution == FLOAT:
        return LAYOUTS[FLOAT].pack(value)
    least = NOT_A_NUMBER[resolution]
    if not math.isfinite(value):
        return LAYOUTS[resolution].pack(least)
    scale = SCALES[register][resolution] if register in SCALES else 1.0
    return LAYOUTS[resolution].pack(max(least + 1, min(-least - 1, round(value / scale))))


def unpack_value(register: int, data: bytes, place: int, resolution: int) -> float:
    value: float = LAYOUTS[resolution].unpack_from(data, place)[0]
    if resolution == FLOAT or register not in SCALES:
        return value
    return math.nan if value == NOT_A_NUMBER[resolution] else value * SCALES[register][resolution]


def _form(register: int, resolution: int) -> int:
    """Resolution in which a register travels: a whole number as an integer, since a float has 24 bits only."""
    return INT8 if register in SMALL else resolution if register in SCALES else INT32


def _runs(frames: Iterable[Subframe]) -> Iterator[list[Subframe]]:
    """Groups of consecutive registers of one kind and resolution; errors stand alone."""
    run: list[Subframe] = []
    for each in frames:
        if run and (each.kind, each.register, each.resolution) != (
            run[0].kind,
            run[-1].register + 1,
            run[0].resolution,
        ):
            yield run
            run = []
        run.append(each)
        if each.kind in (WRITE_ERROR, READ_ERROR):
            yield run
            run = []
    if run:
        yield run


def _head(run: Sequence[Subframe]) -> bytes:
    count, first = len(run), run[0]
    short = count if count <= 3 else 0
    return (
        bytes([first.kind | first.resolution << 2 | short])
        + (b"" if short else _varuint(count))
        + _varuint(first.register)
    )


def _varuint(value: int) -> bytes:
    data = b""
    while True:
        value, low = value >> 7, value & 0x7F
        data += bytes([low | 0x80 * bool(value)])
        if not value:
            return data


def _read_varuint(data: bytes, place: int) -> tuple[int | None, int]:
    value = 0
    for number in range(5):
        if place >= len(data):
            return None, place
        value |= (data[place] & 0x7F) << 7 * number
        place += 1
        if not data[place - 1] & 0x80:
            return value, place
    return None, place


QUERY = (
    MoteusRegister.MODE, MoteusRegister.POSITION, MoteusRegister.VELOCITY, MoteusRegister.TORQUE,
    MoteusRegister.TEMPERATURE, MoteusRegister.FAULT,
)  # fmt: skip
"""Registers that are asked for in every cycle."""
COMMAND = (
    MoteusRegister.MODE, MoteusRegister.COMMAND_POSITION, MoteusRegister.COMMAND_VELOCITY,
    MoteusRegister.COMMAND_TORQUE, MoteusRegister.COMMAND_KP_SCALE, MoteusRegister.COMMAND_KD_SCALE,
    MoteusRegister.COMMAND_MAX_TORQUE,
    MoteusRegister.COMMAND_STOP_POSITION, MoteusRegister.COMMAND_WATCHDOG, MoteusRegister.COMMAND_ILIMIT_SCALE,
)  # fmt: skip
"""Registers that are written in every cycle."""
CYCLE_COMMAND = FixedPayload([(WRITE, COMMAND), (READ, QUERY)])
CYCLE_REPLY = FixedPayload([(REPLY, QUERY)])
