"""One connection: who is at its other end, and how long it may keep the daemon waiting.

The HTTP is uvicorn's. A `Connection` passes on to its protocol what comes from the socket, and adds deadlines for a
request's head and for a client that does not read, and room for strangers on TCP.
"""

import asyncio
import logging
import pwd
import socket
import struct
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, cast

from fastapi import Depends, Request
from uvicorn.protocols.http.h11_impl import H11Protocol

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PEER = "armlink.peer"
"""Key in the ASGI scope's state that holds the Peer."""
PATIENCE_SECONDS = 10.0
"""A client is cut that within this time has not sent a whole request head, or not taken what was sent to it [s]; a body
that is not whole by then is refused."""
MOST_STRANGERS = 64
"""TCP connections that have not shown the token; a further one takes the place of the oldest."""
_UCRED = struct.Struct("3i")

log = logging.getLogger("armlink.daemon")


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


async def until_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


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
    """Made by uvicorn for each connection; `request_begins` and `request_ends` are called by the guard."""

    strangers: ClassVar[OrderedDict["Connection", None]] = OrderedDict()
    """TCP connections without the token, the oldest first; each server has its own (`protocol_of`)."""
    _transport: asyncio.Transport

    def __init__(self, **given: Any) -> None:
        """`given` is what uvicorn gives a protocol."""
        self._loop = asyncio.get_running_loop()
        self._state = given["app_state"] = dict(given.get("app_state", {}))
        self._http = H11Protocol(**given)
        self._requests = 0
        """Requests under way."""
        self._deadlines: dict[str, asyncio.TimerHandle] = {}
        self.deaf = False
        """It was cut since it did not take what was sent to it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(0)  # what the kernel does not take waits for the client
        self._state[PEER] = peer = describe_peer(self._transport, self)
        self._http.connection_made(self._transport)
        self._cut_later("head", self.cut)
        if peer.tcp:
            if len(self.strangers) >= MOST_STRANGERS:
                next(iter(self.strangers)).cut()
            self.strangers[self] = None

    def data_received(self, data: bytes) -> None:
        self._http.data_received(data)

    def eof_received(self) -> None:
        self._http.eof_received()

    def pause_writing(self) -> None:
        self._cut_later("take", self._cut_deaf)
        self._http.pause_writing()

    def resume_writing(self) -> None:
        self._stop("take")
        self._http.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop(*self._deadlines)
        self.strangers.pop(self, None)
        self._http.connection_lost(exc)

    def request_begins(self) -> None:
        self._requests += 1
        self._stop("head")

    def request_ends(self) -> None:
        self._requests -= 1
        if not self._requests and not self._transport.is_closing():
            self._cut_later("head", self.cut)

    def trust(self) -> None:
        """It has shown the token."""
        self.strangers.pop(self, None)

    def cut(self) -> None:
        """End the connection at once, unsent bytes included."""
        self.strangers.pop(self, None)
        self._transport.abort()

    def _cut_deaf(self) -> None:
        log.warning("%s has read nothing for %.0f s and was cut off", self._state[PEER].name, PATIENCE_SECONDS)
        self.deaf = True
        self.cut()

    def _cut_later(self, why: str, cut: Callable[[], None]) -> None:
        """Cut it once patience is over, unless that deadline is stopped before."""
        if why not in self._deadlines:
            self._deadlines[why] = self._loop.call_later(PATIENCE_SECONDS, cut)

    def _stop(self, *names: str) -> None:
        for name in names:
            if name in self._deadlines:
                self._deadlines.pop(name).cancel()


def protocol_of() -> type[Connection]:
    """The protocol of one server's connections."""
    return type("Connection", (Connection,), {"strangers": OrderedDict()})
