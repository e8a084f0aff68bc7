"""No answer is lost because the client was still sending, and a client that never stops is cut within bounds."""

import asyncio
import logging
import select
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from made_up_view import MadeUpView
from served_page import TOKEN, Served, served

from calib.daemon.environment import CLOSING_SECONDS
from calib.daemon.rate_limit import RateLimit
from calib.daemon.web import guard as guard_module
from calib.daemon.web import server as server_module
from calib.daemon.web.connection import PEER, Peer
from calib.daemon.web.guard import HEAD_LIMIT, LINGER_BYTES

MUCH = 100_000
"""Bytes; more than the server reads of any of these requests before it answers."""
BEGIN = 2 * HEAD_LIMIT
"""Bytes of a request after which the server has refused it."""
PATIENCE = 60.0
"""Seconds; of a loaded machine, far beyond the bounds under test."""

HOST = b" HTTP/1.1\r\nHost: localhost\r\n"
TO_TCP = HOST + f"Authorization: Bearer {TOKEN}\r\n".encode()
POST = b"POST /api/proposals/1/approve"
BODY = b"Content-Length: %d\r\n\r\n" % MUCH + b"x" * MUCH

CHUNK = b"1000\r\n" + b"x" * 4096 + b"\r\n"

REFUSED = {
    "wrong host": (400, POST + b" HTTP/1.1\r\nHost: evil.example\r\n" + BODY),
    "other origin": (403, POST + TO_TCP + b"Origin: http://evil.example\r\n" + BODY),
    "large body": (413, POST + TO_TCP + BODY),
    "large chunks": (
        413,
        POST
        + TO_TCP
        + b"Transfer-Encoding: chunked\r\n\r\n"
        + (b"1000\r\n" + b"x" * 4096 + b"\r\n") * 25
        + b"0\r\n\r\n",
    ),
}


