"""Serves the API and the page on a Unix socket, and on TCP if configured: routes, page, and one format for all errors.

The page is one HTML document with its style and script inside, assembled from `static/` once at the start: it takes a
single round trip even on a slow network, and no other file of the disk can be requested.
"""

import asyncio
import base64
import contextlib
import errno
import hashlib
import logging
import os
import re
import resource
import socket as sockets
import stat
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException

from armlink.content.atomic_file import file_identity
from armlink.errors import BadInput
from calib.daemon.environment import CLOSING_SECONDS
from calib.daemon.view import DaemonView, StreamItem
from calib.daemon.web.connection import PATIENCE_SECONDS, protocol_of
from calib.daemon.web.guard import Access, RequestGuard, names_of_host
from calib.daemon.web.metrics import metrics_text
from calib.daemon.web.routes import ERRORS, api_router
from calib.daemon.web.stream import Streams

log = logging.getLogger(__name__)
CSP = (
    "default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Only this script and this style run, by their SHA-256."""
_IMPORT = re.compile(r'^import .* from "\./(.*)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


PAGE = "/"
"""URL path of the page, which needs no token."""


def page() -> tuple[bytes, dict[str, str]]:
    """The page, and the headers that it is sent with."""
    script, style = joined("page.js"), _static("page.css")
    icon = base64.b64encode(_static("icon.svg").encode()).decode()
    text = _static("index.html").replace("ICON", f"data:image/svg+xml;base64,{icon}")
    content = text.replace("/* STYLE */", style).replace("/* SCRIPT */", script).encode()
    policy = CSP.format(script=_hash(script), style=_hash(style))
    etag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    return content, {"etag": etag, "cache-control": "no-cache", "content-security-policy": policy}


def joined(name: str) -> str:
    """A module of `static/` and everything that it imports, each once and before its users, as one module.

    They share one scope: the same top-level name in two of them is an error that the browser reports.
    """
    order: list[str] = []

    def visit(module: str) -> None:
        for other in _IMPORT.findall(_static(module)):
            visit(other)
        if module not in order:
            order.append(module)

    visit(name)
    return "".join(_EXPORT.sub("", _IMPORT.sub("", _static(module))) for module in order)


def _static(name: str) -> str:
    return files("calib.daemon.web").joinpath("static", name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


TOKEN = {
    "type": "http",
    "scheme": "bearer",
    "description": "Needed for TCP only; access to the Unix socket follows from its file mode",
}


class Described(FastAPI):
    """An application that completes its description on the first request for it, which takes 0.2 s."""

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            _complete(super().openapi())
        return super().openapi()


def _complete(schema: dict[str, Any]) -> None:
    items = TypeAdapter(StreamItem).json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    components = schema["components"]
    for name, definition in items.pop("$defs").items():
        components["schemas"].setdefault(name, definition)
    components["schemas"]["StreamItem"] = items
    components["securitySchemes"] = {"token": TOKEN}
    schema["security"] = [{}, {"token": []}]
    events = schema["paths"]["/api/stream"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    item = {"$ref": "#/components/schemas/StreamItem"}
    events["schema"] = {"type": "string", "contentMediaType": "application/json", "x-data": item}


PURPOSE = (
    "This API shows the observed state of an arm, and lets a person approve or reject proposed recalibrations. "
    "It can command neither torque nor motion."
)


def open_app(view: DaemonView, streams: Streams) -> FastAPI:
    app = Described(
        title="armlink daemon",
        description=PURPOSE,
        version=version("armlink"),
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.include_router(api_router(view, streams, metrics_text(view, streams)))
    content, headers = page()

    @app.get(PAGE, include_in_schema=False)
    async def send_page(request: Request) -> Response:
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return Response(content, media_type="text/html; charset=utf-8", headers=headers)

    for kind, status in ERRORS.items():
        app.add_exception_handler(kind, _as_json(status))
    app.add_exception_handler(RequestValidationError, _bad_parameter)
    app.add_exception_handler(HTTPException, _of_http)
    app.add_exception_handler(Exception, _unexpected)
    return app


def _as_json(status: int) -> Callable[[Request, Exception], Awaitable[Response]]:
    async def answer(_: Request, error: Exception) -> Response:
        return JSONResponse({"error": str(error)}, status)

    return answer


async def _bad_parameter(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"][1:]) or str(first["loc"][0])
    if first["type"] == "json_invalid":
        return JSONResponse({"error": "the body is not JSON"}, 422)
    if first["type"] == "extra_forbidden":
        return JSONResponse({"error": f"{where[:80]}: there is no parameter of this name"}, 422)
    given = "" if first["type"] == "missing" else f" (got {str(first.get('input'))[:80]!r})"
    return JSONResponse({"error": f"{where}: {first['msg'].removeprefix('Value error, ')}{given}"}, 422)


async def _of_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    what = {404: f"there is no {request.url.path[:200]}", 405: f"{request.method} is not allowed here"}
    return JSONResponse({"error": what.get(error.status_code, str(error.detail))}, error.status_code, error.headers)


async def _unexpected(request: Request, error: Exception) -> Response:
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return JSONResponse({"error": "internal error; see the log of the daemon"}, 500)


SOCKET_MODE = 0o660
"""Access for owner and group only."""
SHORTEST_TOKEN = 16
MOST_CONNECTIONS = 1280
"""Connections at once; a request on a further one is answered with 503."""
FILES = 4096
"""Open files that the daemon asks the system for, as far as its hard limit allows."""


async def serve(view: DaemonView, *, socket: Path, tcp: tuple[str, int] | None, token: str | None) -> None:
    """Serve until cancelled, then remove the socket file. Raises BadInput if it cannot listen.

    The Unix socket has mode 0660, so that the file system controls access; TCP needs a token of at least 16 characters.
    """
    if tcp is not None and (token is None or len(token) < SHORTEST_TOKEN):
        raise BadInput(f"--tcp needs --token-file with a token of at least {SHORTEST_TOKEN} characters")
    with contextlib.ExitStack() as opened:
        listening, places = [opened.enter_context(unix_socket(socket))], [f"socket {socket}"]
        if tcp is not None:
            listening.append(opened.enter_context(tcp_socket(*tcp)))
            places.append(f"http://{f'[{tcp[0]}]' if ':' in tcp[0] else tcp[0]}:{tcp[1]}/ (with the token)")
        log.info(f"page and API: {', '.join(places)}")
        await _run(view, listening, Access(token, names_of_host(tcp[0]) if tcp else frozenset()))


@contextlib.contextmanager
def unix_socket(path: Path) -> Iterator[sockets.socket]:
    """A bound socket of mode 0660 under any umask, not yet listening; its file is removed at the end.

    The mode is set before bind for what the umask leaves, and after it for the rest; until `listen` nobody can connect.
    Raises BadInput if the path is taken or cannot be created.
    """
    _make_room(path)
    with sockets.socket(sockets.AF_UNIX, sockets.SOCK_STREAM) as sock:
        try:
            os.fchmod(sock.fileno(), SOCKET_MODE)
            sock.bind(str(path))
            path.chmod(SOCKET_MODE)
        except OSError as error:
            raise BadInput(f"--socket {path}: {error.strerror or error}") from None
        identity = file_identity(path)
        try:
            yield sock
        finally:
            if file_identity(path) == identity:  # not that of another daemon which has replaced ours
                path.unlink()


@contextlib.contextmanager
def tcp_socket(host: str, port: int) -> Iterator[sockets.socket]:
    """A bound TCP socket, not yet listening; raises BadInput if the address cannot be used."""
    try:
        family, kind, protocol, _, address = sockets.getaddrinfo(host, port, type=sockets.SOCK_STREAM)[0]
        with sockets.socket(family, kind, protocol) as sock:
            sock.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
            sock.bind(address)
            yield sock
    except OSError as error:
        raise BadInput(f"--tcp {host}:{port}: {error.strerror or error}") from None


def _make_room(path: Path) -> None:
    """Remove the socket file of a killed daemon; raises BadInput if it is in use or not a socket."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise BadInput(f"--socket {path}: a file of this name exists and is not a socket")
        with sockets.socket(sockets.AF_UNIX, sockets.SOCK_STREAM) as probe:
            probe.settimeout(1.0)
            probe.connect(str(path))
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno != errno.ECONNREFUSED:
            raise BadInput(f"--socket {path}: {error.strerror or error}") from None
        path.unlink(missing_ok=True)
        return
    raise BadInput(f"--socket {path}: another daemon listens there; stop that daemon, or give another path")


def _allow_files() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class _ApiServer(uvicorn.Server):
    """uvicorn's server without its signal handlers: the service has its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def _run(view: DaemonView, listening: list[sockets.socket], access: Access) -> None:
    streams = Streams(view)
    guarded = RequestGuard(open_app(view, streams), replace(access, open_paths=frozenset({PAGE})))
    _allow_files()
    config = uvicorn.Config(
        guarded,
        http=protocol_of(),
        timeout_keep_alive=round(PATIENCE_SECONDS),
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=MOST_CONNECTIONS,
        timeout_graceful_shutdown=round(CLOSING_SECONDS),
    )
    server = _ApiServer(config)
    running = asyncio.create_task(server.serve(sockets=listening))
    try:
        await asyncio.shield(running)
    finally:
        server.should_exit = True
        streams.close()
        await running
