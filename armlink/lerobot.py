"""Lets armlink listen to the servos of a LeRobot program, without a byte more on their line.

    python -m armlink.lerobot lerobot-teleoperate --robot.type=so101_follower --robot.port=/dev/ttyACM0 …

runs that command as it is, in this process, and passes a copy of what the program writes to its serial ports and reads
from them to `armlink record|monitor|daemon … --lerobot so101_follower:/dev/ttyACM0`. In a script of your own call
`armlink.lerobot.share_lines()` before the robot connects.

A copy leaves after the program's own request has left, while the servos answer. It goes to sockets of the same user on
this machine; where nobody listens, or a listener is too slow, it is dropped. This module opens no serial port and
writes nothing to one.

LeRobot reads positions alone. With `--currents` the request for positions asks for a longer block of the same servos,
which holds the currents too: no request is added, and the answers are longer by 13 bytes (Feetech) or 6 (Dynamixel).
"""

import contextlib
import hashlib
import os
import runpy
import shutil
import socket
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HEADER = struct.Struct("<4sII")
"""Mark, process and number of a datagram."""
MARK = b"ARM1"
PIECE = struct.Struct("<dBH")
"""Time by the monotonic clock [s], whether it was written (1) or read (0), and number of bytes that follow."""
LOOK_SECONDS = 1.0
"""Time between two looks for listeners [s]."""
MOST_BYTES = 16_384
"""Copies of one request and its answers are cut off there."""
SUFFIX = ".sock"
NAME_DIGITS = 12
"""Of the hash that stands for a port: the path of a socket has at most 107 bytes (unix(7))."""


def listeners_folder(port: str) -> Path:
    """Folder of the sockets that listen to a serial port; only this user can enter it."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = Path(runtime) if runtime and Path(runtime).is_dir() else Path(tempfile.gettempdir())
    line = hashlib.sha256(os.path.realpath(port).encode()).hexdigest()[:NAME_DIGITS]
    return base / f"armlink-{os.getuid()}" / line


class LineCopy:
    """Copies of one serial line: a request and its answers make one datagram, which leaves after the next request."""

    def __init__(self, port: str) -> None:
        self._folder = listeners_folder(port)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._pieces: list[bytes] = []
        self._size = self._number = 0
        self._listeners: list[str] = []
        self._looked = -LOOK_SECONDS

    def add(self, written: bool, content: bytes, now: float) -> None:
        if self._size < MOST_BYTES:
            self._pieces += (PIECE.pack(now, written, len(content)), content)
            self._size += len(content)

    def send(self) -> None:
        """Send what there is to everybody who listens, and forget it; never waits."""
        pieces, self._pieces, self._size = self._pieces, [], 0
        now = time.monotonic()
        if now - self._looked >= LOOK_SECONDS:
            self._looked, self._listeners = now, _sockets(self._folder)
        if not pieces or not self._listeners:
            return
        self._number += 1
        datagram = b"".join((HEADER.pack(MARK, os.getpid() & 0xFFFFFFFF, self._number & 0xFFFFFFFF), *pieces))
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                self._socket.sendto(datagram, listener)


def _sockets(folder: Path) -> list[str]:
    try:
        return [entry.path for entry in os.scandir(folder) if entry.name.endswith(SUFFIX)]
    except OSError:
        return []


def share_lines(currents: bool = False) -> None:
    """Copy what this process writes to serial ports and reads from them, from now on; `currents`: see above.

    What goes wrong with a copy is left alone: the program goes on as without it.
    """
    import serial

    kind: Any = serial.Serial
    if hasattr(kind, "armlink_copies"):
        return
    read, write, copies = kind.read, kind.write, dict[str, LineCopy]()
    kind.armlink_copies = copies

    def copy_of(port: Any) -> LineCopy:
        name = str(port.port)
        found = copies.get(name)
        if found is None:
            found = copies[name] = LineCopy(name)
        return found

    def read_and_copy(self: Any, size: int = 1) -> Any:
        content = read(self, size)
        if content:
            with contextlib.suppress(Exception):
                copy_of(self).add(False, bytes(content), time.monotonic())
        return content

    def write_and_copy(self: Any, content: Any, /) -> Any:
        now = time.monotonic()
        done = write(self, content)
        with contextlib.suppress(Exception):
            copy = copy_of(self)
            copy.send()
            copy.add(True, bytes(content), now)
        return done

    kind.read, kind.write = read_and_copy, write_and_copy
    if currents:
        _read_currents_too()


def _read_currents_too() -> None:
    """Let the group reads of the makers' SDKs ask for positions with currents, where they ask for positions."""
    from importlib import import_module

    from armlink.bus.listening.servo_lines import WIDER_READS

    for module in ("scservo_sdk", "dynamixel_sdk"):
        try:
            kind: Any = import_module(module).GroupSyncRead
        except ImportError:
            continue
        kind.txPacket = _widened(kind.txPacket, WIDER_READS)


def _widened(send: Any, wider: dict[tuple[int, int], tuple[int, int]]) -> Any:
    def send_wider(self: Any) -> Any:
        block = wider.get((self.start_address, self.data_length))
        if block is not None:
            self.start_address, self.data_length = block
            self.is_param_changed = True
        return send(self)

    return send_wider


def main(arguments: list[str]) -> None:
    currents = arguments[:1] == ["--currents"]
    command = arguments[1:] if currents else arguments
    found = shutil.which(command[0]) or command[0] if command else ""
    if not os.path.isfile(found):
        what = f"{command[0]}: there is no such command" if command else "no command is given"
        sys.exit(f"armlink.lerobot: {what}: python -m armlink.lerobot [--currents] COMMAND [ARGUMENTS]")
    share_lines(currents)
    sys.argv = [found, *command[1:]]
    runpy.run_path(found, run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
