"""Drives on a bus that no arm file describes yet; findings about drives, and results of their self-test."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from armlink.arrays import Array
from armlink.drives.board import Board
from armlink.errors import ArmlinkError


@dataclass(frozen=True)
class FoundDrive:
    """One drive as it answers; NaN or empty: it does not tell."""

    family: str
    node: int
    address: str
    """The id as people write it, unique on its bus."""
    drive: Mapping[str, Any] | None = None
    """Keys of `link.joints[].drive`, the family left out; None: its node id alone says what it is, or nothing does."""
    vendor: int = 0
    product: int = 0
    rated_torque: float = math.nan
    """[N·m]"""
    max_torque: float = math.nan
    """Most that it is set to, or that its frames carry [N·m]."""
    unit: float = math.nan
    """One count of its position [rad]."""
    reply: int | None = None
    """Identifier of its answers, where that is set in the drive."""
    model: str = ""
    """As on the label."""
    serial: str = ""
    largest_gains: tuple[float, float] | None = None
    """Most kp [N·m/rad] and kd [N·m·s/rad] that its frames carry; None: it has a position controller of its own."""
    note: str = ""
    """A key that was assumed, and why."""
    wrong: str = ""
    """A setting of the drive that has to be another one."""
    answers: int = 1
    """How many answered one request; more than one is an id given twice."""

    @property
    def keys(self) -> dict[str, Any]:
        """As a row of `link.joints` names it."""
        return {"node": self.node} if self.drive is None else {"drive": {"family": self.family, **self.drive}}


class FoundDrives(Protocol):
    @property
    def nodes(self) -> list[dict[str, Any]]:
        """All that answer, as `armlink scan` writes them."""

    @property
    def found(self) -> list[FoundDrive]:
        """Those that an arm file can name."""

    def positions(self) -> dict[str, float]:
        """Position reading of every drive by its address [rad]; raises BusFault."""


Level = Literal["error", "warning", "hint"]


@dataclass(frozen=True)
class SetupFinding:
    """A lack or doubt about a drive or an arm's set-up, its place, and its remedy."""

    level: Level
    what: str
    where: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.remedy}"


Outcome = Literal["passed", "failed", "absent", "not run"]


@dataclass(frozen=True)
class Result:
    joint: str
    check: str
    """`GROUP` or `GROUP: PART`."""
    outcome: Outcome
    found: str
    seconds: float | None = None
    """How long the device took, where that was measured [s]."""


ANSWER_CYCLES = 50
"""Cycles without power, to see whether each is answered."""
ANSWERED_SHARE = 0.9
"""Share of them that must be answered, in their cycle or late."""
SILENCE_DEADLINES = 3.0
"""So many deadlines are waited for a reaction to a silent host."""
HOLD_TOLERANCE = 0.05
"""A joint that moves further than this while it should hold ends a self-test [rad]."""


class Checks:
    def __init__(self) -> None:
        self.results: list[Result] = []

    def add(self, joint: str, check: str, outcome: Outcome, found: str, seconds: float | None = None) -> None:
        self.results.append(Result(joint, check, outcome, found, seconds))

    def judge(self, joint: str, check: str, passed: bool, found: str, seconds: float | None = None) -> None:
        self.add(joint, check, "passed" if passed else "failed", found, seconds)

    def attempt(self, joint: str, check: str, work: Callable[[], str]) -> bool:
        """Add what `work` found, or what it raised; whether it passed."""
        try:
            self.add(joint, check, "passed", work())
        except ArmlinkError as error:
            self.add(joint, check, "failed", str(error))
            return False
        return True

    @property
    def failed(self) -> list[Result]:
        return [each for each in self.results if each.outcome == "failed"]

    def missing(self, checks: Sequence[str], names: Sequence[str]) -> Iterator[tuple[str, str]]:
        """Joint and check of those without a result yet."""
        reached = {(each.joint, each.check) for each in self.results}
        return ((name, check) for check in checks for name in names if (name, check) not in reached)


def count_answers(
    board: Board, cycle: Callable[[], Array], cycles: int, listen: Callable[[], object]
) -> list[tuple[bool, str]]:
    """Whether each joint answers so many cycles, in time or late, and how many it did, in words.

    `cycle` makes one and returns the positions (n,) that came in it, NaN where none did; `listen` waits for late ones.
    """
    before = board.came.copy()
    in_time = np.sum([np.isfinite(cycle()) for _ in range(cycles)], axis=0)
    if (in_time < cycles).any():
        listen()
    found = []
    for now, then, timely in zip(board.came, before, in_time.tolist(), strict=True):
        came = min(now - then, cycles)
        late = f", {came - timely} of them late: this host, the bus or the drive is busy" if came > timely else ""
        found.append((came >= ANSWERED_SHARE * cycles, f"replies came in {came} of {cycles} cycles{late}"))
    return found
