"""The stream: joints and events as they come, resumed where it broke off; no client holds up another or the daemon."""

import asyncio
import contextlib
import json
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from daemon_bench import DaemonBench
from made_up_view import NAMES, MadeUpView
from served_page import Served, served
from small_arm import small_arm

from calib.daemon.service_view import ServiceView
from calib.daemon.web import connection
from calib.daemon.web import stream as stream_module
from calib.daemon.web.stream import Streams


def items(answer: httpx.Response) -> Iterator[dict[str, Any]]:
    """Messages of a stream: fields of each, `data` as JSON."""
    fields: dict[str, Any] = {}
    for line in answer.iter_lines():
        if line:
            name, _, value = line.partition(": ")
            fields[name] = json.loads(value) if name == "data" else value
        elif "data" in fields:
            yield fields
            fields = {}
        else:
            fields = {}


def first(found: Iterator[dict[str, Any]], kind: str) -> dict[str, Any]:
    return next(item for item in found if item["event"] == kind)


def test_joints_come_at_once_and_at_each_tick(server: Served, view: MadeUpView) -> None:
    with server.client().stream("GET", "/api/stream") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        found = items(answer)
        item = first(found, "joints")["data"]
        assert [joint["joint"] for joint in item["joints"]] == list(NAMES)
        assert item["type"] == "joints"
        server.do(view.tick)
        assert first(found, "joints")["data"]["t"] == pytest.approx(0.1)


def test_events_come_as_they_happen_each_with_its_id(server: Served, view: MadeUpView) -> None:
    server.do(lambda: view.happen("started"))
    with server.client().stream("GET", "/api/stream") as answer:
        found = items(answer)
        first(found, "joints")
        server.do(lambda: view.happen("drift", "joint_2", "gain"))
        event = first(found, "event")
        assert (event["id"], event["data"]["event"]["kind"]) == ("2", "drift")


@pytest.mark.parametrize(("header", "query", "expected"), [("2", "", 3), (None, "?after=1", 2), ("3", "?after=1", 4)])
def test_it_resumes_after_the_last_event(
    server: Served, view: MadeUpView, header: str | None, query: str, expected: int
) -> None:
    for _ in range(4):
        server.do(lambda: view.happen("drift"))
    headers = {} if header is None else {"Last-Event-ID": header}
    with server.client().stream("GET", f"/api/stream{query}", headers=headers) as answer:
        found = items(answer)
        assert [int(first(found, "event")["id"]) for _ in range(expected, 5)] == list(range(expected, 5))


def test_an_id_of_another_life_is_taken_for_the_newest(server: Served, view: MadeUpView) -> None:
    with server.client().stream("GET", "/api/stream", headers={"Last-Event-ID": "1000"}) as answer:
        found = items(answer)
        first(found, "joints")
        server.do(lambda: view.happen("drift"))
        assert first(found, "event")["id"] == "1"


def test_fifty_clients_get_every_item_and_it_is_encoded_once(server: Served, view: MadeUpView, monkeypatch) -> None:
    encoded = []
    plain = Streams.encode
    monkeypatch.setattr(Streams, "encode", lambda self, item: encoded.append(plain(self, item)) or encoded[-1])

    async def run() -> list[list[float]]:
        transport = httpx.AsyncHTTPTransport(uds=str(server.path), limits=httpx.Limits(max_connections=60))
        begun, times = asyncio.Barrier(51), 5

        async def read(client: httpx.AsyncClient) -> list[float]:
            seen: list[float] = []
            async with client.stream("GET", "/api/stream") as answer:
                async for line in answer.aiter_lines():
                    if line.startswith("data: "):
                        seen.append(json.loads(line[6:])["t"])
                        if len(seen) == 1:
                            await begun.wait()
                        if len(seen) == times + 1:
                            return seen
            raise AssertionError("the stream ended")

        async with httpx.AsyncClient(transport=transport, base_url="http://localhost", timeout=60) as client:
            reading = [asyncio.create_task(read(client)) for _ in range(50)]
            await begun.wait()
            for _ in range(times):
                await asyncio.to_thread(server.do, view.tick)
            return await asyncio.gather(*reading)

    seen = asyncio.run(run())
    assert all(times == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5]) for times in seen)
    assert len({id(data) for data in encoded[-50:]}) == 1


