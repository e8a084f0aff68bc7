"""A process that outlives the host of drives which keep on with their last command: `python -m armlink.link.keeper FD`.

The host tells its keeper in every cycle which frames leave its drives safe (`BasicDrives.safe_frames`). When the host
has died, whatever killed it, or has said nothing for some time, the keeper sends them on a bus that it opened itself
before the drives got power. It cannot help where the machine dies, or the cable to the drives.
"""

import contextlib
import pickle
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence

from armlink.arm_file import LinkSection
from armlink.bus.open import open_link_bus
from armlink.bus.port import Frame, Port
from armlink.errors import ArmlinkError, BusFault, Refused

START_SECONDS = 20.0
"""Time for a keeper to be there: it imports the package and opens the bus [s]."""
SILENT_PERIODS = 2
"""So many periods beyond `link.deadline` a keeper waits for its host: the host notices its own lateness first."""
SENDINGS, SENDING_PAUSE = 3, 0.01
"""How often the frames are sent, since one may be lost, and the time between [s]."""
END_SECONDS = 2.0
"""Time for a keeper to end when its host closes the arm [s]."""
REMEMBERED = 4
"""So many cycles are the frames of a keeper told from those of another host [cycles]."""
MOST_BYTES = 1 << 16
"""Of what is read at once; a cycle's frames are a few hundred bytes."""
LENGTH, HEAD = struct.Struct("<I"), struct.Struct("<QB")
"""Before a message, and before each of its frames: identifier and number of bytes."""
READY = b"\0"


class Keeper:
    """The process, as its host sees it."""

    def __init__(self, section: LinkSection, spec: str | None) -> None:
        """Start it on the bus that `spec` names, by default the arm file's. Raises Refused where it cannot keep."""
        self._channel, theirs = socket.socketpair()
        command = [sys.executable, "-m", "armlink.link.keeper", str(theirs.fileno())]
        self._process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
        )
        theirs.close()
        self.lost = self.heard = False
        """Whether it has ended, or reads no more; whether it was heard on the bus."""
        self._told: deque[tuple[Frame, ...]] = deque(maxlen=REMEMBERED)
        opening, told = pickle.dumps((section, spec)), b""
        self._channel.settimeout(START_SECONDS)
        with contextlib.suppress(OSError):
            self._channel.sendall(LENGTH.pack(len(opening)) + opening)
            told = self._channel.recv(MOST_BYTES)
        if told != READY:
            self.close()
            why = told.decode(errors="replace") or f"it did not start within {START_SECONDS:g} s"
            raise Refused(f"no keeper can watch this host ({why}): the drives would keep on with their last command")
        self._channel.setblocking(False)

    def renew(self, frames: Sequence[Frame]) -> None:
        """The host lives, and these frames are safe now. Raises BusFault once where the keeper is lost."""
        if self.lost:
            return
        self._told.append(tuple(frames))
        body = b"".join(HEAD.pack(can_id, len(data)) + data for can_id, data in frames)
        message = LENGTH.pack(len(body)) + body
        try:
            self.lost = self._channel.send(message) < len(message)
        except OSError:
            self.lost = True
        if self.lost:
            raise BusFault("the keeper of this host has ended: if the host died now, nothing would stop the drives")

    def sends(self, frame: Frame) -> bool:
        """Whether a frame that was heard is the keeper's; it is then noted."""
        own = any(frame in told for told in self._told)
        self.heard = self.heard or own
        return own

    def close(self) -> None:
        """End it. It sends the newest frames once more, which are none for drives without power."""
        self._channel.close()
        try:
            self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def keep(channel: socket.socket, port: Port, silence: float) -> None:
    """Take frames from a host until it closes the channel or dies; send them then, or `silence` [s] after the last."""
    frames, unread, renewed, left = list[Frame](), b"", time.monotonic(), 0
    while True:
        pause = SENDING_PAUSE if 0 < left < SENDINGS else max(renewed + silence - time.monotonic(), 0.0)
        if select.select([channel], [], [], pause if left else None)[0]:
            came = channel.recv(MOST_BYTES)
            if not came:
                break
            *messages, unread = _messages(unread + came)
            if messages:
                frames, renewed = unpack_frames(messages[-1]), time.monotonic()
                left = SENDINGS
        elif left:
            _send(port, frames)
            left -= 1
    for _ in range(SENDINGS):
        _send(port, frames)
        time.sleep(SENDING_PAUSE)


def _send(port: Port, frames: Sequence[Frame]) -> None:
    with contextlib.suppress(BusFault):  # a bus that is full now may have room the next time
        port.send_all(frames)


def _messages(data: bytes) -> list[bytes]:
    """Messages that are complete, and the rest."""
    found = []
    while len(data) >= LENGTH.size:
        end = LENGTH.size + LENGTH.unpack_from(data)[0]
        if len(data) < end:
            break
        found.append(data[LENGTH.size : end])
        data = data[end:]
    return [*found, data]


def unpack_frames(body: bytes) -> list[Frame]:
    found, place = list[Frame](), 0
    while place < len(body):
        can_id, size = HEAD.unpack_from(body, place)
        place += HEAD.size
        found.append((can_id, body[place : place + size]))
        place += size
    return found


def main(descriptor: int) -> None:
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(each, signal.SIG_IGN)  # it ends with its host
    with socket.socket(fileno=descriptor) as channel:
        data = b""
        while len(found := _messages(data)) < 2:
            came = channel.recv(MOST_BYTES)
            if not came:
                return
            data += came
        section, spec = pickle.loads(found[0])
        try:
            bus = open_link_bus(spec, section)
        except ArmlinkError as error:
            channel.sendall(str(error).encode())
            return
        try:
            port = bus.open_port()
            channel.sendall(READY)
            keep(channel, port, section.deadline + SILENT_PERIODS / section.rate)
        finally:
            bus.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]))
