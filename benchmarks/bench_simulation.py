"""The simulated arm with its bus and nodes, in lock-step, against real time."""

import atexit
import time

import numpy as np
from side_by_side import Case

from armlink.arm_file import load_arm
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus

CYCLES = 500


def cases() -> list[Case]:
    """One case: simulated seconds per second, with the bus at 250 Hz."""
    bus = LockStepBus("sarcos")
    atexit.register(bus.shutdown)
    link = Link(load_arm("sarcos"), bus)
    link.start()
    position = link.enable().position
    hold = Command.hold(np.asarray(position))

    def factor() -> float:
        start, began = time.perf_counter(), bus.clock.now()
        for _ in range(CYCLES):
            link.cycle(hold)
        return (bus.clock.now() - began) / (time.perf_counter() - start)

    return [Case("sim_real_time_factor", "s/s", factor, lambda: 1.0, "real time", less_is_better=False, runs=7)]
