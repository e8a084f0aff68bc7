"""Buses inside this process: frames go in by `put` and come out by `take`, and nothing blocks."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from armlink.bus.port import Frame, Port
from armlink.clock import Clock


class InProcessBus(ABC):
    """A CanBus by two methods; its clock goes on as its frames do."""

    channel_info: str = "in process"
    clock: Clock | None = None
    errors: int = 0
    """Error frames so far."""

    @property
    def dropped(self) -> int:
        """Frames lost so far because they were not taken in time."""
        return 0

    @abstractmethod
    def put(self, can_id: int, data: bytes) -> None:
        """Send one frame; raises BusFault if the bus does not take it."""

    @abstractmethod
    def take(self, timeout: float = 0.0) -> Frame | None:
        """The next frame, or None after `timeout` seconds of the bus's time."""

    def open_port(self, as_node: bool = False) -> Port:
        """A port; a node's end needs nothing else."""
        return InProcessPort(self)

    def open_listening_port(self) -> Port:
        """The same as any port."""
        return InProcessPort(self)

    @abstractmethod
    def shutdown(self) -> None:
        """Close the bus."""


class InProcessPort:
    """An InProcessBus as a Port; waiting lets its time go on."""

    def __init__(self, bus: InProcessBus) -> None:
        self._bus = bus
        self.send: Callable[[int, bytes], None] = bus.put
        self.receive: Callable[[float], Frame | None] = bus.take

    @property
    def errors(self) -> int:
        """Error frames so far."""
        return self._bus.errors

    @property
    def dropped(self) -> int:
        """Frames lost so far because they were not taken in time."""
        return self._bus.dropped

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames in this order."""
        for can_id, data in frames:
            self.send(can_id, data)
