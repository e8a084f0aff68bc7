"""Requests and answers on the serial line of Feetech and Dynamixel servos, decoded from their bytes. Pure.

Feetech servos (protocol 0 of their SDK) speak as Dynamixel protocol 1.0 does, with SYNC READ in addition; Dynamixel X
servos speak protocol 2.0. Which of them a packet is of, its header says.
"""

import math
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

READ, WRITE, SYNC_READ, SYNC_WRITE, BULK_READ, STATUS = 0x02, 0x03, 0x82, 0x83, 0x92, 0x55
HEADER_1, HEADER_2 = b"\xff\xff", b"\xff\xff\xfd\x00"
STUFFED, UNSTUFFED = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
"""A byte is put in where parameters would look like a header (protocol 2.0)."""
CRC_POLYNOMIAL = 0x8005
TURN_TICKS = 4096
"""Ticks of a turn, of every servo here."""
TICK = 2 * math.pi / TURN_TICKS
"""[rad]."""
RPM = 2 * math.pi / 60


class ServoPacket(NamedTuple):
    id: int
    instruction: int
    """Of an answer of protocol 1.0 its error."""
    parameters: bytes


class RegisterAccess(NamedTuple):
    """Registers of one servo as they were read, or were written."""

    id: int
    address: int
    data: bytes


class ServoRegister(NamedTuple):
    address: int
    size: int
    unit: float
    """SI units a count."""
    centre: int = 0
    """Count of zero."""
    sign_bit: int | None = None
    """Bit that is the sign; None: two's complement."""

    def value(self, access: RegisterAccess) -> float:
        """Its value in an access; NaN where that does not reach it."""
        start = self.address - access.address
        if start < 0 or start + self.size > len(access.data):
            return math.nan
        raw = access.data[start : start + self.size]
        if self.sign_bit is None:
            return (int.from_bytes(raw, "little", signed=True) - self.centre) * self.unit
        count, sign = int.from_bytes(raw, "little"), 1 << self.sign_bit
        return ((-(count & ~sign) if count & sign else count) - self.centre) * self.unit


class ServoModel(NamedTuple):
    """Where a servo has its values; positions at 2048 ticks, the middle of the turn, are 0 rad."""

    position: ServoRegister
    velocity: ServoRegister
    target: ServoRegister
    current: ServoRegister | None
    """[A]; None: it tells no current."""
    torque_constant: float = math.nan
    """Stall torque by stall current [N·m/A], where it tells its current."""


def _feetech(torque_constant: float) -> ServoModel:
    """STS and SMS series (Feetech, memory table of the STS3215)."""
    return ServoModel(
        position=ServoRegister(56, 2, TICK, 2048, sign_bit=15),
        velocity=ServoRegister(58, 2, TICK, sign_bit=15),
        target=ServoRegister(42, 2, TICK, 2048, sign_bit=15),
        current=ServoRegister(69, 2, 6.5e-3, sign_bit=15),
        torque_constant=torque_constant,
    )


def _dynamixel(current_unit: float | None, torque_constant: float = math.nan) -> ServoModel:
    """X series (ROBOTIS e-Manual, control table)."""
    return ServoModel(
        position=ServoRegister(132, 4, TICK, 2048),
        velocity=ServoRegister(128, 4, 0.229 * RPM),
        target=ServoRegister(116, 4, TICK, 2048),
        current=None if current_unit is None else ServoRegister(126, 2, current_unit),
        torque_constant=torque_constant,
    )


MODELS = {
    "sts3215": _feetech(2.94 / 2.7),  # 30 kg·cm at 2.7 A (data sheet, 12 V)
    "sts3250": _feetech(4.9 / 2.9),  # 50 kg·cm at 2.9 A (data sheet, 12 V)
    "xl330-m077": _dynamixel(1e-3, 0.228 / 1.47),  # ROBOTIS e-Manual, 5 V
    "xl330-m288": _dynamixel(1e-3, 0.52 / 1.47),
    "xl430-w250": _dynamixel(None),  # tells its load in per mille of the voltage
    "xm430-w350": _dynamixel(2.69e-3, 4.1 / 2.3),
    "xm540-w270": _dynamixel(2.69e-3, 10.6 / 4.4),
}
WIDER_READS = {(56, 2): (56, 15), (132, 4): (126, 10)}
"""(address, size) of the present position → of the block from it to the present current, which one request can read."""


