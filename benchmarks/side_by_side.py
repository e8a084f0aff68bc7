"""Compares two implementations in one session: runs taken in turn, medians compared."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Figure = Callable[[], float]


@dataclass(frozen=True)
class Case:
    """One comparison; `ours` and `peer` each perform one run and return its figure in `unit`."""

    name: str
    unit: str
    ours: Figure
    peer: Figure
    peer_name: str
    less_is_better: bool = True
    runs: int = 15
    warm_up: bool = True
    """Whether a first run is discarded; not needed if the figure already excludes start-up."""


def seconds(work: Callable[[], Any], repeat: int = 1, scale: float = 1.0) -> Figure:
    """A figure: time of one call of `work` [s], times `scale`."""

    def run() -> float:
        start = time.perf_counter()
        for _ in range(repeat):
            work()
        return (time.perf_counter() - start) / repeat * scale

    return run


def measure(case: Case) -> dict[str, Any]:
    """Run a case; ratio is above 1 if ours is better."""
    if case.warm_up:
        case.ours(), case.peer()
    taken = [(case.ours(), case.peer()) for _ in range(case.runs)]
    ours, peer = (statistics.median(figures) for figures in zip(*taken, strict=True))
    return {
        "name": case.name,
        "ours": ours,
        "peer": peer,
        "unit": case.unit,
        "ratio": peer / ours if case.less_is_better else ours / peer,
        "peer_name": case.peer_name,
        "runs": case.runs,
    }
