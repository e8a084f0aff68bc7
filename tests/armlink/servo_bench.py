"""Servos on a pseudo-terminal: they answer as Feetech STS or Dynamixel X servos do, from tables of registers."""

import os
import pty
import select
import struct
import threading
import tty
from collections.abc import Callable

READ, WRITE, SYNC_READ, SYNC_WRITE = 0x02, 0x03, 0x82, 0x83


class ServoBench:
    """Context manager: `port` is what a program opens; `heard` is every byte that it sent."""

    def __init__(self, ids: list[int], dynamixel: bool, before_answer: Callable[[], None] = lambda: None) -> None:
        """`before_answer` is called at each request, to move the servos."""
        self.registers = {servo: bytearray(256) for servo in ids}
        self.heard = bytearray()
        self._dynamixel, self._before = dynamixel, before_answer
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._ended, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> "ServoBench":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._wake, b"x")
        self._thread.join()
        for each in (self._master, self._slave, self._ended, self._wake):
            os.close(each)

    def put(self, servo: int, address: int, content: bytes) -> None:
        self.registers[servo][address : address + len(content)] = content

    def _serve(self) -> None:
        line = b""
        while True:
            ready, _, _ = select.select([self._master, self._ended], [], [])
            if self._ended in ready:
                return
            content = os.read(self._master, 4096)
            self.heard += content
            line += content
            while (found := self._request(line)) is not None:
                (servo, instruction, parameters), line = found
                self._before()
                answer = self._answer(servo, instruction, parameters)
                if answer:
                    os.write(self._master, answer)

    def _request(self, line: bytes) -> tuple[tuple[int, int, bytes], bytes] | None:
        if self._dynamixel:
            if len(line) < 10:
                return None
            (size,) = struct.unpack_from("<H", line, 5)
            if len(line) < 7 + size:
                return None
            return (line[4], line[7], line[8 : 5 + size]), line[7 + size :]
        if len(line) < 6 or len(line) < 4 + line[3]:
            return None
        end = 4 + line[3]
        return (line[2], line[4], line[5 : end - 1]), line[end:]

    def _answer(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        width = 2 if self._dynamixel else 1
        address = int.from_bytes(parameters[:width], "little")
        size = int.from_bytes(parameters[width : 2 * width], "little")
        rest = parameters[2 * width :]
        if instruction == READ and servo in self.registers:
            return self._status(servo, address, size)
        if instruction == SYNC_READ:
            return b"".join(self._status(each, address, size) for each in rest if each in self.registers)
        if instruction == SYNC_WRITE:
            for start in range(0, len(rest) - size, size + 1):
                if rest[start] in self.registers:
                    self.put(rest[start], address, rest[start + 1 : start + 1 + size])
        if instruction == WRITE and servo in self.registers:
            self.put(servo, address, parameters[width:])
            return self._status(servo, 0, 0)
        return b""

    def _status(self, servo: int, address: int, size: int) -> bytes:
        content = bytes(self.registers[servo][address : address + size])
        if not self._dynamixel:
            body = bytes((servo, len(content) + 2, 0)) + content
            return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))
        body = bytes((0x55, 0)) + content
        packet = b"\xff\xff\xfd\x00" + bytes((servo,)) + struct.pack("<H", len(body) + 2) + body
        return packet + struct.pack("<H", crc(packet))


def crc(content: bytes) -> int:
    """By the table-free form of ROBOTIS's CRC-16."""
    value = 0
    for byte in content:
        value ^= byte << 8
        for _ in range(8):
            value = ((value << 1) ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
    return value
