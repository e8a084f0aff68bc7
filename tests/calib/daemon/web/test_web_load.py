"""Clients that take what they can get: strangers on TCP, readers that do not read. Nobody else is held up."""

import asyncio
import contextlib
import http.client
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
from served_page import TOKEN, Served, served

from calib.daemon import service_view
from calib.daemon.web import connection, stream
from calib.daemon.web.stream import Streams

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


def test_strangers_displace_the_oldest_stranger_and_nobody_who_has_shown_the_token(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MOST_STRANGERS", 4)
    trusted = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    trusted.auto_open = 0  # the connection it has, and no other
    trusted.connect()
    before: list[socket.socket] = []
    with contextlib.ExitStack() as open_ones, contextlib.closing(trusted):
        for _ in range(3):
            trusted.request("GET", "/api/status", headers={"Authorization": f"Bearer {TOKEN}"})
            answer = trusted.getresponse()
            assert (answer.status, json.loads(answer.read())["state"]) == (200, "observing")
            now = [
                open_ones.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=30))
                for _ in range(4)
            ]
            wait_until_cut(before)
            before = now


@pytest.mark.long
def test_a_long_history_nobody_reads_is_neither_made_nor_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "PATIENCE_SECONDS", 1.0)
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
    monkeypatch.setattr(connection, "PATIENCE_SECONDS", 0.3)
    view.report = tmp_path / "report.html"
    view.report.write_bytes(b"x" * 20_000_000)
    reader = asks(server, "/api/report")
    assert server.client().get("/api/report").content == b"x" * 20_000_000
    with server.client().stream("GET", "/api/status") as answer:
        assert answer.status_code == 200
    wait_until_cut([reader])
    assert len(rest_of(reader)) < 20_000_000


CROWD = 600


def test_six_hundred_on_the_socket_are_all_answered_and_so_is_who_comes_later(server: Served, many_files: None) -> None:
    with contextlib.ExitStack() as open_ones:
        answers = []
        for _ in range(CROWD):
            client = open_ones.enter_context(asks(server, "/api/status"))
            client.settimeout(60)
            answers.append(client.recv(1 << 16)[:12])
        assert answers == [b"HTTP/1.1 200"] * CROWD
        assert server.client().get("/api/status").status_code == 200


def test_six_hundred_that_ask_at_once_all_get_their_turn(server: Served, many_files: None) -> None:
    with contextlib.ExitStack() as open_ones:
        clients = [open_ones.enter_context(asks(server, "/api/status")) for _ in range(CROWD)]
        for client in clients:
            client.settimeout(60)
        assert {client.recv(1 << 16)[:12] for client in clients} == {b"HTTP/1.1 200"}


def test_of_two_that_hold_streams_the_one_with_more_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "MOST_CLIENTS", 4)

    async def main() -> None:
        streams = Streams(MadeUpView())
        tasks = [asyncio.create_task(asyncio.sleep(60)) for _ in range(4)]
        streams._tasks = dict.fromkeys(tasks, "process 1")
        assert not streams.make_room("process 1")
        assert streams.make_room("process 2")
        await asyncio.gather(*tasks[:1], return_exceptions=True)
        assert [task.cancelled() for task in tasks] == [True, False, False, False]
        for task in tasks:
            task.cancel()

    asyncio.run(main())
