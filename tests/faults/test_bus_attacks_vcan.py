"""Attacks on real SocketCAN (`bus_attacks`): the joints hold at the end, and the right cause is named."""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_attacks import BARE, GUARDED, Scene, link, scene

pytestmark = [pytest.mark.vcan, pytest.mark.long]  # quick: `test_vcan.py`

OWN_WATCHES = "the stop commands could not be sent: the joints stop when their drives miss the host"
CLOSED = {
    "killed": "",
    "command on the wire": "20Bh came on the wire and is not from this guard: another host commands the drives there",
    "suspended": "s old are dropped",
    "a second guard": "came on the wire and is not from this guard: another host|which only a drive may send|"
    "which the policy does not name",
    "wire down and up": rf"an interface failed \(Network is down\); {OWN_WATCHES}|the wire takes no frames",
    "killed and started again at once": "",
    "its terminal is closed": "the guard was ended by a signal; the joints were commanded to stop",
    "flood of SYNCs by a program": "80h: is sent more often than 100 times a second",
    "SYNC as CAN FD by a program": "the program sent 80h as CAN FD, but by the policy (`fd`) this bus carries only "
    "classical CAN",
}
"""Attack → what the guard says of it; empty where a killed one says nothing."""
SAID = {
    "flood: readings of a drive": "joint_1: two readings come in every cycle, so a second node has the same id",
    "flood: bus-off": "bus-off: check wiring, termination and bit rate",
    "interface down and up": "Network is down",
    "flood: extended": "",
    "flood while the host does not read": "the host was .* ms late|frames were lost because this host reads too slowly",
}
"""Attack → what the host says of it; empty where it may go on."""
LATE = r"the host was \d+ ms late"
"""What a machine that is busy beside says of any flood, and rightly."""
NOT_ITS_OWN = re.compile("encoder|cable|too weak|stuck")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    if not Path("/sys/class/net/vcan1").exists():  # before the mark's own skip, since this fixture is the module's
        pytest.skip("needs SocketCAN interfaces vcan0 and vcan1, which scripts/with-vcan makes")
    with scene(tmp_path_factory.mktemp("attacks")) as built:
        yield built


def need_ip(name: str) -> None:
    if "down" in name and (shutil.which("ip") is None or os.geteuid() != 0):
        pytest.skip("only root may set an interface down, with ip of iproute2")


@pytest.mark.parametrize("name", CLOSED)
def test_an_attack_on_the_guard_leaves_the_joints_holding(name: str, place: Scene) -> None:
    need_ip(name)
    found = place.attack(GUARDED[name], guarded=True)
    assert not found.wrong, found
    assert found.host, "the host goes on without its arm"
    assert not NOT_ITS_OWN.search(found.host)
    assert re.search(CLOSED[name], found.guard) or re.search(LATE, found.host), found


@pytest.mark.parametrize("name", SAID)
def test_an_attack_on_the_bus_leaves_the_joints_holding(name: str, place: Scene) -> None:
    need_ip(name)
    found = place.attack(BARE[name], guarded=False)
    assert not found.wrong, found
    assert not NOT_ITS_OWN.search(found.host)
    assert found.host or not SAID[name]
    assert re.search(f"{SAID[name]}|{LATE}", found.host), found.host


def test_an_interface_that_is_removed_during_work_is_one_line(place: Scene) -> None:
    """Last, since it takes vcan1 away, and makes it again."""
    need_ip("down")
    remove = link("vcan1", "delete", "add mtu 72 type vcan", "up")
    found = place.attack(remove, guarded=True)
    assert not found.wrong, found
    assert re.search("No such device|Network is down", found.host), found.host
    assert "guard: closed, so it passes no more frames: an interface failed (" in found.guard
    assert "the joints were commanded to stop" in found.guard
