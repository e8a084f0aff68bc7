"""What stands before every request: Host, rate, token, origin, size; and the headers that go on every answer."""

import asyncio
import hmac
import ipaddress
import json
import math
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from calib.daemon.web.peer import App, Message, Peer, Receive, Scope, Send, peer_of
from calib.daemon.web.rate import Rate, RateLimit

BODY_LIMIT = 4096
"""Bytes; the only bodies are names and reasons."""
HEAD_LIMIT = 16384
"""Bytes of the request line and headers together."""
BODY_SECONDS = 10.0
"""A body that has not come by then is given up."""
REQUESTS = Rate(burst=60, per_second=20)
"""Of one TCP address; a page needs three requests to load and four in two seconds then."""
WRONG_TOKENS = Rate(burst=5, per_second=0.2)
"""Of one TCP address."""
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
CSP = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
"""Of whatever does not say otherwise: nothing in it may run or be shown."""
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
    """Who may come in over TCP."""

    token: str | None = None
    """None: nobody."""
    hosts: frozenset[str] = frozenset()
    """Names, beside the connection's own address, that a Host header may have."""
    open_paths: frozenset[str] = frozenset()
    """The page, which needs no token."""
    now: Callable[[], float] = field(default=time.monotonic, repr=False)


class Denied(Exception):
    """A request that goes no further."""

    def __init__(self, status: int, why: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(why)
        self.status, self.headers = status, headers or {}


class Guard:
    """ASGI middleware. On the Unix socket its mode says who may come; on TCP the token does, and addresses are limited.

    The Host must be one of ours on both, or a page of another origin could come in through a rebound name (on the
    Unix socket through an SSH forward).
    """

    def __init__(self, app: App, access: Access) -> None:
        self.app, self.access = app, access
        self._requests, self._wrong = RateLimit(REQUESTS), RateLimit(WRONG_TOKENS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through to the application, or answer it here."""
        if scope["type"] != "http":
            return
        headers = _headers(scope)
        try:
            self._check(scope, peer_of(scope))
            body = await _read_body(headers, receive)
        except Denied as denied:
            if _has_body(headers):  # what has not come of it is discarded, within the bounds of `linger`
                denied.headers["connection"] = "close"
            await _answer(denied, send)
            return
        await self.app(scope, _replay(body, receive), _with_headers(send))

    def _check(self, scope: Scope, peer: Peer) -> None:
        headers = _headers(scope)
        line = len(scope.get("raw_path", b"")) + len(scope["query_string"])
        if line + sum(len(name) + len(value) for name, value in scope["headers"]) > HEAD_LIMIT:
            raise Denied(431, f"request line and headers may have {HEAD_LIMIT} bytes", {"connection": "close"})
        if peer.tcp and (wait := self._requests.take(peer.address, self.access.now())):
            raise Denied(429, f"too many requests: wait {math.ceil(wait)} s", {"retry-after": str(math.ceil(wait))})
        host = _host_name(headers.get("host", ""))
        if not self._is_ours(host, peer):
            raise Denied(400, f"Host {headers.get('host', '')[:100]!r} is not a name of this daemon")
        if scope["method"] not in SAFE_METHODS:
            origin = headers.get("origin")
            if origin is not None and origin.partition("://")[2].lower() != headers.get("host", "").lower():
                raise Denied(403, f"a page of {origin[:100]!r} may not decide anything here")
        if peer.tcp and scope["path"] not in self.access.open_paths:
            self._check_token(headers.get("authorization", ""), peer)

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
        raise Denied(401, "the token is wrong: it stands in the file given as --token-file", challenge)


def names_of_host(host: str) -> frozenset[str]:
    """Names that a Host header may have when the server listens on `host`: itself and the machine's own name."""
    machine = socket.gethostname().lower()
    return frozenset({host.lower(), machine, f"{machine}.local"})


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _host_name(header: str) -> str:
    """Host header without its port, in small letters; empty where it is none."""
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


def _has_body(headers: dict[str, str]) -> bool:
    return headers.get("content-length", "0") != "0" or "transfer-encoding" in headers


async def _read_body(headers: dict[str, str], receive: Receive) -> bytes:
    """The whole body; raises Denied where it is too large or too slow."""
    too_large = Denied(413, f"a request's body may have {BODY_LIMIT} bytes")
    length = headers.get("content-length", "0")
    if not length.isdigit() or int(length[:20]) > BODY_LIMIT:
        raise too_large
    if not _has_body(headers):
        return b""
    body = b""
    try:
        async with asyncio.timeout(BODY_SECONDS):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise Denied(400, "the connection ended within the body")
                body += bytes(message.get("body", b""))
                if len(body) > BODY_LIMIT:
                    raise too_large
                if not message.get("more_body", False):
                    return body
    except TimeoutError:
        raise Denied(408, f"the body did not come within {BODY_SECONDS:.0f} s") from None


def _replay(body: bytes, receive: Receive) -> Receive:
    """`receive` that first gives the body that was read."""
    first = True

    async def replay() -> Message:
        nonlocal first
        if first:
            first = False
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return replay


def _with_headers(send: Send) -> Send:
    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            given = {name for name, _ in message.get("headers", [])}
            more = [(name.encode(), value.encode()) for name, value in HEADERS.items() if name.encode() not in given]
            message = {**message, "headers": [*message.get("headers", []), *more]}
        await send(message)

    return with_headers


async def _answer(denied: Denied, send: Send) -> None:
    body = json.dumps({"error": str(denied)}, ensure_ascii=False).encode()
    headers = {"content-type": "application/json", "content-length": str(len(body)), **denied.headers}
    start = [(name.encode(), value.encode()) for name, value in headers.items()]
    send = _with_headers(send)
    await send({"type": "http.response.start", "status": denied.status, "headers": start})
    await send({"type": "http.response.body", "body": body})
