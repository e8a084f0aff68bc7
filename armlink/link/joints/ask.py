"""Requests to drives through the link's own receive loop."""

from collections.abc import Callable
from typing import TypeVar

from armlink.bus.port import BUS_SHIFT, Frame
from armlink.clock import Clock
from armlink.drives.base import ANSWER_TIME, TRIES
from armlink.link.cyclic_exchange import Loop

T = TypeVar("T")
Pump = Callable[[Callable[[], bool], float], bool]
"""Runs the receive loop until the condition holds (True) or the seconds are over (False)."""


class LinkAsk:
    """Implements `armlink.drives.base.Ask` for the drives of one bus."""

    def __init__(self, loop: Loop, clock: Clock, pump: Pump, tag: int = 0) -> None:
        """`tag` marks identifiers of the bus."""
        self._loop, self._clock, self.wait, self._tag = loop, clock, pump, tag
        self.now = clock.now

    def on(self, tag: int) -> "LinkAsk":
        """The same for another bus."""
        return self if tag == self._tag else LinkAsk(self._loop, self._clock, self.wait, tag)

    def __call__(
        self, frame: Frame, answer: Callable[[int, bytes], T | None], timeout: float = ANSWER_TIME, tries: int = TRIES
    ) -> T | None:
        found: list[T] = []

        def look(can_id: int, data: bytes) -> None:
            if not found and can_id >> BUS_SHIFT == self._tag >> BUS_SHIFT:
                value = answer(can_id & ~(self._tag), data)
                if value is not None:
                    found.append(value)

        before, self._loop.on_frame = self._loop.on_frame, look
        try:
            for _ in range(tries):
                self.send(*frame)
                if self.wait(lambda: bool(found), timeout):
                    return found[0]
        finally:
            self._loop.on_frame = before
        return None

    def send(self, can_id: int, data: bytes) -> None:
        self._loop.send(can_id | self._tag, data)
