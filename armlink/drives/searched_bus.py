"""A bus while drives are looked for on it: what is heard, and requests to drives of which nothing is known yet."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from armlink.bus.can_bus import CanBus
from armlink.bus.port import Frame, Port
from armlink.clock import MonotonicClock
from armlink.drives.base import ANSWER_TIME, TRIES

T = TypeVar("T")
SEARCH_SECONDS = 0.3
"""Wait for answers after the last request of a search, and for what is sent unasked before the first: an ODrive sends
its heartbeat every 0.1 s unless it is set otherwise [s]."""


class SearchedBus:
    def __init__(self, bus: CanBus, port: Port | None = None) -> None:
        """Listen to what is sent unasked; where the `port` to search is given, such as one bus of several, do not."""
        self.channel_info = bus.channel_info
        self.fd: bool = getattr(bus, "fd", True)
        """Whether it carries CAN FD; a bus inside this process does."""
        self.now, self.port = (bus.clock or MonotonicClock()).now, port or bus.open_port()
        self.send = self.port.send
        self.take: Callable[[int, bytes, float], object] = lambda can_id, data, now: None
        self.heard = self.gather([]) if port is None else []
        """Frames that came before anything was asked."""

    def gather(self, requests: Sequence[Frame]) -> list[Frame]:
        """All frames that come from the first request to SEARCH_SECONDS after the last; each is sent once."""
        found: list[Frame] = []
        for frame in requests:
            self.send(*frame)
            self._receive(lambda *came: found.append(came), 0.0)
        self._receive(lambda *came: found.append(came), SEARCH_SECONDS)
        return found

    def catch_up(self) -> None:
        """Take what came while nobody read, as while a person turned a joint: it tells of where the joint was then."""
        end = self.now() + SEARCH_SECONDS
        while self.now() <= end and (frame := self.port.receive(0.0)) is not None:
            self.take(*frame, self.now())

    def _receive(self, use: Callable[[int, bytes], T | None], seconds: float) -> T | None:
        """The first value that `use` gives for a frame that comes within so long."""
        end = self.now() + seconds
        while (frame := self.port.receive(max(0.0, end - self.now()))) is not None:
            self.take(*frame, self.now())
            if (found := use(*frame)) is not None:
                return found
            if self.now() > end:  # a babbling node must not block the search
                break
        return None

    def __call__(
        self, frame: Frame, answer: Callable[[int, bytes], T | None], timeout: float = ANSWER_TIME, tries: int = TRIES
    ) -> T | None:
        for _ in range(tries):
            self.send(*frame)
            if (found := self._receive(answer, timeout)) is not None:
                return found
        return None

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        return done() or bool(self._receive(lambda *frame: done() or None, timeout))
