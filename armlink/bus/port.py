"""The one owner of the bus: raw frames out and in, by the fastest way that the interface offers, counted."""

import errno
import select
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import can

from armlink.canopen.object_dictionary import SYNC_ID
from armlink.errors import BusFault

Frame = tuple[int, bytes]

_SLICE = 0.001  # [s] that one of several buses is waited for where the operating system cannot wait for all at once


ERROR = 0x20000000
"""Marks the identifier of an error frame, as in SocketCAN."""


class InterfaceDown(BusFault):
    """The interface is down; it may come up again."""


class Port(Protocol):
    """Frames with 11-bit identifiers; error frames are counted, the others that are not ours are dropped."""

    @property
    def errors(self) -> int:
        """Error frames so far."""
        ...

    @property
    def dropped(self) -> int:
        """Frames that were lost because they were not read in time, where the interface tells."""
        ...

    @property
    def send(self) -> Callable[[int, bytes], None]:
        """Sends one frame; raises BusFault where the interface cannot take it."""
        ...

    @property
    def receive(self) -> Callable[[float], Frame | None]:
        """The next frame, or None after so many seconds without one (0: what is there already)."""
        ...

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames of a cycle in this order; raises BusFault where the interface cannot take them."""
        ...


def open_port(bus: Any, as_node: bool = False) -> Port:
    """Wrap a bus: several (`members`), lock-step (`put`, `take`), a socket of python-can's, or python-can messages.

    `as_node` is for a node's end of the bus: it answers in classical or CAN FD frames, as it hears, and takes no
    notice of error frames.
    """
    if hasattr(bus, "members"):
        return GroupPort(bus, tuple(open_port(member, as_node) for member in bus.members))
    if hasattr(bus, "take"):
        return LockStepPort(bus)
    if is_socketcan(bus):
        from armlink.bus.socket_port import SocketPort

        return SocketPort(bus, is_fd(bus), as_node)
    if is_multicast(bus):
        from armlink.bus.multicast_port import MulticastPort

        return MulticastPort(bus, is_fd(bus), as_node)
    return MessagePort(bus, is_fd(bus), as_node)


def is_socketcan(bus: Any) -> bool:
    """Whether a python-can bus is Linux's own SocketCAN."""
    return type(bus).__name__ == "SocketcanBus"


def is_multicast(bus: Any) -> bool:
    """Whether a python-can bus is its CAN over UDP multicast."""
    return type(bus).__name__ == "UdpMulticastBus"


def is_fd(bus: Any) -> bool:
    """Whether a python-can bus takes CAN FD frames."""
    return str(getattr(bus, "protocol", "")).startswith("CanProtocol.CAN_FD")


class LockStepPort:
    """In-process bus that never blocks (`put`, `take`); waiting lets simulated time go on."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self.send: Callable[[int, bytes], None] = bus.put
        self.receive: Callable[[float], Frame | None] = bus.take

    @property
    def errors(self) -> int:
        """Error frames so far, where the bus has any."""
        return int(getattr(self._bus, "errors", 0))

    @property
    def dropped(self) -> int:
        """Frames lost so far because they were not taken in time, where the bus tells."""
        return int(getattr(self._bus, "dropped", 0))

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames in this order."""
        for can_id, data in frames:
            self.send(can_id, data)


class MessagePort:
    """Any python-can interface, by its messages; CAN FD frames with bit-rate switch where `fd`."""

    def __init__(self, bus: Any, fd: bool = False, as_node: bool = False) -> None:
        self.errors = self.dropped = 0
        self._bus, self._fd, self._as_node = bus, fd, as_node

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; raises BusFault where python-can does."""
        is_error = bool(can_id & ERROR)
        fd = self._fd and not is_error
        message = can.Message(
            arbitration_id=can_id & ~ERROR,
            data=data,
            is_extended_id=False,
            is_error_frame=is_error,
            is_fd=fd,
            bitrate_switch=fd,
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
            raise BusFault(f"bus {self._bus.channel_info}: cannot send: {error}") from None

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames in this order; raises BusFault as send."""
        for can_id, data in frames:
            self.send(can_id, data)

    def receive(self, timeout: float) -> Frame | None:
        """The next data frame with an 11-bit identifier, or None after `timeout` seconds."""
        while True:
            try:
                message = self._bus.recv(timeout=timeout)
            except (can.CanError, OSError) as error:
                down = errno.ENETDOWN in (getattr(error, "error_code", None), getattr(error, "errno", None))
                fault = InterfaceDown if down else BusFault
                raise fault(f"bus {self._bus.channel_info}: cannot receive: {error}") from None
            if message is None:
                return None
            if message.is_error_frame:
                self.errors += 1
            elif not (message.is_extended_id or message.is_remote_frame):
                if self._as_node:
                    self._fd = message.is_fd
                return message.arbitration_id, bytes(message.data)


class GroupPort:
    """Several buses as one: a frame goes to the bus of its node, one for no node or for all of them to every bus."""

    def __init__(self, group: Any, ports: Sequence[Port]) -> None:
        """Take the ports of the group's members, and `group.route` (node id → index of its bus)."""
        self.members = tuple(ports)
        self._of_node: dict[int, Port] = {node: self.members[index] for node, index in group.route.items()}
        self._numbers = [port.fileno() for port in self.members if hasattr(port, "fileno")]
        self.one_sync = False
        """For a listener: the SYNC of the first bus stands for all, where a controller sends one on each."""

    @property
    def errors(self) -> int:
        """Error frames so far, of all buses."""
        return sum(port.errors for port in self.members)

    @property
    def dropped(self) -> int:
        """Frames lost so far, of all buses."""
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
            select.select(self._numbers, [], [], timeout)
            return self._poll(0.0)
        share = _SLICE / len(self.members)
        for _ in range(max(1, round(timeout / _SLICE))):
            frame = self._poll(share)
            if frame is not None:
                return frame
        return None

    def _poll(self, timeout: float) -> Frame | None:
        for index, port in enumerate(self.members):
            frame = port.receive(timeout)
            if frame is not None and not (index and self.one_sync and frame[0] == SYNC_ID):
                return frame
        return None
