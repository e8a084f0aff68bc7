"""Port for python-can's udp_multicast, without its own echoes.

Multicast datagrams loop back to every socket on this machine, the sender's included, and all members share one port
number. Frames are therefore received on the python-can bus's socket but sent from a second socket, whose address
identifies the echoes.
"""

import contextlib
import socket
from typing import Any

import can
import msgpack
from can.interfaces.udp_multicast.utils import pack_message

from armlink.bus.message_port import as_frame, as_message
from armlink.bus.port import Frame
from armlink.bus.sockets.datagram_port import DatagramPort
from armlink.errors import BusFault, Stall

LONGEST = 1024
"""Limit of datagrams [bytes]; python-can's have at most 240 without the name of a channel."""
_IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 49, 29
_TYPES: dict[str, tuple[type, ...]] = {
    "arbitration_id": (int,),
    "dlc": (int, type(None)),
    "data": (bytes, type(None)),
    **dict.fromkeys(
        ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator"),
        (bool,),
    ),
}
"""Types that python-can's fields have. It checks their values alone: a number for data would be so many bytes."""


class MulticastPort(DatagramPort):
    """CAN over UDP multicast; with `fd` it sends CAN FD frames (bit-rate switch), without it ignores such frames."""

    longest = LONGEST + 1

    def __init__(
        self,
        receiving: socket.socket,
        group: tuple[str, int],
        hop_limit: int,
        name: str,
        fd: bool = True,
        as_node: bool = False,
        stamped: bool = False,
    ) -> None:
        """Open a socket that sends to `group` (address, port); `receiving` has joined it.

        The rest is as of DatagramPort. Raises BusFault without a route to the group.
        """
        self._fd, self._takes_fd = fd, fd
        self._sending = sending = _connect(name, receiving.family, group, hop_limit)
        self._own = _address(sending.getsockname())
        _hear_one_group(receiving)
        super().__init__(name, receiving, sending, as_node, stamped)

    def close(self) -> None:
        self._sending.close()

    def _encode(self, can_id: int, data: bytes) -> bytes:
        return bytes(pack_message(as_message(can_id, data, self._fd)))

    def _full(self) -> BusFault:
        """No node has a part in it: the datagrams loop back within this machine."""
        return Stall(f"bus {self._name}: this machine accepted no datagrams for 50 ms: stop other programs on it")

    def _take(self) -> Frame | None:
        return self._decoded(*self._receiving.recvfrom(self.longest, socket.MSG_DONTWAIT))

    def _decoded(self, datagram: bytes, sender: tuple[Any, ...]) -> Frame | None:
        if _address(sender) == self._own:
            return None
        message = message_in(datagram) if len(datagram) <= LONGEST else None
        if message is None or (message.is_fd and not self._takes_fd):
            return None
        if self._as_node and not (message.is_error_frame or message.is_remote_frame):
            self._fd = message.is_fd
        return as_frame(message)


def message_in(datagram: bytes) -> can.Message | None:
    """python-can's message in a datagram; None for anything else."""
    try:
        fields = msgpack.unpackb(datagram, raw=False)
        if all(type(value) in _TYPES.get(name, (type(value),)) for name, value in fields.items()):
            return can.Message(check=True, **fields)
    except Exception:  # msgpack and python-can raise many kinds
        pass
    return None


def _connect(name: str, family: int, group: tuple[str, int], hop_limit: int) -> socket.socket:
    """A socket connected to the group, so that its source address is fixed."""
    sending = socket.socket(family, socket.SOCK_DGRAM)
    try:
        if family == socket.AF_INET:
            sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hop_limit)
        else:
            sending.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, hop_limit)
        sending.connect(group)
    except OSError as error:
        sending.close()
        raise BusFault(f"bus {name}: no route to the multicast group: {error.strerror}") from None
    return sending


def _address(name: tuple[Any, ...]) -> tuple[str, int]:
    """Host, without the interface's name that some of IPv6 have, and port of a socket's name."""
    return name[0].partition("%")[0], name[1]


def _hear_one_group(receiving: socket.socket) -> None:
    """Receive only the group joined, not groups that other sockets on this machine have joined on the same port."""
    with contextlib.suppress(OSError):
        if receiving.family == socket.AF_INET:
            receiving.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        else:
            receiving.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
