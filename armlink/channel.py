"""Processes beside this one, and messages to and from them over a socket pair: sending never blocks, receiving takes
what is there."""

import pickle
import select
import socket
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import Any

_HEADER = struct.Struct("<I")
RECEIVE_BYTES = 1 << 16
MESSAGES_A_CALL = 64
"""Messages that leave with one call of the system."""
MOST_SAMPLES = 15_000
"""Samples that wait for a reader which is busy: a minute at 250 Hz; older ones are dropped."""


class Closed(Exception):
    """The process at the other end has gone."""


class Channel:
    """One end of a stream of pickled messages."""

    def __init__(self, end: socket.socket, most: int = MOST_SAMPLES) -> None:
        """Take over a connected stream socket; at most `most` samples wait for the other end."""
        end.setblocking(False)
        self._socket, self.most = end, most
        self._received = bytearray()
        self._waiting: deque[tuple[bool, bytes]] = deque()
        self._sent = 0
        """Bytes of the first waiting message that have left."""
        self._samples = 0
        self.dropped = 0
        """Samples that were dropped since nobody read them."""

    def fileno(self) -> int:
        return self._socket.fileno()

    def put(self, message: Any, sample: bool = False) -> None:
        """Queue a message; of samples that wait too long the oldest is dropped. Call `flush` to send."""
        content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        self._waiting.append((sample, _HEADER.pack(len(content)) + content))
        self._samples += sample
        if self._samples > self.most:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        for index, (sample, _) in enumerate(self._waiting):
            if sample and (index or not self._sent):
                del self._waiting[index]
                self._samples -= 1
                self.dropped += 1
                return

    def flush(self, timeout: float = 0.0) -> bool:
        """Send what the socket takes, waiting at most `timeout` seconds for it; whether all has left. Raises Closed."""
        while self._waiting:
            contents = [content for _, content in islice(self._waiting, MESSAGES_A_CALL)]
            contents[0] = contents[0][self._sent :]
            try:
                self._took(self._socket.sendmsg(contents))
            except BlockingIOError:
                if timeout <= 0 or not select.select([], [self._socket], [], timeout)[1]:
                    return False
                continue
            except OSError:
                raise Closed from None
        return True

    def _took(self, size: int) -> None:
        """So many more bytes have left."""
        self._sent += size
        while self._waiting and self._sent >= len(self._waiting[0][1]):
            sample, content = self._waiting.popleft()
            self._sent -= len(content)
            self._samples -= sample

    def wait(self, timeout: float | None) -> None:
        """Return when something has come, or after `timeout` seconds (None: wait without limit)."""
        select.select([self._socket], [], [], timeout)

    def first(self, timeout: float | None = None) -> Any:
        """The message that the other end begins with; None if none comes within `timeout` seconds. Raises Closed."""
        while True:
            self.wait(timeout)
            messages = self.receive()
            if messages or timeout is not None:
                return messages[0] if messages else None

    def receive(self) -> list[Any]:
        """All messages that have come, in order; raises Closed when the other end has gone and all were taken."""
        gone = False
        while True:
            try:
                content = self._socket.recv(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError:
                gone = True
                break
            if not content:
                gone = True
                break
            self._received += content
            if len(content) < RECEIVE_BYTES:
                break
        messages, start = [], 0
        while len(self._received) - start >= _HEADER.size:
            (size,) = _HEADER.unpack_from(self._received, start)
            end = start + _HEADER.size + size
            if len(self._received) < end:
                break
            messages.append(pickle.loads(memoryview(self._received)[start + _HEADER.size : end].tobytes()))
            start = end
        del self._received[:start]
        if gone and not messages:
            raise Closed
        return messages

    def close(self) -> None:
        self._socket.close()


def start_process(program: Sequence[str], inherits: Sequence[int] = ()) -> tuple["subprocess.Popen[bytes]", Channel]:
    """Python with these arguments in a session of its own, so that nothing of a terminal reaches it, and the channel to
    it: the number of its end's descriptor is the last argument. It holds the descriptors that it `inherits`."""
    ours, theirs = socket.socketpair()
    command, passed = [sys.executable, *program, str(theirs.fileno())], [theirs.fileno(), *inherits]
    process = subprocess.Popen(command, pass_fds=passed, stdin=subprocess.DEVNULL, start_new_session=True)
    theirs.close()
    return process, Channel(ours)


def channel_of(descriptor: int) -> Channel:
    """The channel of a process that `start_process` has started."""
    return Channel(socket.socket(fileno=descriptor))
