"""Ends a connection in stages (RFC 9112, section 9.6), within bounds, so that its last answer is not lost."""

import asyncio
from typing import Any

LINGER_BYTES = 1024 * 1024
"""Bytes that a client may send after the last answer; one that sends more is cut."""
LINGER_SECONDS = 1.5
"""Time for that from the end of the answer [s]; shorter than the server's own end (`server.CLOSING_SECONDS`)."""
FLUSH_SECONDS = 30.0
"""An answer that the client has not accepted within this time from `close` is given up [s]."""


class LingeringTransport:
    """A transport whose `close` sends the rest, half-closes, discards what arrives, and ends when the client does.

    A socket that is closed with bytes of the client unread makes the kernel reset the connection, and a client that is
    still sending gets an error instead of the answer. `abort` cuts the connection at once. The rest is the plain
    transport's.
    """

    def __init__(self, plain: asyncio.Transport) -> None:
        self._plain, self._loop = plain, asyncio.get_running_loop()
        self._lingers = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plain, name)

    def is_closing(self) -> bool:
        return self._lingers or self._plain.is_closing()

    def write(self, data: bytes) -> None:
        """Send; dropped after `close`."""
        if not self._lingers:
            self._plain.write(data)

    def close(self) -> None:
        """End the connection; its protocol gets `connection_lost` at the end and nothing before it."""
        if not self.is_closing():
            self._lingers = True
            _Drain(self._plain, self._loop).begin()


class _Drain(asyncio.Protocol):
    """Replaces a connection's protocol until the client closes or has used up its bytes or its time."""

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport, self._owner, self._loop = transport, transport.get_protocol(), loop
        self._bytes_left = LINGER_BYTES
        seconds = FLUSH_SECONDS if transport.get_write_buffer_size() else LINGER_SECONDS
        self._end = loop.call_later(seconds, transport.abort)

    def begin(self) -> None:
        """Half-close once everything is sent, and keep reading even if reading was paused."""
        self._transport.set_protocol(self)
        self._transport.set_write_buffer_limits(high=0)  # resume_writing is then called once everything is sent
        try:
            self._transport.write_eof()
        except OSError:  # the client has reset it already
            self._transport.abort()
        self._transport.resume_reading()

    def resume_writing(self) -> None:
        """Everything is sent: the time to close begins."""
        self._end.cancel()
        self._end = self._loop.call_later(LINGER_SECONDS, self._transport.abort)

    def data_received(self, data: bytes) -> None:
        self._bytes_left -= len(data)
        if self._bytes_left < 0:
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._end.cancel()
        self._owner.connection_lost(exc)
