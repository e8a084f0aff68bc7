"""What the daemon's parts need of the service: to say something, the time, jobs that wait for the bus."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol, TypeVar

from calib.observer.decision import Finding
from calib.records.records import CalibrationRecord

T = TypeVar("T")

Say = Callable[[str, str | None, str, dict[str, Any]], int]
"""(kind, joint, text, evidence) → id of the event."""


class Jobs(Protocol):
    """Runs work that waits for the bus: aside, and hands the outcome back on the service's own thread."""

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """`done` gets what `work` returned, or the error that it raised."""
        ...


@dataclass(frozen=True)
class Outside:
    """What recalibrations need of the service."""

    say: Say
    now: Callable[[], datetime]
    run: Jobs
    installed: Callable[[CalibrationRecord, Finding], None]
    """Called when a record is in force and its finding in the controller."""
