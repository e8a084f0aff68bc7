"""Checks before every request: Host, rate, token, origin, size; and the headers of every answer."""

import asyncio
import hmac
import ipaddress
import math
import re
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import h11
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse

from calib.daemon.rate_limit import Rate, RateLimit
from calib.daemon.web.connection import PATIENCE_SECONDS, App, Message, Peer, Receive, Scope, Send, peer_of, until_gone

BODY_LIMIT = 4096
"""Largest body [bytes]; the only bodies are names."""
HEAD_LIMIT = 16384
"""Largest request line and headers together [bytes]."""
LINGER_BYTES, LINGER_SECONDS = 1024 * 1024, 1.5
"""Bytes, and seconds, for which a client may go on sending after a refusal; shorter than the server's own end
(`calib.daemon.environment.CLOSING_SECONDS`)."""
REQUESTS = Rate(burst=60, per_second=20)
"""Per TCP address; the page needs three requests to load, then four in two seconds."""
WRONG_TOKENS = Rate(burst=5, per_second=0.2)
"""Per TCP address."""
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
CSP = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
"""Default policy: nothing in the answer may run or be shown."""
HEADERS = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}

_LABEL = re.compile(r"[a-z0-9_-]+")


@dataclass(frozen=True)
class Access:
    token: str | None = None
    """None: no access."""
    hosts: frozenset[str] = frozenset()
    """Names that a Host header may have beside the connection's own address."""
    open_paths: frozenset[str] = frozenset()
    """The page, which needs no token."""
    now: Callable[[], float] = field(default=time.monotonic, repr=False)