def _crc(content: bytes) -> int:
    """CRC-16 of protocol 2.0."""
    crc = 0
    for byte in content:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ CRC_POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def packets(line: bytes) -> Iterator[ServoPacket]:
    """Whole packets in the bytes of a line, in order; what is no packet, or has a wrong checksum, is passed over."""
    start = line.find(HEADER_1)
    while start >= 0:
        found = _packet_2(line, start) if line.startswith(HEADER_2, start) else _packet_1(line, start)
        if found is not None:
            packet, end = found
            yield packet
            start = line.find(HEADER_1, end)
        else:
            start = line.find(HEADER_1, start + 1)


def _packet_1(line: bytes, start: int) -> tuple[ServoPacket, int] | None:
    if start + 6 > len(line):
        return None
    servo, size = line[start + 2], line[start + 3]
    end = start + 4 + size
    if size < 2 or end > len(line) or servo == 0xFF:
        return None
    if ~sum(line[start + 2 : end - 1]) & 0xFF != line[end - 1]:
        return None
    return ServoPacket(servo, line[start + 4], line[start + 5 : end - 1]), end


def _packet_2(line: bytes, start: int) -> tuple[ServoPacket, int] | None:
    if start + 10 > len(line):
        return None
    (size,) = struct.unpack_from("<H", line, start + 5)
    end = start + 7 + size
    if size < 3 or end > len(line) or _crc(line[start : end - 2]) != int.from_bytes(line[end - 2 : end], "little"):
        return None
    body = line[start + 7 : end - 2].replace(STUFFED, UNSTUFFED)
    return ServoPacket(line[start + 4], body[0], body[1:]), end


def accesses(request: bytes, answer: bytes) -> tuple[list[RegisterAccess], list[RegisterAccess]]:
    """Registers that a request and its answers read, and those that it wrote."""
    read, written = list[RegisterAccess](), list[RegisterAccess]()
    two = request.startswith(HEADER_2)
    for packet in packets(request):
        written += _written(packet, two)
        asked = dict(_asked(packet, two))
        for each in packets(answer):
            wanted = asked.pop(each.id, None)
            if wanted is None or (two and each.instruction != STATUS):
                continue
            data = each.parameters[1:] if two else each.parameters
            if len(data) == wanted[1]:
                read.append(RegisterAccess(each.id, wanted[0], data))
    return read, written


def _numbers(parameters: bytes, two: bool) -> tuple[int, int, bytes]:
    """Address and size that a request begins with, and the rest."""
    width = 2 if two else 1
    address, size = parameters[:width], parameters[width : 2 * width]
    return int.from_bytes(address, "little"), int.from_bytes(size, "little"), parameters[2 * width :]


def _asked(packet: ServoPacket, two: bool) -> Iterator[tuple[int, tuple[int, int]]]:
    """Servo, and address and size that it is asked for."""
    if packet.instruction == READ:
        address, size, _ = _numbers(packet.parameters, two)
        yield packet.id, (address, size)
    elif packet.instruction == SYNC_READ:
        address, size, servos = _numbers(packet.parameters, two)
        yield from ((servo, (address, size)) for servo in servos)
    elif packet.instruction == BULK_READ and two:
        for each in _pieces(packet.parameters, 5):
            address, size, _ = _numbers(each[1:], two)
            yield each[0], (address, size)


def _written(packet: ServoPacket, two: bool) -> Iterator[RegisterAccess]:
    if packet.instruction == WRITE:
        width = 2 if two else 1
        yield RegisterAccess(packet.id, int.from_bytes(packet.parameters[:width], "little"), packet.parameters[width:])
    elif packet.instruction == SYNC_WRITE:
        address, size, rest = _numbers(packet.parameters, two)
        for each in _pieces(rest, size + 1):
            yield RegisterAccess(each[0], address, each[1:])


def _pieces(content: bytes, size: int) -> Sequence[bytes]:
    return [content[start : start + size] for start in range(0, len(content) - size + 1, size)]
