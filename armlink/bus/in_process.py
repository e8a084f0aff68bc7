"""Buses inside this process: frames go in by `put` and out by `take`, without blocking."""

from abc import ABC, abstractmethod
from collections.abc import Callable

from armlink.bus.port import Frame, Port
from armlink.clock import Clock


class InProcessBus(ABC):
    """A CanBus made from `put` and `take`; waiting advances its clock."""

    channel_info: str = "in process"
    clock: Clock | None = None
    errors: int = 0

    @property
    def dropped(self) -> int:
        """Frames lost because they were not taken in time."""
        return 0

    @abstractmethod
    def put(self, can_id: int, data: bytes) -> None:
        """Send one frame; raises BusFault if the bus does not accept it."""

    @abstractmethod
    def take(self, timeout: float = 0.0) -> Frame | None:
        """The next frame, or None after `timeout` seconds of the bus's time."""

    def pass_time(self, seconds: float) -> None:
        """Let time pass, for a host whose cycle has no SYNC that does."""
        if self.clock is not None:
            self.clock.sleep_until(self.clock.now() + seconds)

    def open_port(self, as_node: bool = False) -> Port:
        return InProcessPort(self)

    def open_listening_port(self) -> Port:
        return InProcessPort(self)

    @abstractmethod
    def shutdown(self) -> None: ...


class InProcessPort:
    def __init__(self, bus: InProcessBus) -> None:
        self._bus = bus
        self.send: Callable[[int, bytes], None] = bus.put
        self.receive: Callable[[float], Frame | None] = bus.take
        self.pass_time: Callable[[float], None] = bus.pass_time

    @property
    def errors(self) -> int:
        return self._bus.errors

    @property
    def dropped(self) -> int:
        return self._bus.dropped
