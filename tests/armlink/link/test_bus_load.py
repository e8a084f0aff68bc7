"""A bus that cannot carry the cycle is named, and no drive is blamed for it alone."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from fake_joints import FakeBus, make_arm

from armlink.errors import BusFault, HostLate
from armlink.link.bus_load import bus_loads, overload
from armlink.link.link import Link
from armlink.link.types import Command


def at(rate: int, bitrate: int) -> dict[str, object]:
    return {"rate": rate, "bus": {"interface": "socketcan", "channel": "can0", "bitrate": bitrate}}


def test_the_load_is_every_frame_with_all_its_stuff_bits() -> None:
    """CAN 2.0A: 47 bits and 8 a byte, and a stuff bit for every four of 34 and 8 a byte. TPDO2 comes every 4th SYNC."""
    (load,) = bus_loads(make_arm(3, link=at(1000, 1_000_000)))
    most = [47 + 8 * size + (34 + 8 * size - 1) // 4 for size in (8, 8, 8, 0)]
    assert load.share == pytest.approx(1e-3 * (3 * (most[0] + most[1] + most[2] / 4) + most[3]))
    assert load.what == "3 joints at 1000 Hz load the bus by up to 97% of 1000000 bit/s"
    assert load.remedy == "lower link.rate to 827 Hz, or spread the joints over link.buses"


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (None, "193% of 125000 bit/s: lower link.rate to 103 Hz, or spread the joints over link.buses"),
        ("socketcan:can1@250000", ""),
        ("slcan:/dev/ttyACM0", "193% of 125000 bit/s"),
        ("socketcan:vcan0", ""),
        ("udp_multicast:239.0.0.1", ""),
        ("armlink_sim:arm", ""),
    ],
)
def test_the_bus_that_is_opened_counts_not_the_arm_files(spec: str | None, expected: str) -> None:
    said = overload(make_arm(3, link=at(250, 125_000)), spec)
    assert expected in said
    assert bool(said) == bool(expected)


def test_each_bus_carries_its_own_joints() -> None:
    """Two joints on the arm's bus, and one on a slow one for the hand."""
    arm = make_arm(3, link=at(500, 1_000_000))
    section = arm.require_link()
    joints = (*section.joints[:2], section.joints[2].model_copy(update={"bus": "hand"}))
    hand = section.bus.model_copy(update={"channel": "can1", "bitrate": 125_000})
    split = section.model_copy(update={"joints": joints, "buses": {"hand": hand}})
    loads = list(bus_loads(arm.model_copy(update={"link": split})))
    assert [load.what.partition(" at")[0] for load in loads] == ["2 joints", "1 joint"]
    assert [load.what.rpartition(" of ")[2] for load in loads] == ["1000000 bit/s", "125000 bit/s"]


@pytest.fixture
def overloaded() -> Iterator[tuple[Link, FakeBus]]:
    """In real time, as far as the link can tell."""
    bus = FakeBus(range(1, 4))
    names = ("channel_info", "open_port", "open_listening_port", "shutdown")
    timed = SimpleNamespace(clock=None, **{name: getattr(bus, name) for name in names})
    arm = make_arm(3, link=at(250, 125_000))
    with Link(arm, timed, bus.clock, overload(arm)) as link:
        yield link, bus


def test_a_drive_that_does_not_follow_on_a_full_bus_is_not_blamed_alone(
    overloaded: tuple[Link, FakeBus], caplog: pytest.LogCaptureFixture
) -> None:
    link, bus = overloaded
    link.start()
    assert "test: 3 joints at 250 Hz load the bus by up to 193% of 125000 bit/s: lower" in caplog.text
    bus.nodes[2].modes = ()
    with pytest.raises(BusFault, match=r"joint_2: .*; 3 joints at 250 Hz load the bus by up to 193% of 125000 bit/s"):
        link.enable()


def cycles(link: Link, command: Command, count: int) -> None:
    for _ in range(count):
        link.cycle(command)


def test_a_fault_in_a_cycle_says_so_too_but_lateness_of_the_host_is_its_own(
    overloaded: tuple[Link, FakeBus],
) -> None:
    link, bus = overloaded
    link.start()
    link.enable()
    hold = Command.hold(np.zeros(3))
    link.cycle(hold)
    bus.nodes[1].silent = True
    with pytest.raises(BusFault, match=r"joint_1: no reading for .*lower link\.rate") as caught:
        cycles(link, hold, 100)
    assert not isinstance(caught.value, HostLate)
    bus.nodes[1].silent = False
    link.enable()
    link.cycle(hold)
    bus.clock.time += 0.4
    with pytest.raises(HostLate) as late:
        link.cycle(hold)
    assert "load" not in str(late.value)
