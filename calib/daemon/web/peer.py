"""The peer of a connection, and uvicorn's HTTP protocol with limits on the resources of one connection."""

import asyncio
import json
import logging
import pwd
import socket
import struct
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, cast

import h11
from fastapi import Depends, Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from calib.daemon.web.admission import FIRST_SECONDS, Admission
from calib.daemon.web.linger import LingeringTransport

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PEER = "armlink.peer"
"""Key of the ASGI scope that holds the Peer."""
TAKE_SECONDS = 10.0
"""A client that has not taken what was sent to it, down to a rest, within this time is cut [s]."""
HEAD_SECONDS = 10.0
"""A connection that has not sent a complete request head within this time is cut [s]."""
ENDLESS = ("/api/stream",)
"""Routes whose answer does not end: nothing that is sent after such a request is ever read."""
_UCRED = struct.Struct("3i")

_log = logging.getLogger(__name__)


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
    abort: Callable[[], None] = lambda: None
    """Cuts the connection at once, unsent bytes included."""
    trust: Callable[[], bool] = lambda: True
    """It has shown the token; False where there is no room for one more such connection."""


UNKNOWN = Peer("unknown", "unknown", tcp=True)
"""A scope without a peer counts as the least trusted one."""


def peer_of(scope: Scope) -> Peer:
    found = scope.get(PEER, UNKNOWN)
    return found if isinstance(found, Peer) else UNKNOWN


async def _owner(request: Request) -> str:
    return peer_of(request.scope).owner


Owner = Annotated[str, Depends(_owner)]
"""Parameter of a route: whose connection the request came by."""


def describe_peer(transport: asyncio.Transport) -> Peer:
    """Peer of an accepted connection, by SO_PEERCRED on a Unix socket, by address on TCP."""
    sock = transport.get_extra_info("socket")
    if sock is None or sock.family != socket.AF_UNIX:
        address = str((transport.get_extra_info("peername") or ("unknown",))[0])
        local = str((transport.get_extra_info("sockname") or ("",))[0])
        return Peer(f"tcp {address}", address, tcp=True, owner=address, local=local, abort=transport.abort)
    process, uid, _ = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return Peer(f"{_user(uid)} on the socket", "", tcp=False, owner=f"process {process}", abort=transport.abort)


class BoundedProtocol(H11Protocol):
    """uvicorn's protocol, which passes the peer to the application, buffers little, and ends in time and in stages."""

    admission = Admission()
    """Of all connections of a server, which has a class of its own (`protocol_of`)."""
    address = owner = ""
    _deadline: asyncio.TimerHandle | None = None
    _taking: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Identify the peer and start the deadline of the first request."""
        super().connection_made(cast(asyncio.Transport, LingeringTransport(transport)))
        transport.set_write_buffer_limits(high=32 * 1024)  # an item of the stream is about 2 kB
        peer, app = replace(describe_peer(transport), trust=lambda: self.admission.trust(self)), self.app
        self.address, self.owner = peer.address, peer.owner

        async def with_peer(scope: Any, receive: Any, send: Any) -> None:
            scope[PEER] = peer
            await app(scope, receive, send)

        self.app = with_peer
        transport.pause_reading()
        self._mind_the_clock()
        self.admission.enter(self)
        if self.admission.queue:
            self.loop.call_later(FIRST_SECONDS, self.admission.admit)

    def begin(self) -> None:
        self.transport.resume_reading()

    def give_way(self) -> None:
        """End it in good order: nothing is being answered."""
        self._stop_the_clock()
        self.transport.close()

    def on_response_complete(self) -> None:
        """As uvicorn's; then others may have their turn."""
        super().on_response_complete()
        if self._awaits_head() and not self.conn.trailing_data[0] and not self.transport.is_closing():
            self.admission.answered(self)

    def data_received(self, data: bytes) -> None:
        """As uvicorn's, with a deadline for the rest of the head."""
        self.admission.asked(self)
        super().data_received(data)
        self._mind_the_clock()

    def handle_events(self) -> None:
        """As uvicorn's, but whoever sends more after asking for what never ends is cut, and does not wait for ever."""
        super().handle_events()
        if not self._awaits_head() and self.scope["path"] in ENDLESS and self.conn.trailing_data[0].strip(b"\r\n"):
            self.cut()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_the_clock()
        self._stop_waiting()
        self.admission.leave(self)
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """As uvicorn's, with a deadline for the client to take what was sent."""
        super().pause_writing()
        if self._taking is None:
            self._taking = self.loop.call_later(TAKE_SECONDS, self.cut)
        self.admission.stuck(self)

    def resume_writing(self) -> None:
        self._stop_waiting()
        self.admission.moves(self)
        super().resume_writing()

    def cut(self) -> None:
        """End the connection at once, unsent bytes included."""
        self.transport.abort()

    def unsent(self) -> int:
        return int(self.transport.get_write_buffer_size())

    def _stop_waiting(self) -> None:
        if self._taking is not None:
            self._taking.cancel()
            self._taking = None

    def shutdown(self) -> None:
        """The server ends: close an idle connection at once; one that lingers ends within the server's own time."""
        if self.transport.is_closing():
            return
        if self._awaits_head() and not self.transport.get_write_buffer_size():
            self.transport.abort()
        else:
            super().shutdown()

    def send_400_response(self, msg: str) -> None:
        """Answer what is not HTTP in the API's error format."""
        body = json.dumps({"error": "this is not a valid HTTP request"}).encode()
        headers = [("content-type", "application/json"), ("content-length", str(len(body))), ("connection", "close")]
        try:
            for event in (h11.Response(status_code=400, headers=headers), h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        except h11.LocalProtocolError:  # it is in the middle of an answer already
            _log.debug("%s: malformed request during an answer", msg)
        self.transport.close()
        if not self._awaits_head():  # the application has a request, and what follows it is not HTTP
            self.cycle.disconnected = True
            self.cycle.message_event.set()

    def _awaits_head(self) -> bool:
        cycle = getattr(self, "cycle", None)
        return cycle is None or bool(cycle.response_complete)

    def _mind_the_clock(self) -> None:
        if not self._awaits_head():
            self._stop_the_clock()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_SECONDS, self._cut_if_waiting)

    def _stop_the_clock(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _cut_if_waiting(self) -> None:
        self._deadline = None
        if self._awaits_head() and not self.transport.is_closing():
            self.transport.abort()


def protocol_of(admission: Admission) -> type[BoundedProtocol]:
    """The protocol of one server's connections."""
    return type("BoundedProtocol", (BoundedProtocol,), {"admission": admission})


@lru_cache(maxsize=64)
def _user(uid: int) -> str:
    try:
        return f"{pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"uid {uid}"
