"""Length of CAN frames on the wire [bits], with stuff bits computed from their content (ISO 11898-1).

A classical data frame with an 11-bit identifier and n data bytes has 34 + 8n bits from start of frame to the end of the
checksum, in which a bit of the other value is stuffed behind five equal ones, and 13 behind them without stuffing:
checksum delimiter, acknowledge slot and delimiter, end of frame (7), intermission (3).
"""

from functools import lru_cache

FIXED_BITS = 47
"""Bits of a frame without data and stuff bits, intermission included; each data byte adds 8."""
_STUFFED = 34
_CRC15 = 0x4599
_IDLE = 5  # the idle bus is recessive, so start of frame begins a new run


def frame_bits(can_id: int, data: bytes) -> int:
    """Bits that a classical data frame with an 11-bit identifier takes on the wire, stuff bits included."""
    state, crc, stuffed = _head(can_id, len(data))
    for byte in data:
        crc = (crc << 8 ^ _CRC_OF_BYTE[crc >> 7 ^ byte]) & 0x7FFF
        state, more = _STUFF_8[state][byte]
        stuffed += more
    state, more = _STUFF_8[state][crc >> 7]
    return FIXED_BITS + 8 * len(data) + stuffed + more + _STUFF_7[state][crc & 0x7F][1]


def longest_frame_bits(length: int) -> int:
    """Upper bound of the bits of a frame with `length` data bytes: one stuff bit per four bits of the stuffed part."""
    return FIXED_BITS + 8 * length + (_STUFFED + 8 * length - 1) // 4


@lru_cache(maxsize=4096)
def _head(can_id: int, length: int) -> tuple[int, int, int]:
    """Stuffing state, checksum and stuff bits after start of frame, identifier, three dominant bits and length."""
    bits = can_id << 7 | length
    crc = 0
    for at in reversed(range(19)):
        crc = _crc_step(crc, bits >> at & 1)
    state, stuffed = _stuff(_IDLE, bits, 19)
    return state, crc, stuffed


def _crc_step(crc: int, bit: int) -> int:
    return (crc << 1 & 0x7FFF) ^ (_CRC15 if (crc >> 14 ^ bit) & 1 else 0)


def _crc_of_byte(byte: int) -> int:
    crc = 0
    for at in reversed(range(8)):
        crc = _crc_step(crc, byte >> at & 1)
    return crc


def _stuff(state: int, bits: int, count: int) -> tuple[int, int]:
    """State after `count` bits and the number of stuff bits; a state is 5 × last value + run of equal bits − 1."""
    stuffed = 0
    for at in reversed(range(count)):
        bit = bits >> at & 1
        value, run = divmod(state, 5)
        run = run + 1 if bit == value else 0
        if run == 4:
            state, stuffed = (1 - bit) * 5, stuffed + 1
        else:
            state = bit * 5 + run
    return state, stuffed


_CRC_OF_BYTE = [_crc_of_byte(byte) for byte in range(256)]
_STUFF_8 = [[_stuff(state, byte, 8) for byte in range(256)] for state in range(10)]
_STUFF_7 = [[_stuff(state, bits, 7) for bits in range(128)] for state in range(10)]
