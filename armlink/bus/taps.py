"""Taps: a bus or port that passes on its traffic, to a frame log or to statistics."""

from collections.abc import Callable

import can

from armlink.bus.can_bus import MessageBus
from armlink.bus.in_process import InProcessBus
from armlink.bus.message_port import as_frame, is_data, receive_message
from armlink.bus.port import Frame, Port
from armlink.clock import Clock, MonotonicClock
from armlink.errors import BusFault


class TappedBus(InProcessBus):
    """A listen-only bus that also passes every message and its time to `tap`."""

    ended = False

    def __init__(self, source: MessageBus, tap: Callable[[can.Message, int], None]) -> None:
        """Take ownership of `source`; `tap` gets each message and its timestamp by the interface [µs]."""
        self._source, self._tap = source, tap
        self.clock, self.channel_info = source.clock, source.channel_info
        self._now = (source.clock or MonotonicClock()).now
        self._first: int | None = None
        self._newest = 0

    def stamp(self) -> float:
        """Time of the newest frame since the first [s], by the interface's timestamps."""
        return self._newest / 1e6

    def take(self, timeout: float = 0.0) -> Frame | None:
        while True:
            message = receive_message(self._source, self.channel_info, timeout)
            if message is None:
                return None
            stamp = round((message.timestamp or self._now()) * 1e6)
            self._first = stamp if self._first is None else self._first
            self._newest = stamp - self._first
            self._tap(message, stamp)
            if is_data(message):
                return as_frame(message)

    def put(self, can_id: int, data: bytes) -> None:
        raise BusFault(f"bus {self.channel_info}: it is opened listen-only, so nothing can be sent")

    def shutdown(self) -> None:
        self._source.shutdown()


class TappedPort:
    """A port that also passes every frame, sent or received, and its time to `tap`."""

    def __init__(self, port: Port, clock: Clock, tap: Callable[[float, int, bytes], None]) -> None:
        """`tap` gets time by `clock` [s], identifier and data."""
        self._port, self._now, self._tap = port, clock.now, tap

    @property
    def errors(self) -> int:
        return self._port.errors

    @property
    def dropped(self) -> int:
        return self._port.dropped

    def send(self, can_id: int, data: bytes) -> None:
        self._tap(self._now(), can_id, data)
        self._port.send(can_id, data)

    def receive(self, timeout: float) -> Frame | None:
        frame = self._port.receive(timeout)
        if frame is not None:
            self._tap(self._now(), *frame)
        return frame
