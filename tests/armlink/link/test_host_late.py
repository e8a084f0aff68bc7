"""A host that stands still at any line of a cycle is called late; the joints' own stops are put down to it."""

import numpy as np
import pytest
from fake_joints import FakeClock

from armlink.arm_file import load_arm
from armlink.bus.port import Frame
from armlink.drives.orders import Power
from armlink.errors import HostLate
from armlink.link.cycle import Commander
from armlink.link.types import Command
from armlink.selftest.host import STOPPED, EchoPort, echo_commander

N, DEADLINE = 7, 0.1
PLACES = ("before the cycle", "before SYNC", "after SYNC", "waiting for readings")
FIRST_STOPPED = (STOPPED, b"")


class StandingStill(EchoPort):
    """Between two lines the process stands still, once, and the joints stop by themselves meanwhile."""

    def __init__(self, clock: FakeClock) -> None:
        super().__init__(load_arm("sarcos"))
        self.clock, self.still, self.place = clock, 0.0, ""

    def stand_still(self, place: str) -> None:
        if place == self.place and self.still:
            self.clock.time += self.still
            if self.still > DEADLINE / 2:
                self._waiting.append(FIRST_STOPPED)
            self.still = 0.0

    def send(self, can_id: int, data: bytes) -> None:
        self.stand_still("before SYNC")
        super().send(can_id, data)
        if can_id == len(self.standing):  # the last joint's
            self.stand_still("after SYNC")

    def receive(self, timeout: float) -> Frame | None:
        if self._waiting:
            self.stand_still("waiting for readings")
        return super().receive(timeout)


def standing() -> tuple[StandingStill, Commander]:
    """A port, and what commands its joints, which have answered for three cycles without power."""
    clock = FakeClock()
    port = StandingStill(clock)
    commander = echo_commander(load_arm("sarcos"), port, clock)
    commander.max_age = DEADLINE
    for _ in range(3):
        commander.stand([Power.OFF] * N)
    return port, commander


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("still", [0.06, 0.18, 2.0])
def test_it_is_the_host_wherever_it_stands_still(place: str, still: float) -> None:
    port, commander = standing()
    hold = Command.hold(port.standing)
    for _ in range(50):
        commander.command(hold)
    port.place, port.still = place, still

    def go_on() -> None:
        for _ in range(10):
            port.stand_still("before the cycle")
            commander.command(hold)

    with pytest.raises(HostLate, match=r"joint_1 .*stopped itself") as late:
        go_on()
    assert late.value.late == pytest.approx(still, abs=0.005)


@pytest.mark.parametrize("place", PLACES)
def test_a_short_stop_is_bridged(place: str) -> None:
    port, commander = standing()
    hold = Command.hold(port.standing)
    for k in range(50):
        port.place, port.still = place, 0.04 if k == 20 else port.still
        port.stand_still("before the cycle")
        sample = commander.command(hold)
    assert np.isfinite(sample.position).all()
    assert not port.still
