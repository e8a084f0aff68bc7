"""Both ends of a bus."""

import sys
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """The arm's and the host's end of a virtual bus."""
    channel = str(tmp_path)
    with can.Bus(channel, interface="virtual") as arm_end, can.Bus(channel, interface="virtual") as host_end:
        yield arm_end, host_end
