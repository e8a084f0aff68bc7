"""One connection: who is at its other end, and the bounds of what it may hold and take.

uvicorn's protocol is used as it is, with a `Connection` between it and the socket: its transport, and the transport's
protocol. The end of a connection is in stages (RFC 9112, section 9.6), within bounds, so that its last answer is not
lost.
"""

import asyncio
import json
import pwd
import socket
import struct
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, cast

import h11
from fastapi import Depends, Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from calib.daemon.web.admission import FIRST_SECONDS, Admission

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PEER = "armlink.peer"
"""Key in the ASGI scope's state that holds the Peer."""
PATIENCE_SECONDS = 10.0
"""A client is cut that within this time has not sent a whole request head, or not taken what was sent to it, down to a
rest [s]; a body that is not whole by then is refused."""
LINGER_BYTES = 1024 * 1024
"""Bytes that a client may send after the last answer; one that sends more is cut."""
LINGER_SECONDS = 1.5
"""Time for that from the end of the answer [s]; shorter than the server's own end (`server.CLOSING_SECONDS`)."""
FLUSH_SECONDS = 30.0
"""An answer that the client has not accepted within this time from `close` is given up [s]."""
_UCRED = struct.Struct("3i")
_BODY = json.dumps({"error": "this is not a valid HTTP request"}).encode()
NOT_HTTP = (
    b"HTTP/1.1 400 Bad Request\r\ncontent-type: application/json\r\nconnection: close\r\ncontent-length: %d\r\n\r\n%b"
    % (len(_BODY), _BODY)
)
"""In place of uvicorn's answer, which is plain text."""


@dataclass(frozen=True)
class Peer:
    """The other end of one connection."""

    name: str
    """For the audit trail: "ann (uid 1000) on the socket", "tcp 127.0.0.1"."""
    address: str
    """Key of the rate limit: the address on TCP, empty on the Unix socket."""
    tcp: bool
    owner: str = ""
    """Whose connection it is, where room is scarce: a process on the Unix socket, an address on TCP."""
    local: str = ""
    """Local address of this connection (TCP), a valid Host for it."""
    connection: "Connection | None" = None


UNKNOWN = Peer("unknown", "unknown", tcp=True)
"""A scope without a peer counts as the least trusted one."""


def peer_of(scope: Scope) -> Peer:
    found = scope.get("state", {}).get(PEER)
    return found if isinstance(found, Peer) else UNKNOWN


async def _owner(request: Request) -> str:
    return peer_of(request.scope).owner


Owner = Annotated[str, Depends(_owner)]
"""Parameter of a route: whose connection the request came by."""


def describe_peer(transport: asyncio.Transport, connection: "Connection | None" = None) -> Peer:
    """Peer of an accepted connection, by SO_PEERCRED on a Unix socket, by address on TCP."""
    sock = transport.get_extra_info("socket")
    if sock is None or sock.family != socket.AF_UNIX:
        address = str((transport.get_extra_info("peername") or ("unknown",))[0])
        local = str((transport.get_extra_info("sockname") or ("",))[0])
        return Peer(f"tcp {address}", address, True, address, local, connection)
    process, uid, _ = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return Peer(f"{_user(uid)} on the socket", "", False, f"process {process}", connection=connection)


@lru_cache(maxsize=64)
def _user(uid: int) -> str:
    try:
        return f"{pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"uid {uid}"


