"""Port for any interface of python-can, by message objects."""

import can

from armlink.bus.port import CLASSICAL, ERROR, EXTENDED, REMOTE, Frame, interface_fault


class MessagePort:
    """Messages of a python-can bus; CAN FD frames with bit-rate switch if `fd`."""

    def __init__(self, bus: can.BusABC, name: str, fd: bool = False, as_node: bool = False) -> None:
        """`name` of the bus for messages; `as_node` as in CanBus.open_port."""
        self.errors = self.dropped = 0
        self._bus, self._name, self._fd, self._as_node = bus, name, fd, as_node

    def send(self, can_id: int, data: bytes) -> None:
        try:
            self._bus.send(as_message(can_id, data, self._fd))
        except Exception as error:
            raise interface_fault(error, self._name, "send") from None

    def receive(self, timeout: float) -> Frame | None:
        while True:
            message = receive_message(self._bus, self._name, timeout)
            if message is None:
                return None
            if message.is_error_frame:
                self.errors += 1
                continue
            if self._as_node and not message.is_remote_frame:
                self._fd = message.is_fd
            return as_frame(message)


def as_message(can_id: int, data: bytes, fd: bool) -> can.Message:
    """python-can's message of a frame; `fd`: as CAN FD with bit-rate switch, where its flags allow that."""
    fd = fd and not can_id & (ERROR | REMOTE | CLASSICAL)
    remote = bool(can_id & REMOTE)
    return can.Message(
        arbitration_id=can_id & 0x1FFFFFFF,
        data=None if remote else data,
        dlc=len(data),
        is_extended_id=bool(can_id & EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(can_id & ERROR),
        is_fd=fd,
        bitrate_switch=fd,
    )


def as_frame(message: can.Message) -> Frame:
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame | ERROR * message.is_error_frame
    return message.arbitration_id | flags, bytes(message.dlc) if message.is_remote_frame else bytes(message.data)


def is_data(message: can.Message) -> bool:
    return not (message.is_error_frame or message.is_remote_frame)


def receive_message(bus: can.BusABC, name: str, timeout: float | None) -> can.Message | None:
    """The next message of a python-can bus, or None after `timeout` seconds; raises BusFault, InterfaceDown."""
    try:
        return bus.recv(timeout=timeout)
    except Exception as error:
        raise interface_fault(error, name, "receive") from None
