"""The loop sleeps until the replies should be there, instead of waking for each, and takes those that come later."""

import struct

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.bus.port import Frame
from armlink.drives.orders import Order, Power
from armlink.link.cyclic_exchange import LATE_CYCLES
from armlink.link.types import Command
from armlink.selftest.host import EchoPort, echo_commander

N = 7
STEP = 1e-3
"""From the position of one reply to that of the next [rad]."""
STILL = [Order(Power.OFF, False, 0, 0.0, 0.0, 0.0, 0.0, 0.0)] * N
BETWEEN = 1.3e-4
"""Time of one reply on the wire [s]."""


class WaitedFor:
    """Time that also counts how often it was waited for."""

    def __init__(self, glance: float = 0.0) -> None:
        """Each look at the clock takes `glance` [s], as computing does."""
        self.time, self.waits, self.glance = 10.0, 0, glance

    def now(self) -> float:
        self.time += self.glance
        return self.time

    def sleep_until(self, instant: float) -> None:
        self.waits += 1
        self.time = max(self.time, instant)


class OneByOne(EchoPort):
    """Replies take their time on the wire, one after the other."""

    def __init__(self, clock: WaitedFor, first: float) -> None:
        super().__init__(load_arm("sarcos"))
        self.clock, self.first, self.left = clock, first, 0.0
        self.sent: list[float] = []
        self.overlooked = 0
        """So many last replies come just after they were looked for."""

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == 1:  # the first joint's
            self.sent.append(self.clock.time)
            self.left = self.clock.time + self.first
        super().send(can_id, data)

    def receive(self, timeout: float) -> Frame | None:
        if self.overlooked and len(self._waiting) == self.overlooked:
            self.overlooked = 0
            return None
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

    def __init__(self, glance: float = 0.0) -> None:
        self.clock = WaitedFor(glance)
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


def test_where_nobody_waits_for_the_sample_a_cycle_wakes_once_and_keeps_its_time() -> None:
    """Replies are taken in before the next frames, by the time that this takes."""
    held = Held(glance=2e-5)
    period, stats = held.commander.period, held.commander.loop.stats
    held.commander.unhurried = True
    held.delays(200)
    held.port.sent.clear()
    missed, late, held.clock.waits = stats.missed, stats.late, 0
    delays = held.delays(500)
    between = np.diff(held.port.sent)
    assert held.clock.waits == 500
    assert (stats.missed, stats.late) == (missed, late)
    assert abs(between.mean() - period) < 1e-6
    assert between.min() > 0.95 * period
    assert between.max() < 1.05 * period
    assert max(delays) < period


def test_in_a_hurry_again_it_waits_for_replies_and_for_its_turn() -> None:
    held = Held(glance=2e-5)
    period = held.commander.period
    held.delays(300)
    for unhurried in (True, False) * 20:
        held.commander.unhurried = unhurried
        held.port.sent.clear()
        (delay,) = held.delays(1)
        assert (delay > 0.9 * period) == unhurried
    held.port.sent.clear()
    held.delays(100)
    assert abs(np.diff(held.port.sent) - period).max() < 1e-4


def test_replies_that_nobody_waited_for_are_missed_where_they_did_not_come() -> None:
    held = Held()
    held.commander.max_age, held.commander.unhurried = 10.0, True
    held.delays(20)
    missed, begun, held.port.first = held.commander.loop.stats.missed, held.clock.time, 0.1
    held.delays(100)
    assert held.commander.loop.stats.missed - missed == 100 * N
    assert abs(held.clock.time - begun - 100 * held.commander.period) < 2 * held.commander.period


def test_a_reply_that_comes_just_after_it_was_looked_for_is_late_once() -> None:
    held = Held()
    stats = held.commander.loop.stats
    held.commander.unhurried = True
    held.delays(300)
    missed, held.port.overlooked = stats.missed, 1
    hold = Command.hold(held.port.standing)
    late, after = held.commander.command(hold), held.commander.command(hold)
    assert stats.missed == missed + 1
    assert late.timely is not None
    assert late.timely.tolist() == [True] * (N - 1) + [False]
    assert after.timely is None or after.timely.all()


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


class Behind(EchoPort):
    """Joints that answer every command in turn, now and then late all together, with frames of others between.

    A joint's position tells to which command it is the reply.
    """

    def __init__(self, clock: WaitedFor, seed: int, stalls: float, longest: float = 0.02) -> None:
        """Share of commands at which they stall, and for how long at most [s]."""
        super().__init__(load_arm("sarcos"))
        self.clock, self.random = clock, np.random.default_rng(seed)
        self.stalls, self.longest = stalls, longest
        self.free = 0.0
        self.taken: list[float] = []
        """When the reply to each command was made, by the number of the command."""
        self.lost: set[int] = set()
        self.coming: list[tuple[float, Frame]] = []

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == 1:  # to the first joint: another command
            stalls = self.random.random() < self.stalls
            self.free = max(self.free, self.clock.time + self.random.uniform(1e-4, self.longest if stalls else 1e-3))
            self.taken.append(self.clock.time)  # and they leave late: the oldest that they may be
            self.coming.append((self.free + self.random.uniform(0.0, 3e-3), (0x7F0, b"")))
        number = len(self.taken) - 1
        if number not in self.lost:
            self.free += 2e-5
            self.coming.append((self.free, (can_id - 1 + 0x100, struct.pack("<ff", number * STEP, 0.0))))
        self.coming.sort(key=lambda each: each[0])

    def receive(self, timeout: float) -> Frame | None:
        if not self.coming or self.coming[0][0] > self.clock.time + timeout:
            self.clock.time += timeout
            return None
        comes, frame = self.coming.pop(0)
        self.clock.time = max(self.clock.time, comes)
        return frame


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(("stalls", "longest"), [(0.03, 0.02), (0.01, 0.5)])
def test_a_reading_was_taken_between_its_own_command_and_its_coming_however_late_it_is(
    seed: int, stalls: float, longest: float
) -> None:
    clock = WaitedFor(1e-5)
    port = Behind(clock, seed, stalls, longest)
    loop = echo_commander(load_arm("sarcos"), port, clock).loop
    for _ in range(400):
        clock.time += port.random.uniform(0.0, 4e-3)
        loop.drain()
        loop.exchange(STILL, clock.time)
        for joint in range(N):
            if loop.seen[joint] > 0.0:
                number = round(loop.latest_position[joint] / STEP)
                assert loop.earliest[joint] <= port.taken[number] <= loop.latest[joint]


def test_a_lost_reply_is_waited_for_only_a_few_cycles() -> None:
    clock = WaitedFor(1e-5)
    port = Behind(clock, 0, stalls=0.0)
    port.lost = {50}
    loop, untimely = echo_commander(load_arm("sarcos"), port, clock).loop, 0
    for _ in range(100):
        clock.time += 3e-3
        loop.drain()
        untimely += not loop.exchange(STILL, clock.time).all_timely
    assert untimely == 1 + LATE_CYCLES
