"""A pass of sweeps under way: what steps at rest and creeps at constant speed have in common.

After a stall of the cycle the joints are stopped: ask, enable them again, repeat the reading.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import HostLate, Stall
from armlink.loop.open import ArmDriver
from calib.dataset import DataWriter, PlanLine, StallLine, SweepData
from calib.motion.mover import Mover
from calib.plan.types import Sweep, SweepPlan

OnStall = Callable[[Stall], bool]
"""Told why the joints were stopped; whether to enable them again and go on."""
T = TypeVar("T")


def give_up(stall: Stall) -> bool:
    return False


def restart(
    link: ArmDriver, on_stall: OnStall, stall: Stall, note: Callable[[Stall], None] = lambda stall: None
) -> None:
    """Enable the joints again as often as it takes; raises the Stall that `on_stall` does not accept."""
    while True:
        if not on_stall(stall):
            raise stall
        note(stall)
        try:
            link.recover()
        except Stall as again:
            stall = again
        else:
            return


def repeat_work(
    link: ArmDriver, on_stall: OnStall, work: Callable[[], T], resume: Callable[[], object] | None = None
) -> T:
    """Return the result of `work`; it is repeated from its beginning after each Stall that `on_stall` accepts.

    Work that moves the arm gives its mover's `resume`: the arm then holds where it stands first.
    """
    while True:
        try:
            return work()
        except Stall as stall:
            restart(link, on_stall, stall)
            if resume is not None:
                repeat_work(link, on_stall, resume)


Progress = Callable[[int, int, float, str], None]
"""Called with (readings or sweeps done, how many in all, seconds left, what is being done)."""

TRUST = 5.0
"""The plan counts for as much as so long a time of the pass itself [s]."""
BARS = "▁▂▃▄▅▆▇█"


class SweepPass(ABC):
    """`planned`, then `sweep` for each sweep of the plan, then `rest`."""

    def __init__(
        self,
        arm: ArmFile,
        mover: Mover,
        writer: DataWriter,
        data: SweepData,
        progress: Progress | None,
        on_stall: OnStall,
    ) -> None:
        """`data` is what the writer's directory has so far."""
        self.arm, self.mover, self.writer, self.data = arm, mover, writer, data
        self.progress: Progress = progress or (lambda *_: None)
        self._on_stall = on_stall
        self._first: tuple[int, float] | None = None
        """How much was done when it was told first, and when that was [s]."""
        self.expected = np.zeros(0)
        """By the plan [s], of each of what `tell` counts."""

    @abstractmethod
    def planned(self, seed: int, reference_mass: float, given: SweepPlan | None) -> SweepPlan:
        """The plan of this pass, checked and on disk: that of the data set, else the one given, else a new one."""

    @abstractmethod
    def sweep(self, sweep: Sweep) -> None:
        """Take the readings of one sweep that are still to be taken, each on disk before the next is begun."""

    def rest(self) -> None:
        """Every joint under position control, holding."""
        try:
            self.mover.hold_all()
            self.mover.cycle()
        except Stall as stall:
            self.bridge(stall, "end")

    def keep(self, plan: SweepPlan) -> None:
        self.writer.append(PlanLine(plan=plan, resolution=tuple(self.mover.known_resolution.tolist())))

    def bridge(self, stall: Stall, reading: str) -> None:
        """Note a stall, enable the joints again and hold them where they stand; raises it if that is not wanted."""

        def note(stall: Stall) -> None:
            late = stall.late * 1e3 if isinstance(stall, HostLate) else None
            self.writer.append(StallLine(t=self.mover.seen_at, late_ms=late, reading=reading, reason=str(stall)))

        restart(self.mover.link, self._on_stall, stall, note)
        repeat_work(self.mover.link, self._on_stall, self.mover.resume)

    def tell(self, done: int, name: str, curve: Sequence[float]) -> None:
        """Report what is done; with a plot of the torques of the sweep under way."""
        first, began = self._first = self._first or (done, time.monotonic())
        pace = (time.monotonic() - began + TRUST) / (float(self.expected[first:done].sum()) + TRUST)
        left = float(self.expected[done:].sum()) * pace
        self.progress(done, len(self.expected), left, f"{name} {sparkline(curve)}" if curve else name)


def sparkline(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    steps = (len(BARS) - 1) / max(high - low, 1e-12)
    return "".join(BARS[round((value - low) * steps)] for value in values)
