"""The surroundings that the service is given: clocks, a thread for work that waits for the bus, the bus loop."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol, TypeVar

from armlink.loop.messages import Answer
from calib.install.journaled_write import Controllers

T = TypeVar("T")


class RunAside(Protocol):
    """Runs work that waits for the bus in another thread."""

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Call `done` on the service's own thread with the value that `work` returned, or the error it raised."""
        ...


class Port(Protocol):
    """Access to the bus loop."""

    @property
    def controllers(self) -> Controllers:
        """Reads and writes the calibration of every joint; waits for the answer, so only for work that runs aside."""
        ...

    def sweep(self, poses: int, seed: int, /) -> Answer | None:
        """Ask for a tour of poses; the reply comes as a message unless it is returned."""
        ...


@dataclass(frozen=True)
class Environment:
    """Injected by the main loop; tests have their own."""

    monotonic: Callable[[], float]
    """[s]"""
    wall: Callable[[], datetime]
    """With time zone."""
    run: RunAside
    port: Port