@pytest.fixture(autouse=True)
def _no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """These clients come quicker than the rate limit lets them."""
    monkeypatch.setattr(RateLimit, "take", lambda *_: 0.0)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow this machine is, the time of a drain is enough."""
    monkeypatch.setattr(guard_module, "LINGER_SECONDS", PATIENCE)


def connect(server: Served, tcp: bool) -> socket.socket:
    family, address = (socket.AF_INET, ("127.0.0.1", server.port)) if tcp else (socket.AF_UNIX, str(server.path))
    raw = socket.socket(family)
    raw.settimeout(PATIENCE)
    raw.connect(address)
    return raw


def rest_of(raw: socket.socket) -> bytes:
    return b"".join(iter(lambda: raw.recv(65536), b""))


def send_on_after_the_answer(server: Served, tcp: bool, request: bytes, begin: int = BEGIN) -> bytes:
    """The answer to a client that reads nothing before it has sent all; most of it when the answer is there already."""
    with connect(server, tcp) as raw:
        raw.sendall(request[:begin])
        assert select.select([raw], [], [], PATIENCE)[0]
        for at in range(begin, len(request), 4096):
            raw.sendall(request[at : at + 4096])
        return rest_of(raw)


def is_refusal(answer: bytes, status: int) -> bool:
    head, _, body = answer.partition(b"\r\n\r\n")
    whole = f"content-length: {len(body)}\r\n".encode() in head.lower() + b"\r\n"
    return answer.startswith(b"HTTP/1.1 %d " % status) and b"connection: close" in head.lower() and whole


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("tcp", [False, True], ids=["unix", "tcp"])
@pytest.mark.parametrize("name", REFUSED)
def test_a_client_that_is_still_sending_gets_its_refusal(server: Served, name: str, tcp: bool) -> None:
    status, request = REFUSED[name]
    for _ in range(10):
        answer = send_on_after_the_answer(server, tcp, request)
        assert is_refusal(answer, status), answer[:300]
        assert b'{"error":' in answer


@pytest.mark.sample(1)
@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("tcp", [False, True], ids=["unix", "tcp"])
def test_many_clients_at_once_that_send_all_in_one_go_get_their_refusals(server: Served, tcp: bool) -> None:
    def is_refused(name: str) -> bool:
        status, request = REFUSED[name]
        with connect(server, tcp) as raw:
            raw.sendall(request)
            return is_refusal(rest_of(raw), status)

    with ThreadPoolExecutor(16) as pool:
        assert all(pool.map(is_refused, list(REFUSED) * 20))


@pytest.mark.usefixtures("patient")
def test_a_refusal_for_a_missing_token_is_not_lost_either(server: Served) -> None:
    answer = send_on_after_the_answer(server, True, POST + HOST + BODY)
    assert is_refusal(answer, 401), answer[:300]


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("tcp", [False, True], ids=["unix", "tcp"])
def test_a_body_that_came_too_slowly_may_come_after_the_answer(server: Served, monkeypatch, tcp: bool) -> None:
    monkeypatch.setattr(guard_module, "PATIENCE_SECONDS", 0.05)
    request = POST + TO_TCP + b"Content-Length: 4096\r\n\r\n" + b"x" * 4096
    for _ in range(5):
        assert is_refusal(send_on_after_the_answer(server, tcp, request, begin=len(request) - 3000), 408)


@pytest.mark.parametrize("headers", [HOST, TO_TCP], ids=["no token", "token"])
def test_a_body_that_is_not_http_is_answered_once(server: Served, caplog, headers: bytes) -> None:
    caplog.set_level(logging.ERROR)
    with connect(server, tcp=True) as raw:
        raw.sendall(POST + headers + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n")
        answer = rest_of(raw)
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert answer.count(b"HTTP/1.1") == 1
    assert not caplog.records


ENDLESS = POST + TO_TCP + b"Content-Length: %d\r\n\r\n" % 10**12 + b"x" * BEGIN


def bytes_until_cut(raw: socket.socket, piece: bytes, pause: float) -> int:
    """How much a client that never stops can send."""
    sent, end = 0, time.monotonic() + PATIENCE
    try:
        while time.monotonic() < end:
            sent += raw.send(piece)
            time.sleep(pause)
    except (BrokenPipeError, ConnectionResetError):
        return sent
    raise AssertionError(f"still connected after {sent} bytes")


@pytest.mark.parametrize("tcp", [False, True], ids=["unix", "tcp"])
def test_a_client_that_never_stops_is_cut_after_its_bytes(server: Served, monkeypatch, tcp: bool) -> None:
    monkeypatch.setattr(guard_module, "LINGER_SECONDS", 10 * PATIENCE)
    with connect(server, tcp) as raw:
        raw.sendall(ENDLESS[:BEGIN])
        between = 16 * 1024 * 1024  # what the kernel may hold of it
        assert bytes_until_cut(raw, b"x" * 65536, 0.0) < LINGER_BYTES + between


@pytest.mark.parametrize("tcp", [False, True], ids=["unix", "tcp"])
def test_a_client_that_never_stops_is_cut_after_its_time(server: Served, monkeypatch, tcp: bool) -> None:
    monkeypatch.setattr(guard_module, "LINGER_SECONDS", 0.2)
    with connect(server, tcp) as raw:
        raw.sendall(ENDLESS[:BEGIN])
        bytes_until_cut(raw, b"x", 0.01)


def test_clients_that_stay_after_their_answer_hold_no_place_for_long(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(server_module, "MOST_CONNECTIONS", 5)
    monkeypatch.setattr(guard_module, "LINGER_SECONDS", 0.2)
    with served(MadeUpView, tmp_path / "api.sock") as server:
        staying = [connect(server, False) for _ in range(4)]
        for raw in staying:
            raw.sendall(REFUSED["large body"][1])
            assert is_refusal(rest_of(raw), 413)
        end = time.monotonic() + PATIENCE
        while server.client().get("/api/status").status_code != 200:
            assert time.monotonic() < end
        for raw in staying:
            raw.close()


def test_the_server_ends_before_a_client_that_stays_has_to(tmp_path: Path) -> None:
    assert guard_module.LINGER_SECONDS < CLOSING_SECONDS
    with served(MadeUpView, tmp_path / "api.sock") as server:
        idle, staying = connect(server, False), connect(server, False)
        staying.sendall(REFUSED["large body"][1])
        assert is_refusal(rest_of(staying), 413)
    assert rest_of(idle) == b""
    for raw in (idle, staying):
        with raw, pytest.raises(BrokenPipeError):
            raw.sendall(b"x")


@pytest.mark.usefixtures("patient")
def test_a_refused_body_that_has_come_whole_is_not_waited_for() -> None:
    """However much of a request one read of the socket brings."""
    sent: list[guard_module.Message] = []
    whole = [{"type": "http.request", "body": b"x" * MUCH, "more_body": False}]
    headers = [(b"host", b"localhost"), (b"transfer-encoding", b"chunked")]
    scope = {"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": headers}
    scope["state"] = {PEER: Peer("ann", "", tcp=False)}

    async def receive() -> guard_module.Message:
        return whole.pop() if whole else await asyncio.Event().wait()

    async def send(message: guard_module.Message) -> None:
        sent.append(message)

    guard = guard_module.RequestGuard(lambda *_: None, guard_module.Access(None, frozenset()))
    asyncio.run(asyncio.wait_for(guard(scope, receive, send), PATIENCE / 2))
    assert (sent[0]["status"], sent[-1].get("more_body", False)) == (413, False)
