"""PDOs of nodes: what came is taken once, and of its own node alone."""

import numpy as np

from sim_bus.node.pdo import MappedPdo

TARGET_POSITION = 0x607A0020
KEY = (0x607A, 0)


def test_only_what_was_received_is_taken():
    signal = np.zeros(3, np.int32)
    pdos = [MappedPdo(node, 1, 0x301 + node, 1, (TARGET_POSITION,), {KEY: signal}) for node in range(3)]
    pdos[1].content = (7).to_bytes(4, "little")
    signal[2] = 5  # written otherwise
    assert [pdo.take() for pdo in pdos] == [False, True, False]
    assert list(signal) == [0, 7, 5]
    assert not any(pdo.take() for pdo in pdos)
    for node, pdo in enumerate(pdos):
        pdo.content = node.to_bytes(4, "little")
    assert all(pdo.take() for pdo in pdos)
    assert list(signal) == [0, 1, 2]
