"""Serial USB-CAN adapters of motor makers as interfaces of python-can: `damiao_serial` and `robstride_serial`.

Both carry classical CAN frames in packets of bytes at 921,600 baud. Neither is told a bit rate: it keeps the one that
its maker's program has set, 1 Mbit/s as delivered.
"""

import select
import struct
import time
from abc import abstractmethod
from typing import Any

import can
from can.exceptions import CanInitializationError, CanInterfaceNotImplementedError, CanOperationError

BAUD_RATE = 921_600
"""Of both adapters' serial ports [bit/s]."""
WRITE_TIMEOUT = 0.1
"""Longest time for which the port takes no bytes before the adapter counts as gone [s]."""


class SerialAdapterBus(can.BusABC):  # type: ignore[misc]
    """A serial port whose bytes are packets of one CAN frame each."""

    hello = b""
    """Bytes with which a program begins."""

    def __init__(self, channel: str, **options: Any) -> None:
        """Open the serial port `channel`; raises CanInterfaceNotImplementedError without pyserial, SerialException."""
        try:
            import serial
        except ImportError as error:
            raise CanInterfaceNotImplementedError(str(error)) from None
        if options.get("fd"):
            raise CanInitializationError("the adapter has no CAN FD")
        options.pop("bitrate", None)
        self.channel_info = channel
        self._buffer = bytearray()
        self._serial = serial.Serial(channel, BAUD_RATE, timeout=0, write_timeout=WRITE_TIMEOUT, exclusive=True)
        self._serial.reset_input_buffer()
        self._serial.write(self.hello)
        super().__init__(channel, **options)

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.is_fd:
            raise CanOperationError("the adapter has no CAN FD")
        self._serial.write(self.packet(msg))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            self._buffer += self._serial.read(self._serial.in_waiting)
            message = self.take(self._buffer)
            if message is not None:
                message.timestamp = time.time()
                return message, False
            left = None if end is None else end - time.monotonic()
            if left is not None and left <= 0.0:
                return None, False
            if select.select([self], [], [], left)[0] and not self._serial.in_waiting:
                raise CanOperationError("the adapter was unplugged")

    def shutdown(self) -> None:
        super().shutdown()
        self._serial.close()

    @staticmethod
    @abstractmethod
    def packet(message: can.Message) -> bytes:
        """The packet that sends a frame."""

    @staticmethod
    @abstractmethod
    def take(received: bytearray) -> can.Message | None:
        """The first frame in what was received, which it removes with any rubbish before it; None if there is none."""


class DamiaoSerialBus(SerialAdapterBus):
    """Damiao's USB2CAN (user manual of the module, V1.0; its 16-byte answers as in Damiao's `DM_CAN.py`)."""

    outgoing = struct.Struct("<4sIIBIBBBB8sB")
    """Head, length, command; times and interval [0.1 ms] to send it; kind of identifier, identifier, kind of frame,
    length, two kinds of filling, data, check sum (which is not checked)."""
    incoming = struct.Struct("<BBBI8sB")
    """Head, what happened, length with flags, identifier, data, tail."""
    received = 0x11
    """Code of a frame that came; others are errors of the bus, and echoes of what was sent (12h)."""
    sent = 0x12

    @staticmethod
    def packet(message: can.Message) -> bytes:
        remote = message.is_remote_frame
        return DamiaoSerialBus.outgoing.pack(
            b"\x55\xaa\x1e\x03",
            1,
            10,
            message.is_extended_id,
            message.arbitration_id,
            remote,
            message.dlc,
            0,
            0,
            b"" if remote else bytes(message.data),
            0,
        )

    @staticmethod
    def take(received: bytearray) -> can.Message | None:
        size = DamiaoSerialBus.incoming.size
        while len(received) >= size:
            head, what, shape, identifier, data, tail = DamiaoSerialBus.incoming.unpack_from(received)
            if head != 0xAA or tail != 0x55:
                del received[0]
                continue
            del received[:size]
            if what == DamiaoSerialBus.sent:
                continue
            length = shape & 0x3F
            return can.Message(
                arbitration_id=identifier & 0x1FFFFFFF,
                is_extended_id=bool(shape & 0x40) or identifier > 0x7FF,
                is_remote_frame=bool(shape & 0x80),
                is_error_frame=what != DamiaoSerialBus.received,
                data=None if shape & 0x80 else data[: length if 0 < length < 8 else 8],
                dlc=length if shape & 0x80 else None,
            )
        return None


class RobStrideSerialBus(SerialAdapterBus):
    """RobStride's USB-CAN module: `AT`, the identifier as STM32's bxCAN keeps it, length, data, end of line.

    bxCAN's register (STM32 reference manual RM0008, CAN_TIxR): a 29-bit identifier from bit 3, an 11-bit one from bit
    21, bit 2 for 29 bits, bit 1 for a remote frame.
    """

    hello = b"AT+AT\r\n"

    @staticmethod
    def packet(message: can.Message) -> bytes:
        extended, remote = message.is_extended_id, message.is_remote_frame
        register: int = message.arbitration_id << (3 if extended else 21) | extended << 2 | remote << 1
        data = b"" if remote else bytes(message.data)
        return b"AT" + register.to_bytes(4, "big") + bytes([message.dlc]) + data + b"\r\n"

    @staticmethod
    def take(received: bytearray) -> can.Message | None:
        while len(received) >= 9:
            register, length = struct.unpack_from(">IB", received, 2)
            remote, extended = bool(register & 2), bool(register & 4)
            end = 7 + (0 if remote else length)
            if received[:2] == b"AT" and length <= 8:
                if len(received) < end + 2:
                    return None
                if received[end : end + 2] == b"\r\n":
                    data = bytes(received[7:end])
                    del received[: end + 2]
                    return can.Message(
                        arbitration_id=register >> (3 if extended else 21),
                        is_extended_id=extended,
                        is_remote_frame=remote,
                        dlc=length,
                        data=None if remote else data,
                    )
            del received[0]
        return None
