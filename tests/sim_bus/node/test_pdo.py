"""PDOs of several nodes in one packed array: what came, and from which nodes."""

import numpy as np

from sim_bus.node.pdo import PdoGroup, PdoParameters

TARGET_POSITION = 0x607A0020
KEY = (0x607A, 0)


def group(*nodes: int) -> tuple[PdoGroup, np.ndarray]:
    signal = np.zeros(3, np.int32)
    members = [PdoParameters(node, 1, 0x301 + node, 1, (TARGET_POSITION,)) for node in nodes]
    return PdoGroup(members, {KEY: signal}), signal


def receive(found: PdoGroup, member: int, value: int) -> None:
    found.buffer[4 * member : 4 * member + 4] = value.to_bytes(4, "little")
    found.fresh[member] = 1


def test_only_what_was_received_is_taken():
    found, signal = group(0, 1, 2)
    receive(found, 1, 7)
    signal[2] = 5  # written otherwise
    assert list(found.take()) == [1]
    assert list(signal) == [0, 7, 5]
    assert found.take() is None
    for member in range(3):
        receive(found, member, member)
    assert list(found.take()) == [0, 1, 2]
    assert list(signal) == [0, 1, 2]


def test_a_group_of_some_of_the_nodes_leaves_the_others():
    found, signal = group(0, 2)
    receive(found, 0, 3)
    receive(found, 1, 4)
    assert list(found.take()) == [0, 2]
    assert list(signal) == [3, 0, 4]
