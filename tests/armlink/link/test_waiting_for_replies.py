"""The loop sleeps until the replies should be there, instead of waking for each, and takes those that come later."""

from collections.abc import Sequence

import numpy as np

from armlink.arm_file import load_arm
from armlink.bus.port import Frame
from armlink.drives.orders import Power
from armlink.link.types import Command
from armlink.selftest.host import EchoPort, echo_commander

N = 7
BETWEEN = 1.3e-4
"""Time of one reply on the wire [s]."""


class WaitedFor:
    """Time that also counts how often it was waited for."""

    def __init__(self) -> None:
        self.time, self.waits = 10.0, 0

    def now(self) -> float:
        return self.time

    def sleep_until(self, instant: float) -> None:
        self.waits += 1
        self.time = max(self.time, instant)


class OneByOne(EchoPort):
    """Replies take their time on the wire, one after the other."""

    def __init__(self, clock: WaitedFor, first: float) -> None:
        super().__init__(load_arm("sarcos"))
        self.clock, self.first, self.left = clock, first, 0.0

    def send_all(self, frames: Sequence[Frame]) -> None:
        self.left = self.clock.time + self.first
        super().send_all(frames)

    def receive(self, timeout: float) -> Frame | None:
        comes = self.left + BETWEEN if self._waiting else float("inf")
        if comes > self.clock.time + timeout:
            self.clock.time += timeout
            return None
        if comes > self.clock.time:
            self.clock.waits += 1
            self.clock.time = comes
        self.left = comes
        return super().receive(0.0)


class Held:
    """An arm that holds where it stands."""

    def __init__(self) -> None:
        self.clock = WaitedFor()
        self.port = OneByOne(self.clock, 3e-4)
        self.commander = echo_commander(load_arm("sarcos"), self.port, self.clock)
        for _ in range(3):
            self.commander.stand([Power.OFF] * N)

    def delays(self, count: int) -> list[float]:
        """Of so many cycles, from SYNC to the last reply or the end of waiting [s]."""
        hold = Command.hold(self.port.standing)
        return [self.commander.command(hold).delay for _ in range(count)]


def test_a_cycle_wakes_twice_and_misses_nothing() -> None:
    held = Held()
    clock, port, stats = held.clock, held.port, held.commander.loop.stats
    held.delays(300)
    clock.waits, missed = 0, stats.missed
    taken = 3e-4 + N * BETWEEN
    delays = held.delays(500)
    assert clock.waits < 2.2 * 500
    assert taken - 1e-9 <= min(delays)
    assert max(delays) < 1.05 * taken
    port.first = 9e-4  # from now on the drives take 0.6 ms longer
    delays = held.delays(300)
    assert min(delays) >= taken + 6e-4 - 1e-9
    assert stats.missed == missed
    clock.waits = 0
    held.delays(500)
    assert clock.waits < 2.2 * 500


def test_replies_that_never_come_cost_no_more_than_their_share_of_the_period() -> None:
    held = Held()
    period = held.commander.period
    held.commander.max_age = 10.0
    held.delays(3)
    held.port.first = 0.1
    begun = held.clock.time
    delays = held.delays(200)
    assert max(delays) <= 0.8 * period + 1e-9
    assert abs(held.clock.time - begun - 200 * period) < 2 * period


def test_replies_that_come_after_every_cycle_are_no_silence() -> None:
    """Each comes after its cycle, some in the next one: as old as their SYNC, and no joint is silent."""
    held = Held()
    commander, period = held.commander, held.commander.period
    held.delays(50)
    commander.max_age = 5 * period
    held.port.first = 0.81 * period
    hold = Command.hold(held.port.standing)
    ages = np.array([commander.command(hold).age for _ in range(100)])[10:]
    assert (ages > 0.99 * period).all()
    assert (ages < 2.5 * period).all()
