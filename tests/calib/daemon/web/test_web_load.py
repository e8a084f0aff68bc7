"""Clients that take what they can get: strangers on TCP, readers that do not read. Nobody else is held up."""

import contextlib
import json
import resource
import select
import socket
import sys
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))
from fast_daemon import FastDaemon
from made_up_view import MadeUpView
from served_page import Served, served

from calib.daemon import service_view
from calib.daemon.web import admission, peer

ROWS = 3000
STRANGERS = 1100


@pytest.fixture
def many_files() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, before[1]), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def asks(server: Served, path: str, tcp: bool = False) -> socket.socket:
    """A connection that has asked and does not read."""
    if tcp:
        client = socket.create_connection(("127.0.0.1", server.port))
    else:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.connect(str(server.path))
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return client


def rest_of(client: socket.socket) -> bytes:
    """What is still there to read until the connection ends."""
    client.settimeout(30)
    content = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := client.recv(1 << 16):
            content += piece
    return content


def wait_until_cut(clients: list[socket.socket]) -> None:
    """Return when the server has ended all of these connections."""
    waiting = select.poll()
    for client in clients:
        waiting.register(client, select.POLLRDHUP)
    left = {client.fileno() for client in clients}
    while left:
        ended = waiting.poll(20_000)
        assert ended, "not cut"
        for descriptor, _ in ended:
            waiting.unregister(descriptor)
            left.discard(descriptor)


def test_idle_strangers_on_tcp_lock_nobody_out(
    server: Served, many_files: None, caplog: pytest.LogCaptureFixture
) -> None:
    with contextlib.ExitStack() as open_ones:
        for _ in range(STRANGERS):
            open_ones.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=30))
        assert server.client().get("/api/status").status_code == 200
        assert server.tcp().get("/api/status").status_code == 200
    assert len(caplog.records) < 100


def test_of_one_address_only_the_newest_strangers_stay() -> None:
    class Connection:
        def __init__(self, address: str) -> None:
            self.address, self.is_cut = address, False

        def cut(self) -> None:
            self.is_cut = True
            room.leave(self)

        def unsent(self) -> int:
            return 1 << 20

    room = admission.Admission()
    first = [Connection("192.0.2.1") for _ in range(admission.MOST_OF_AN_ADDRESS + 3)]
    others = [Connection(f"192.0.2.{number}") for number in range(2, 40)]
    assert all(room.enter(each) for each in first + others)
    assert [each.is_cut for each in first[:3]] == [True] * 3
    kept = [each for each in first + others if not each.is_cut]
    assert len(kept) == admission.MOST_STRANGERS
    assert others[-1] in kept
    trusted = kept[0]
    assert room.trust(trusted)
    assert all(room.enter(Connection(f"198.51.100.{number}")) for number in range(200))
    assert not trusted.is_cut
    local = [Connection("") for _ in range(admission.MOST_LOCAL + 1)]
    assert [room.enter(each) for each in local].count(False) == 1
    stuck = [Connection("") for _ in range(20)]
    for each in stuck:
        room.stuck(each)
    assert [each.is_cut for each in stuck] == [True] * 4 + [False] * 16  # 16 MB of answers nobody takes
    stuck[-1].unsent = lambda: (1 << 20) + 1  # type: ignore[method-assign]
    room.stuck(stuck[-1])
    assert [each.is_cut for each in stuck] == [True] * 5 + [False] * 15


def test_a_long_history_nobody_reads_is_neither_made_nor_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer, "TAKE_SECONDS", 1.0)
    made = []
    real = service_view._point
    monkeypatch.setattr(service_view, "_point", lambda *values: made.append(1) or real(*values))

    def view() -> service_view.ServiceView:
        daemon = FastDaemon(tmp_path, 1)
        values = [1.0] * 7
        estimate = dict.fromkeys(("gain", "gain_std", "offset", "offset_std"), values)
        with daemon.service.journal.transaction():
            for minute in range(ROWS):
                time = daemon.wall() - timedelta(minutes=ROWS - minute)
                daemon.service.journal.add_history(time, 60.0 * minute, None, estimate)
        return daemon.view

    with served(view, tmp_path / "api.sock") as server:
        readers = [asks(server, "/api/history?limit=20000") for _ in range(30)]
        assert server.client().get("/api/status").status_code == 200
        wait_until_cut(readers)
        cut = [rest_of(reader) for reader in readers]
        assert len(made) < len(readers) * 2000  # of 21,000 points each: what sockets and buffers hold
        assert not any(answer.endswith(b"]\r\n0\r\n\r\n") for answer in cut)
        whole = server.client().get("/api/history?limit=20000").json()
        assert len(whole) == 7 * ROWS
        assert [point["joint"] for point in whole[::ROWS]] == [f"joint_{j}" for j in range(1, 8)]
        few = server.client().get("/api/history?joint=joint_2&limit=10").json()
        assert few == [point for point in whole[ROWS : 2 * ROWS] if point in few]
        assert len(few) == 10
        assert json.loads(server.client().get("/api/history?from=2999-01-01T00:00:00Z").content) == []


def test_a_reader_that_does_not_read_is_cut_on_every_route(
    server: Served, view: MadeUpView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peer, "TAKE_SECONDS", 0.3)
    view.report = tmp_path / "report.html"
    view.report.write_bytes(b"x" * 20_000_000)
    reader = asks(server, "/api/report")
    assert server.client().get("/api/report").content == b"x" * 20_000_000
    with server.client().stream("GET", "/api/status") as answer:
        assert answer.status_code == 200
    wait_until_cut([reader])
    assert len(rest_of(reader)) < 20_000_000