class Denied(Exception):
    def __init__(self, status: int, why: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(why)
        self.status, self.headers = status, headers or {}


class RequestGuard:
    """ASGI middleware. The Unix socket's file mode controls access to it; TCP needs the token, and has rate limits.

    On both, Host must be one of the daemon's names: otherwise a page of another origin could get in through DNS
    rebinding (on the Unix socket through an SSH forward).
    """

    def __init__(self, app: App, access: Access) -> None:
        self.app, self.access = app, access
        self._requests, self._wrong = RateLimit(REQUESTS), RateLimit(WRONG_TOKENS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        peer = peer_of(scope)
        if peer.connection is not None:
            peer.connection.request_begins()
        try:
            await self._pass(scope, peer, receive, send)
        except h11.LocalProtocolError:  # uvicorn has refused the rest of the request meanwhile, and ends the connection
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER_SECONDS):
                    await until_gone(receive)
        finally:
            if peer.connection is not None:
                peer.connection.request_ends()

    async def _pass(self, scope: Scope, peer: Peer, receive: Receive, send: Send) -> None:
        headers, send = Headers(scope=scope), _with_headers(send)
        incoming = IncomingBody(receive, headers)
        try:
            self._check(scope, peer, headers)
            await incoming.read()
        except Denied as denied:
            if incoming.announced:
                denied.headers["connection"] = "close"
            await _refuse(denied, incoming, send)
            return
        await self.app(scope, incoming, send)

    def _check(self, scope: Scope, peer: Peer, headers: Headers) -> None:
        line = len(scope.get("raw_path", b"")) + len(scope["query_string"])
        if line + sum(len(name) + len(value) for name, value in scope["headers"]) > HEAD_LIMIT:
            raise Denied(431, f"request line and headers may have at most {HEAD_LIMIT} bytes", {"connection": "close"})
        if peer.tcp and (wait := self._requests.take(peer.address, self.access.now())):
            raise Denied(429, f"too many requests: wait {math.ceil(wait)} s", {"retry-after": str(math.ceil(wait))})
        host = _host_name(headers.get("host", ""))
        if not self._is_ours(host, peer):
            raise Denied(400, f"Host {headers.get('host', '')[:100]!r} is not a name of this daemon")
        if scope["method"] not in SAFE_METHODS:
            origin = headers.get("origin")
            if origin is not None and origin.partition("://")[2].lower() != headers.get("host", "").lower():
                told = f"the Origin {origin[:100]!r} is not this daemon's Host"
                raise Denied(403, f"{told}: open the daemon's own page, or let the proxy pass the Host header on")
        if peer.tcp and scope["path"] not in self.access.open_paths:
            self._check_token(headers.get("authorization", ""), peer)
            if peer.connection is not None:
                peer.connection.trust()

    def _is_ours(self, host: str, peer: Peer) -> bool:
        if _is_loopback(host):
            return not peer.tcp or _is_loopback(peer.local) or host in self.access.hosts
        if peer.tcp:
            return host in self.access.hosts or (peer.local != "" and host == peer.local)
        return _LABEL.fullmatch(host) is not None  # a single label, which no other domain can own

    def _check_token(self, authorization: str, peer: Peer) -> None:
        scheme, _, given = authorization.partition(" ")
        wanted = self.access.token
        challenge = {"www-authenticate": 'Bearer realm="armlink"'}
        if scheme.lower() != "bearer" or not given:
            raise Denied(401, "over TCP every request needs the header Authorization: Bearer TOKEN", challenge)
        if wanted is not None and hmac.compare_digest(given.strip().encode(), wanted.encode()):
            return
        if wait := self._wrong.take(peer.address, self.access.now()):
            retry = {"retry-after": str(math.ceil(wait))}
            raise Denied(429, f"too many wrong tokens from {peer.address}: wait {math.ceil(wait)} s", retry)
        raise Denied(401, "the token is wrong: the right token is in the file given as --token-file", challenge)


def names_of_host(host: str) -> frozenset[str]:
    """Valid Host names of a server that listens on `host`: that and the machine's own name."""
    machine = socket.gethostname().lower()
    return frozenset({host.lower(), machine, f"{machine}.local"})


def _host_name(header: str) -> str:
    """Host header without its port, in lower case; empty if it is not valid."""
    host = header.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    name, _, port = host.partition(":")
    return name if not port or port.isdigit() else ""


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class IncomingBody:
    """The `receive` of a request: the body is read whole (`read`), and then what the application receives."""

    def __init__(self, receive: Receive, headers: Headers) -> None:
        self._receive, self._length = receive, headers.get("content-length", "0")
        self.announced = self._length != "0" or "transfer-encoding" in headers
        self.more = self.announced
        """More of it may come."""
        self._body: bytes | None = None
        """Read, and not passed on yet."""

    async def __call__(self) -> Message:
        if self._body is not None:
            body, self._body = self._body, None
            return {"type": "http.request", "body": body, "more_body": False}
        message = await self._receive()
        self.more = message["type"] == "http.request" and message.get("more_body", False)
        return message

    async def read(self) -> None:
        """Read the whole body; raises Denied if it is too large or too slow."""
        too_large, body = Denied(413, f"the body of a request may have at most {BODY_LIMIT} bytes"), b""
        if not self._length.isdigit() or int(self._length[:20]) > BODY_LIMIT:
            raise too_large
        try:
            async with asyncio.timeout(PATIENCE_SECONDS):
                while self.more:
                    message = await self()
                    if message["type"] == "http.disconnect":
                        raise Denied(400, "the connection ended before the end of the body")
                    body += message.get("body", b"")
                    if len(body) > BODY_LIMIT:
                        raise too_large
        except TimeoutError:
            raise Denied(408, f"the body was not received within {PATIENCE_SECONDS:.0f} s") from None
        self._body = body


def _with_headers(send: Send) -> Send:
    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            given = MutableHeaders(raw=[*message.get("headers", ())])
            for name, value in HEADERS.items():
                given.setdefault(name, value)
            message = {**message, "headers": given.raw}
        await send(message)

    return with_headers


async def _refuse(denied: Denied, incoming: IncomingBody, send: Send) -> None:
    """Answer, and discard what the client still sends: a connection that is closed with bytes unread is reset, and the
    client gets an error instead of the answer (RFC 9112, section 9.6)."""
    answer = JSONResponse({"error": str(denied)}, denied.status, denied.headers)
    await send({"type": "http.response.start", "status": denied.status, "headers": answer.raw_headers})
    await send({"type": "http.response.body", "body": answer.body, "more_body": True})
    left = LINGER_BYTES
    with suppress(TimeoutError):
        async with asyncio.timeout(LINGER_SECONDS):
            while incoming.more and left > 0:
                left -= len((await incoming()).get("body", b""))
    await send({"type": "http.response.body", "body": b""})
