"""Serves the API and the page on a Unix socket, and on TCP if configured."""

import asyncio
import contextlib
import errno
import logging
import os
import resource
import socket as sockets
import stat
from collections.abc import Iterator
from pathlib import Path

import uvicorn

from armlink.content.atomic_file import file_identity
from armlink.errors import BadInput
from calib.daemon.environment import CLOSING_SECONDS
from calib.daemon.view import DaemonView
from calib.daemon.web.app import make_app
from calib.daemon.web.connection import PATIENCE_SECONDS, protocol_of
from calib.daemon.web.guard import Access, names_of_host

log = logging.getLogger(__name__)
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
    app, streams = make_app(view, access)
    _allow_files()
    config = uvicorn.Config(
        app,
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
