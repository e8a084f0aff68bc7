"""Frames that come late, out of order, or on a bus that is full: no joint does more than it may, and all end safe."""

import random
from collections import deque

import numpy as np
import pytest
from rows import ARM
from test_lock_step import Bench

from armlink.drives.canopen.cia402 import DriveState
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.errors import ArmlinkError, BusFault

FASTEST = ARM["link"]["joints"][0]["max_velocity"]


class Disordered:
    """What the nodes send, kept back: each frame by up to `most` cycles, those that are due in any order."""

    def __init__(self, bench: Bench, most: int, seed: int, ids: range = range(0x180, 0x400)) -> None:
        self.bus, self.most, self.ids, self.random = bench.bus, most, ids, random.Random(seed)
        self.take, self.kept = bench.bus.take, list[tuple[float, tuple[int, bytes]]]()
        self.due: deque[tuple[int, bytes]] = deque()
        bench.bus.take = self._take  # type: ignore[method-assign]

    def _take(self, timeout: float = 0.0) -> tuple[int, bytes] | None:
        now, period = self.bus.clock.now(), self.bus.arm.period
        while (frame := self.take(0.0 if self.due or self.kept else timeout)) is not None:
            late = self.random.randint(0, self.most) * period if frame[0] in self.ids else 0.0
            self.kept.append((now + late, frame))
        ready = [entry for entry in self.kept if entry[0] <= now + 1e-9]
        self.kept = [entry for entry in self.kept if entry[0] > now + 1e-9]
        self.random.shuffle(ready)
        self.due.extend(frame for _, frame in ready)
        if not self.due and timeout > 0:
            self.bus.clock.sleep_until(now + timeout)
        return self.due.popleft() if self.due else None


def worked(bench: Bench, cycles: int) -> tuple[int, ArmlinkError | None]:
    """Cycles until one raises, and its error; no joint is fast, nor beyond its torque, in any of them."""
    plant = bench.bus.arm.plant
    for cycle in range(1, cycles + 1):
        try:
            bench.link.cycle(bench.command)
        except ArmlinkError as error:
            return cycle, error
        assert np.abs(plant.velocity).max() < FASTEST
        assert np.abs(bench.bus.arm.plant.drive_torque).max() <= 30.0 + 1e-6
    return cycles, None


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("most", [1, 3])
def test_frames_a_few_cycles_late_in_any_order_cost_no_joint_its_hold(most: int, seed: int) -> None:
    bench = Bench()
    bench.enable()
    Disordered(bench, most, seed)
    cycles, error = worked(bench, 200)
    assert (cycles, error) == (200, None) or isinstance(error, BusFault)
    if error is None:
        assert all(state is DriveState.ENABLED for state in bench.states)
        bench.bus.inject("node.silent:joint_2")  # a node that is cut off is noticed all the same
        assert isinstance(bench.cycles_until_fault()[1], BusFault)
    assert bench.safe()


LOWEST_PRIORITY = 0x7FF


def test_a_bus_that_others_fill_by_frames_of_low_priority_costs_no_cycle() -> None:
    """A wire of 1 Mbit/s, never idle: arbitration lets our frames through, and every joint is held on."""
    bench = Bench(timing=True)
    wire = bench.bus.wire
    assert wire is not None
    with bench.link:
        bench.enable()
        on_frame, busy, cycling = wire.on_frame, wire._busy, wire._cycling

        def more(can_id: int, data: bytes) -> None:
            if can_id == SYNC_ID:
                bench.bus.arm.outbox.extend([(LOWEST_PRIORITY, bytes(8))] * 60)
            on_frame(can_id, data)

        wire.on_frame = more  # type: ignore[method-assign]
        assert worked(bench, 200) == (200, None)
        assert (wire._busy - busy) / (wire._cycling - cycling) > 0.99
        assert all(state is DriveState.ENABLED for state in bench.states)
