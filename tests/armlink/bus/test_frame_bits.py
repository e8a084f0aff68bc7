"""Bits of a frame on the wire, against the frame written out bit by bit."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlink.bus.frame_bits import FIXED_BITS, frame_bits, longest_frame_bits


def written_out(can_id, data):
    """The frame as a string of bits: checksum by polynomial division, a stuff bit behind each five equal ones."""
    head = f"0{can_id:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    rest = int(head + "0" * 15, 2)
    for at in range(len(head) + 14, 14, -1):
        if rest >> at & 1:
            rest ^= 0xC599 << (at - 15)
    wire = ""
    for bit in head + f"{rest:015b}":
        wire += bit
        if len(wire) >= 5 and len(set(wire[-5:])) == 1:
            wire += "1" if bit == "0" else "0"
    return wire + "1" + "01" + "1" * 7 + "111"


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_bits_are_those_of_the_frame_written_out(can_id, data):
    bits = frame_bits(can_id, data)
    assert bits == len(written_out(can_id, data))
    assert FIXED_BITS + 8 * len(data) <= bits <= longest_frame_bits(len(data))


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (1, 65), (8, 135)])
def test_the_longest_frames_are_those_of_the_textbook(length, bits):
    """Davis, Burns, Bril, Lukkien 2007, equation 1: 55 + 10 n."""
    assert longest_frame_bits(length) == bits
