"""Several buses as one: a frame goes to the bus of its node, or to every bus if it addresses all nodes."""

import math
import select
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from armlink.bus.can_bus import MessageBus
from armlink.bus.port import Frame, Port, Selectable, Stamped, StampedPort
from armlink.clock import Clock

if TYPE_CHECKING:
    import can

SYNC_ID = 0x80
"""CANopen's SYNC goes to every bus and is heard on the first."""
_SLICE = 0.001
"""Longest wait for one bus at a time if the operating system cannot wait for all of them [s]."""


class BusGroup:
    """Several buses as one CanBus."""

    clock: Clock | None = None

    def __init__(self, members: Sequence[MessageBus], route: Mapping[int, int]) -> None:
        """`route` is node id → index of its bus among `members`."""
        self.members, self.route = tuple(members), dict(route)
        self.channel_info = " and ".join(member.channel_info for member in self.members)

    def open_port(self, as_node: bool = False) -> "GroupPort":
        """See CanBus."""
        return GroupPort([member.open_port(as_node) for member in self.members], self.route)

    def open_listening_port(self) -> "GroupPort":
        """See CanBus; SYNC is taken from the first bus only."""
        ports = [member.open_listening_port() for member in self.members]
        if all(isinstance(port, StampedPort) for port in ports):
            return StampedGroup(ports, self.route)
        return GroupPort(ports, self.route, one_sync=True)

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
        """Close every bus."""
        for member in self.members:
            member.shutdown()


class GroupPort:
    """The ports of several buses as one."""

    def __init__(self, members: Sequence[Port], route: Mapping[int, int], one_sync: bool = False) -> None:
        """`route` is node id → index of its port; `one_sync`: take SYNC from the first bus only."""
        self.members = tuple(members)
        self._of_node: dict[int, Port] = {node: self.members[index] for node, index in route.items()}
        self._numbers = [port.fileno() for port in self.members if isinstance(port, Selectable)]
        self._one_sync = one_sync

    @property
    def errors(self) -> int:
        """Error frames received on all buses."""
        return sum(port.errors for port in self.members)

    @property
    def dropped(self) -> int:
        """Frames lost on all buses."""
        return sum(port.dropped for port in self.members)

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame to the bus of its node, else to every bus; raises BusFault."""
        port = self._of_node.get(can_id & 0x7F)
        for each in self.members if port is None else (port,):
            each.send(can_id, data)

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames in this order, bus by bus; raises BusFault."""
        for port in self.members:
            port.send_all([frame for frame in frames if self._of_node.get(frame[0] & 0x7F, port) is port])

    def receive(self, timeout: float) -> Frame | None:
        """The next frame of any bus, or None after `timeout` seconds."""
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
            if frame is not None and not (index and self._one_sync and frame[0] == SYNC_ID):
                return frame
        return None


class StampedGroup(GroupPort):
    """Stamped ports as one, frames in the order of their timestamps; SYNC is taken from the first bus only."""

    def __init__(self, members: Sequence[Port], route: Mapping[int, int]) -> None:
        """`members` are stamped ports."""
        super().__init__(members, route, one_sync=True)
        self._stamped = tuple(port for port in members if isinstance(port, StampedPort))
        self._early: list[Stamped] = []

    def wait(self, timeout: float) -> None:
        """Return when a frame is there, or after `timeout` seconds."""
        select.select(self._numbers, [], [], timeout)

    def take_all(self) -> list[Stamped]:
        """All frames received before this call, in the order of time; later ones are kept for the next call."""
        end = time.monotonic()
        frames, self._early = self._early, []
        for index, member in enumerate(self._stamped):
            for frame in member.take_all():
                if not (index and frame[1] == SYNC_ID):
                    (frames if frame[0] <= end else self._early).append(frame)
        return sorted(frames, key=lambda frame: frame[0])
