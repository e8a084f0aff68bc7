"""Port for python-can's udp_multicast, without message objects and without its own echoes.

Multicast datagrams loop back to every socket on this machine, the sender's included, and all members share one port
number. Frames are therefore received on the python-can bus's socket but sent from a second socket, whose address
identifies the echoes.
"""

import contextlib
import socket
import struct
from collections.abc import Sequence

from armlink.bus.port import CLASSICAL, ERROR, REMOTE, Frame
from armlink.bus.sockets.datagram_port import NAME, NOT_OURS, DatagramBatch, DatagramPort
from armlink.bus.sockets.multicast_frames import LONGEST, Decoder, encode
from armlink.bus.sockets.stamped_port import Stamping
from armlink.errors import BusFault, Stall

_IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 49, 29
_IGNORED: Frame = (NOT_OURS, b"")


class MulticastPort(DatagramPort):
    """CAN over UDP multicast; with `fd` it sends CAN FD frames (bit-rate switch), without it ignores such frames."""

    def __init__(
        self,
        receiving: socket.socket,
        group: tuple[str, int],
        hop_limit: int,
        name: str,
        fd: bool = True,
        as_node: bool = False,
    ) -> None:
        """Open a socket that sends to `group` (address, port); `receiving` has joined it.

        `name` of the bus for messages, `as_node` as in CanBus.open_port. Raises BusFault without a route to the group.
        """
        self.ignored = 0
        """Datagrams received that were no frames."""
        self._fd, self._takes_fd = fd, fd
        self._sending = sending = _connect(name, receiving.family, group, hop_limit)
        self._own = _address(sending)
        _hear_one_group(receiving)
        self._decoder = Decoder()
        super().__init__(name, receiving, sending, DatagramBatch(256), DatagramBatch(LONGEST, names=True), as_node)

    def close(self) -> None:
        self._sending.close()

    def _encode(self, frames: Sequence[Frame]) -> None:
        put, fd = self._out.put, self._fd
        for i, (can_id, data) in enumerate(frames):
            put(i, encode(can_id & 0xFFFFFFFF, data, fd and not can_id & (ERROR | REMOTE | CLASSICAL)))

    def _full(self) -> BusFault:
        """No node has a part in it: the datagrams loop back within this machine."""
        return Stall(
            f"bus {self._name}: this machine accepted no datagrams for 50 ms: too many other programs run on it"
        )

    def _decode(self, count: int) -> list[Frame]:
        batch, own, decode = self._in, self._own, self._decoder.decode
        content, names, size = batch.content, batch.names, len(own)
        frames = []
        for i, (length,) in enumerate(batch.lengths(count)):
            if names[i * NAME : i * NAME + size] == own:
                frames.append(_IGNORED)
                continue
            found = decode(bytes(content[i * LONGEST : i * LONGEST + length])) if length < LONGEST else None
            if found is None:
                self.ignored += 1
                frames.append(_IGNORED)
            elif found[2] and not self._takes_fd:
                frames.append(_IGNORED)
            else:
                if self._as_node and not found[0] & (ERROR | REMOTE):
                    self._fd = found[2]
                frames.append(found[:2])
        return frames


class StampedMulticastPort(Stamping, MulticastPort):
    """With the kernel's timestamps, for listeners."""


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


def _address(sending: socket.socket) -> bytes:
    """Beginning of sockaddr_in or sockaddr_in6 that the kernel reports for datagrams from this socket."""
    address, port, *_ = sending.getsockname()
    begin = struct.pack("=H", sending.family) + struct.pack("!H", port)
    packed = socket.inet_pton(sending.family, address.partition("%")[0])
    return begin + (packed if sending.family == socket.AF_INET else bytes(4) + packed)


def _hear_one_group(receiving: socket.socket) -> None:
    """Receive only the group joined, not groups that other sockets on this machine have joined on the same port."""
    with contextlib.suppress(OSError):
        if receiving.family == socket.AF_INET:
            receiving.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        else:
            receiving.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
