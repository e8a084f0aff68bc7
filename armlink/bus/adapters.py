"""Adapters of python-can's buses: SocketCAN and udp_multicast through their sockets, others through messages."""

import logging
from typing import TYPE_CHECKING, cast

import can

from armlink.bus.can_bus import CanBus, MessageBus
from armlink.bus.in_process import InProcessBus
from armlink.bus.message_port import MessagePort, receive_message
from armlink.bus.port import Port, interface_fault
from armlink.bus.sockets.datagram_port import SocketPort
from armlink.clock import Clock

log = logging.getLogger(__name__)
if TYPE_CHECKING:
    from armlink.bus.sockets.multicast_port import MulticastPort


class PythonCanBus:
    """Any interface of python-can."""

    clock: Clock | None = None

    def __init__(self, bus: can.BusABC, name: str = "") -> None:
        """Take ownership of a python-can bus; `name` for messages, by default python-can's own."""
        self.bus = bus
        self.channel_info = name or str(bus.channel_info)

    @property
    def fd(self) -> bool:
        return str(self.bus.protocol).startswith("CanProtocol.CAN_FD")

    def open_port(self, as_node: bool = False) -> Port:
        return MessagePort(self.bus, self.channel_info, self.fd, as_node)

    def open_listening_port(self) -> Port:
        return self.open_port()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return receive_message(self.bus, self.channel_info, timeout)

    def shutdown(self) -> None:
        """Close the bus; what its driver says of that is logged: there is nothing that anybody could do."""
        try:
            self.bus.shutdown()
        except Exception as error:
            log.info("%s", interface_fault(error, self.channel_info, "close it"))


class SocketCanBus(PythonCanBus):
    def open_port(self, as_node: bool = False) -> Port:
        return SocketPort(self.bus.socket, self.channel_info, self.fd, as_node)

    def open_listening_port(self) -> Port:
        return SocketPort(self.bus.socket, self.channel_info, self.fd, stamped=True)


class MulticastBus(PythonCanBus):
    """CAN over UDP multicast, in python-can's format; its ports need the extra `simulator`."""

    def __init__(self, bus: can.BusABC, name: str = "") -> None:
        """Take ownership of a UdpMulticastBus of python-can."""
        super().__init__(bus, name)
        self._ports: list[MulticastPort] = []

    def open_port(self, as_node: bool = False, stamped: bool = False) -> Port:
        from armlink.bus.sockets.multicast_port import MulticastPort

        inner = self.bus._multicast  # python-can has no public access to the group
        group, name = (inner.group, inner.port), self.channel_info
        port = MulticastPort(inner._socket, group, inner.hop_limit, name, self.fd, as_node, stamped)
        self._ports.append(port)
        return port

    def open_listening_port(self) -> Port:
        return self.open_port(stamped=True)

    def shutdown(self) -> None:
        for port in self._ports:
            port.close()
        super().shutdown()


_ADAPTERS = {"SocketcanBus": SocketCanBus, "UdpMulticastBus": MulticastBus}
"""By name of python-can's class, so that the interface's module need not be imported."""


def adapt(bus: can.BusABC, name: str = "") -> MessageBus:
    """Adapter of a python-can bus; `name` for messages. A bus in lock-step needs none."""
    if isinstance(bus, InProcessBus):
        return cast(MessageBus, bus)
    return _ADAPTERS.get(type(bus).__name__, PythonCanBus)(bus, name)


def as_bus(bus: CanBus | can.BusABC) -> CanBus:
    """The bus itself, or the adapter of a python-can bus."""
    return adapt(bus) if isinstance(bus, can.BusABC) else bus