def test_clients_that_connect_while_the_service_is_busy_are_let_in(server: Served) -> None:
    """More than are accepted in one go, and none of them waits in connect()."""
    with contextlib.ExitStack() as opened:
        clients = [opened.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(160)]

        def connect() -> None:
            for each in clients:
                each.setblocking(False)
                each.connect(str(server.path))
                each.sendall(b"GET /api/status HTTP/1.1\r\nHost: localhost\r\n\r\n")

        server.do(connect)  # on the event loop's own thread: nothing is accepted meanwhile
        for each in clients:
            each.settimeout(30)
            assert each.recv(12) == b"HTTP/1.1 200"


def test_fifty_clients_cost_the_bus_no_cycle(tmp_path: Path) -> None:
    """The whole daemon on the simulated arm: what the link counts as missed or late, with all of them listening."""
    found: list[DaemonBench] = []

    def begin() -> ServiceView:
        found.append(DaemonBench(tmp_path, small_arm()))
        return found[0].view

    async def listen(server: Served) -> list[dict[str, Any]]:
        async def read() -> dict[str, Any]:
            reader, writer = await asyncio.open_unix_connection(str(server.path))
            writer.write(b"GET /api/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
            while line := await reader.readline():
                if line.startswith(b"data: ") and (item := json.loads(line[6:]))["t"] > 3.0:
                    writer.close()
                    return item
            raise AssertionError("the stream ended")

        return await asyncio.gather(*(read() for _ in range(50)))

    async def go_on() -> None:
        while True:
            if len(found[0].service.hub.clients) == 50 or found[0].now() > 0.5:
                found[0].run(0.1)
            await asyncio.sleep(0)

    with served(begin, tmp_path / "api.sock", go_on) as server:
        items = asyncio.run(listen(server))
    assert {item["bus"]["missed"] for item in items} == {0}
    assert {item["bus"]["late"] for item in items} == {0}
    assert all(item["bus"]["frames"] > 1000 and item["bus"]["connected"] for item in items)


def until(server: Served, wanted: Any) -> None:
    """Let the event loop run until something holds."""

    async def spin() -> None:
        async with asyncio.timeout(30):
            while not wanted():
                await asyncio.sleep(0)

    asyncio.run_coroutine_threadsafe(spin(), server.loop).result(60)


def test_a_client_that_does_not_read_is_cut_off(server: Served, view: MadeUpView, monkeypatch) -> None:
    monkeypatch.setattr(connection, "PATIENCE_SECONDS", 1.0)

    def flood() -> bool:
        view.tick()
        return len(view.hub.clients) == 1

    with (
        ThreadPoolExecutor(1) as pool,
        socket.socket(socket.AF_UNIX) as deaf,
        server.client().stream("GET", "/api/stream") as answer,
    ):
        deaf.connect(str(server.path))
        deaf.sendall(b"GET /api/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(server, lambda: len(view.hub.clients) == 2)
        reading = pool.submit(first, items(answer), "event")
        until(server, flood)
        server.do(lambda: view.happen("drift"))
        assert reading.result(30)["id"] == "1"
    assert "armlink_stream_cut_off_total 1.0" in server.client().get("/metrics").text


def test_a_client_that_goes_is_forgotten(server: Served, view: MadeUpView) -> None:
    with server.client().stream("GET", "/api/stream") as answer:
        first(items(answer), "joints")
    until(server, lambda: not view.hub.clients)


def test_there_is_an_end_to_the_number_of_clients(server: Served, view: MadeUpView, monkeypatch) -> None:
    monkeypatch.setattr(stream_module, "MOST_CLIENTS", 1)
    with server.client().stream("GET", "/api/stream") as answer:
        found = items(answer)
        first(found, "joints")
        refused = server.client().get("/api/stream")
        assert (refused.status_code, refused.json()["error"]) == (
            429,
            "1 clients are already on the stream: close one, or try again later",
        )


def test_a_stream_that_is_asked_for_while_the_server_ends_ends_at_once() -> None:
    """The page comes back as soon as its stream has ended, and may find the server still listening."""
    sent = []

    async def note(message: Any) -> None:
        sent.append(message)

    async def run() -> int:
        streams = Streams(MadeUpView())
        streams.close()
        client_stays = asyncio.Event().wait
        async with asyncio.timeout(30):
            await streams.run({}, client_stays, note, None)
        return streams.clients

    assert asyncio.run(run()) == 0
    assert sent == [{"type": "http.response.body", "body": b"", "more_body": False}]
