"""SDO with a node that is slow: a request is repeated, and both responses come, one of them to the next request."""

import struct
from collections import deque
from collections.abc import Callable

import pytest

from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.eds_file import bundled
from armlink.drives.canopen.sdo import NodeServices, PumpedNetwork
from armlink.errors import BusFault


class SlowNode:
    """Answers each request once `behind` requests more have come, with what the object held."""

    def __init__(self, behind: int) -> None:
        self.behind = behind
        self.waiting: deque[bytes] = deque()
        self.values: dict[bytes, bytes] = {}
        self.network = PumpedNetwork(self.take)

    def take(self, can_id: int, data: bytes) -> None:
        place = data[1:4]
        if data[0] >> 5 == 1:
            self.values[place] = data[4:8]
            self.waiting.append(b"\x60" + place + bytes(4))
        elif data[0] >> 5 == 2:
            self.waiting.append(b"\x43" + place + self.values.get(place, bytes(4)))

    def pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """What is due comes in; nothing else passes the time."""
        while len(self.waiting) > self.behind and not done():
            self.network.notify(0x581, bytearray(self.waiting.popleft()), 0.0)
        return done()


@pytest.mark.parametrize("behind", [0, 1, 2])
def test_late_responses_are_not_taken_for_those_of_the_next_request(behind: int) -> None:
    node = SlowNode(behind)
    services = NodeServices(node.network, "joint_1", 1, bundled(), node.pump)
    for number in range(5):
        gain, record = 0.9 + 0.01 * number, 100 + number
        services.write_checked(objects.STAGED_GAIN, gain)
        services.write_checked(objects.RECORD_ID, record)
        assert services.read(objects.STAGED_GAIN) == struct.unpack("<f", struct.pack("<f", gain))[0]


@pytest.mark.parametrize("held", [0.9000001, 0.0])
def test_a_value_that_the_device_does_not_hold_bit_for_bit_is_a_fault(held: float) -> None:
    node = SlowNode(0)
    services = NodeServices(node.network, "joint_1", 1, bundled(), node.pump)
    services.write_checked(objects.STAGED_GAIN, 0.9)
    for place in node.values:
        node.values[place] = struct.pack("<f", held)
    with pytest.raises(BusFault, match=r"0\.9 was written, but the device holds 0"):
        services.expect(objects.STAGED_GAIN, 0.9)
