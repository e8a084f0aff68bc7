"""Several buses as one. The same identifier may be on each: frames carry the number of their bus in the identifier."""

import math
import select
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from armlink.bus.can_bus import MessageBus
from armlink.bus.port import BUS_SHIFT, Frame, Port, Selectable, Stamped, StampedPort
from armlink.clock import Clock

if TYPE_CHECKING:
    import can

_SLICE = 0.001
"""Longest wait for one bus at a time if the operating system cannot wait for all of them [s]."""
_ID = (1 << BUS_SHIFT) - 1


class BusGroup:
    clock: Clock | None = None

    def __init__(self, members: Sequence[MessageBus], names: Sequence[str]) -> None:
        """`names` of the buses in the arm file, as joints have them."""
        self.members = tuple(members)
        self.tags = {name: index << BUS_SHIFT for index, name in enumerate(names)}
        """Name of a bus → what its identifiers have in addition."""
        self.channel_info = " and ".join(member.channel_info for member in self.members)

    def member(self, name: str) -> MessageBus:
        return self.members[self.tags[name] >> BUS_SHIFT]

    def open_port(self, as_node: bool = False) -> "GroupPort":
        return GroupPort([member.open_port(as_node) for member in self.members])

    def open_listening_port(self) -> "GroupPort":
        ports = [member.open_listening_port() for member in self.members]
        return StampedGroup(ports) if all(isinstance(port, StampedPort) for port in ports) else GroupPort(ports)

    def recv(self, timeout: float | None = None) -> "can.Message | None":
        """The next message of any bus, or None after `timeout` seconds (None: wait without limit)."""
        end = math.inf if timeout is None else time.monotonic() + timeout
        wait = 0.0
        while True:
            for member in self.members:
                message = member.recv(wait)
                if message is not None:
                    return message
            if time.monotonic() >= end:
                return None
            wait = min(_SLICE, max(0.0, end - time.monotonic()))

    def shutdown(self) -> None:
        for member in self.members:
            member.shutdown()


class GroupPort:
    def __init__(self, members: Sequence[Port]) -> None:
        self.members = tuple(members)
        self._numbers = [port.fileno() for port in self.members if isinstance(port, Selectable)]

    @property
    def errors(self) -> int:
        return sum(port.errors for port in self.members)

    @property
    def dropped(self) -> int:
        return sum(port.dropped for port in self.members)

    def send(self, can_id: int, data: bytes) -> None:
        self.members[can_id >> BUS_SHIFT].send(can_id & _ID, data)

    def receive(self, timeout: float) -> Frame | None:
        frame = self._poll(0.0)
        if frame is not None or timeout <= 0:
            return frame
        if len(self._numbers) == len(self.members):
            end = time.monotonic() + timeout
            while frame is None and timeout > 0:
                select.select(self._numbers, [], [], timeout)
                frame = self._poll(0.0)
                timeout = end - time.monotonic()
            return frame
        share = _SLICE / len(self.members)
        for _ in range(max(1, round(timeout / _SLICE))):
            frame = self._poll(share)
            if frame is not None:
                return frame
        return None

    def _poll(self, timeout: float) -> Frame | None:
        for index, port in enumerate(self.members):
            frame = port.receive(timeout)
            if frame is not None:
                return frame[0] | index << BUS_SHIFT, frame[1]
        return None


class StampedGroup(GroupPort):
    """Stamped ports as one, frames in the order of their timestamps."""

    def __init__(self, members: Sequence[Port]) -> None:
        super().__init__(members)
        self._stamped = tuple(port for port in members if isinstance(port, StampedPort))
        self._early: list[Stamped] = []

    def wait(self, timeout: float) -> None:
        select.select(self._numbers, [], [], timeout)

    def take_all(self) -> list[Stamped]:
        """All frames received before this call, in the order of time; later ones are kept for the next call."""
        end = time.monotonic()
        frames, self._early = self._early, []
        for index, member in enumerate(self._stamped):
            for t, can_id, data in member.take_all():
                (frames if t <= end else self._early).append((t, can_id | index << BUS_SHIFT, data))
        return sorted(frames, key=lambda frame: frame[0])