class Connection(asyncio.Protocol):
    """Made by uvicorn for each connection; `request_begins` and `request_ends` are called by the guard.

    A socket that is closed with bytes of the client unread makes the kernel reset the connection, and a client that is
    still sending gets an error instead of the answer. `close` therefore sends the rest, half-closes, discards what
    arrives, and ends when the client does; `cut` ends at once.
    """

    admission = Admission()
    """Of all connections of a server, which has a class of its own (`protocol_of`)."""
    _plain: asyncio.Transport

    def __init__(self, protocol: Callable[..., asyncio.Protocol] = H11Protocol, **given: Any) -> None:
        """`given` is what uvicorn gives a protocol."""
        self._loop = asyncio.get_running_loop()
        self._state = given["app_state"] = dict(given.get("app_state", {}))
        self._http = protocol(**given)
        self.address = self.owner = ""
        self._requests = 0
        """Requests under way."""
        self._unanswered = False
        """Something has come since the last answer."""
        self._not_http = self._ended = self._more = self._endless = False
        self._linger_bytes: int | None = None
        """Bytes that are still discarded after `close`."""
        self._timers: dict[str, asyncio.TimerHandle] = {}

    # ---- of the socket

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Identify the peer, and wait for admission."""
        self._plain = cast(asyncio.Transport, transport)
        self._plain.set_write_buffer_limits(high=32 * 1024)  # an item of the stream is about 2 kB
        self._state[PEER] = peer = describe_peer(self._plain, self)
        self.address, self.owner = peer.address, peer.owner
        self._http.connection_made(cast(asyncio.BaseTransport, self))
        self._plain.pause_reading()
        self._after("head", PATIENCE_SECONDS)
        self.admission.enter(self)
        if self.admission.queue:
            self._loop.call_later(FIRST_SECONDS, self.admission.admit)

    def data_received(self, data: bytes) -> None:
        if self._linger_bytes is not None:
            self._linger_bytes -= len(data)
            if self._linger_bytes < 0:
                self.cut()
            return
        self._unanswered = True
        self.admission.asked(self)
        try:
            self._http.data_received(data)
        except h11.LocalProtocolError:  # what is not HTTP came in the middle of an answer
            self.close()
        if self._not_http:
            self._end(None)  # the application, which may have the request whose rest this was, answers nobody
        elif not self._requests and not self.is_closing():
            self._after("head", PATIENCE_SECONDS)

    def eof_received(self) -> bool | None:
        return None if self._linger_bytes is not None else self._http.eof_received()

    def pause_writing(self) -> None:
        """The client takes nothing: it has a deadline."""
        self._after("take", PATIENCE_SECONDS)
        self.admission.stuck(self)
        self._http.pause_writing()

    def resume_writing(self) -> None:
        if self._linger_bytes is not None:  # everything is sent: the time to close begins
            self._stop("linger")
            self._after("linger", LINGER_SECONDS)
            return
        self._stop("take")
        self.admission.moves(self)
        self._http.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop(*self._timers)
        self.admission.leave(self)
        self._end(exc)

    def _end(self, exc: Exception | None) -> None:
        if not self._ended:
            self._ended = True
            self._http.connection_lost(exc)

    # ---- of uvicorn's protocol: its transport

    def write(self, data: bytes) -> None:
        """Send; dropped after `close`."""
        if self._not_http or self._linger_bytes is not None:
            return
        if data.startswith(b"HTTP/1.1 400 ") and b"\r\ncontent-type: text/plain" in data:
            self._not_http, data = True, NOT_HTTP
        self._plain.write(data)

    def is_closing(self) -> bool:
        return self._linger_bytes is not None or self._plain.is_closing()

    def close(self) -> None:
        """End the connection in good order; its protocol gets `connection_lost` at the end and nothing before it."""
        if self.is_closing():
            return
        self._stop(*self._timers)
        if not self._unanswered:
            self._plain.close()
            return
        self._linger_bytes = LINGER_BYTES
        self._after("linger", FLUSH_SECONDS if self.unsent() else LINGER_SECONDS)
        self._plain.set_write_buffer_limits(high=0)  # resume_writing is then called once everything is sent
        try:
            self._plain.write_eof()
        except OSError:  # the client has reset it already
            self.cut()
        self._plain.resume_reading()

    def pause_reading(self) -> None:
        """Something has come that is to be read after the answer."""
        self._more = True
        self._plain.pause_reading()
        self._mind_more()

    def resume_reading(self) -> None:
        self._more = False
        self._plain.resume_reading()

    def __getattr__(self, name: str) -> Any:
        """The rest is the plain transport's."""
        return getattr(self._plain, name)

    # ---- of the guard

    def request_begins(self) -> None:
        self._requests += 1
        self._stop("head")

    def request_ends(self) -> None:
        self._requests -= 1
        self._loop.call_soon(self._rest)  # after the next request of a client that did not wait for the answer

    def _rest(self) -> None:
        if self._requests or self.is_closing():
            return
        self._unanswered = False
        self._after("head", PATIENCE_SECONDS)
        self.admission.answered(self)

    def never_ends(self) -> None:
        """The answer does not end: whoever sends more, of which nothing is ever read, is cut, and need not wait."""
        self._endless = True
        self._mind_more()

    def _mind_more(self) -> None:
        if self._endless and self._more:
            self.cut()

    def trust(self) -> bool:
        """It has shown the token; False where there is no room for one more such connection."""
        return self.admission.trust(self)

    # ---- of the admission

    def begin(self) -> None:
        self._plain.resume_reading()

    def give_way(self) -> None:
        """End it in good order: nothing is being answered."""
        self.close()

    def cut(self) -> None:
        """End the connection at once, unsent bytes included."""
        self._plain.abort()

    def unsent(self) -> int:
        return self._plain.get_write_buffer_size()

    def _after(self, name: str, seconds: float) -> None:
        """Cut it so long from now, unless that timer runs already or is stopped before."""
        if name not in self._timers:
            self._timers[name] = self._loop.call_later(seconds, self.cut)

    def _stop(self, *names: str) -> None:
        for name in names:
            if name in self._timers:
                self._timers.pop(name).cancel()


def protocol_of(admission: Admission) -> type[Connection]:
    """The protocol of one server's connections."""
    return type("Connection", (Connection,), {"admission": admission})
