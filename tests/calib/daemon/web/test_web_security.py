"""Who gets in: the socket's mode under any umask, token, Host, origin, rate and size; nothing is answered with 5xx."""

import asyncio
import os
import socket
import stat
from pathlib import Path

import pytest
from made_up_view import MadeUpView
from served_page import TOKEN, Served, served

from armlink.errors import BadInput
from calib.daemon.rate_limit import MOST_KEYS, Rate, RateLimit
from calib.daemon.web import connection as connection_module
from calib.daemon.web import guard as guard_module
from calib.daemon.web.connection import PEER, Peer
from calib.daemon.web.guard import BODY_LIMIT, REQUESTS, WRONG_TOKENS, Access, RequestGuard
from calib.daemon.web.server import serve, unix_socket


@pytest.fixture(autouse=True)
def _no_rate(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests of other things are quicker than the rate limit."""
    monkeypatch.setattr(RateLimit, "take", lambda *_: 0.0) if "rate" not in request.node.name else None


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077, 0o777])
def test_the_socket_s_mode_is_right_under_any_umask(tmp_path: Path, umask: int) -> None:
    path, before = tmp_path / "api.sock", os.umask(umask)
    try:
        with unix_socket(path) as sock:
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
            with socket.socket(socket.AF_UNIX) as early, pytest.raises(ConnectionRefusedError):
                early.connect(str(path))  # it is bound, and nobody listens yet: there is no moment of a wrong mode
            sock.listen()
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
    finally:
        os.umask(before)
    assert not path.exists()


def test_the_mode_is_never_wider_than_asked_not_even_between_bind_and_chmod(tmp_path, monkeypatch) -> None:
    seen = []
    monkeypatch.setattr(Path, "chmod", lambda path, mode: seen.append((stat.S_IMODE(path.stat().st_mode), mode)))
    before = os.umask(0)
    try:
        with unix_socket(tmp_path / "api.sock"):
            pass
    finally:
        os.umask(before)
    assert seen == [(0o660, 0o660)]


def test_a_socket_left_by_a_killed_daemon_is_replaced_and_a_live_one_is_not(tmp_path: Path, server: Served) -> None:
    left = tmp_path / "left.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(left))
    with unix_socket(left):
        assert left.exists()
    with pytest.raises(BadInput, match="another daemon listens there"), unix_socket(server.path):
        pass
    assert server.client().get("/api/status").status_code == 200
    file = tmp_path / "notes.txt"
    file.write_text("keep me")
    with pytest.raises(BadInput, match="not a socket"), unix_socket(file):
        pass
    assert file.read_text() == "keep me"
    with pytest.raises(BadInput, match="--socket"), unix_socket(tmp_path / "missing" / "api.sock"):
        pass


@pytest.mark.parametrize("token", [None, "", "short"])
def test_tcp_without_a_proper_token_is_refused_at_the_start(token: str | None, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="token of at least 16"):
        asyncio.run(serve(MadeUpView(), socket=tmp_path / "api.sock", tcp=("127.0.0.1", 1), token=token))


@pytest.mark.parametrize(
    "header", [None, "", "Bearer", "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x", "Bearer é"]
)
def test_over_tcp_everything_but_the_page_needs_the_token(server: Served, header: str | None) -> None:
    client = server.tcp(token=None)
    headers = {} if header is None else {"Authorization": header.encode("latin-1")}
    paths = ["status", "overview", "joints", "estimates", "events", "history", "proposals", "stream", "report", "arm"]
    paths += ["external", "window", "window.csv", "window.mcap"]
    for path in [*(f"/api/{path}" for path in paths), "/metrics", "/openapi.json", "/nothing"]:
        answer = client.get(path, headers=headers)
        assert (path, answer.status_code) == (path, 401)
        assert answer.json().keys() == {"error"}
        assert answer.headers["www-authenticate"].startswith("Bearer")
    assert client.post("/api/proposals/1/approve", headers=headers).status_code == 401
    assert client.get("/").status_code == 200


def test_the_token_lets_in_over_tcp_and_is_not_asked_for_on_the_socket(server: Served) -> None:
    assert server.tcp().get("/api/status").status_code == 200
    assert server.client().get("/api/status").status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "10.9.8.7", "a b", "["]
)
def test_a_wrong_host_is_refused_on_both(server: Served, view: MadeUpView, host: str) -> None:
    server.do(view.propose)
    for client in (server.tcp(), server.client()):
        for path in ("/", "/api/status"):
            answer = client.get(path, headers={"Host": host})
            assert answer.status_code == 400
            assert "Host" in answer.json()["error"] or "HTTP" in answer.json()["error"]
        assert client.post("/api/proposals/1/approve", headers={"Host": host}).status_code == 400
    assert server.do(lambda: view.offered[0].state) == "pending"


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8080", "127.0.0.1", "127.0.0.1:1", "[::1]:8080"])
def test_loopback_s_names_are_right_on_loopback(server: Served, host: str) -> None:
    assert server.tcp().get("/api/status", headers={"Host": host}).status_code == 200


def test_a_page_of_another_origin_decides_nothing(server: Served, view: MadeUpView) -> None:
    server.do(view.propose)
    for client in (server.tcp(), server.client()):
        for origin in ("http://evil.example", "null", "http://localhost:1"):
            answer = client.post("/api/proposals/1/approve", headers={"Origin": origin, "Host": "localhost:8080"})
            assert answer.status_code == 403
    assert server.do(lambda: view.offered[0].state) == "pending"
    same = {"Origin": "http://localhost:8080", "Host": "localhost:8080"}
    assert server.client().post("/api/proposals/1/approve", headers=same).status_code == 200


def test_no_answer_invites_other_origins(server: Served) -> None:
    asking = {"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"}
    client = server.client()
    for answer in (client.get("/api/status", headers=asking), client.options("/api/status", headers=asking)):
        assert not [name for name in answer.headers if name.startswith("access-control-")]


def test_every_answer_says_what_a_browser_may_not_do_with_it(server: Served) -> None:
    client, stranger = server.client(), server.tcp(token=None)
    answers = [client.get(path) for path in ("/api/status", "/metrics", "/nothing", "/")]
    answers += [stranger.get("/api/status"), client.get("/api/status", headers={"Host": "evil.example"})]
    assert [answer.status_code for answer in answers] == [200, 200, 404, 200, 401, 400]
    for answer in answers:
        (policy,) = answer.headers.get_list("content-security-policy")
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cross-origin-opener-policy"] == "same-origin"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert answer.headers["cache-control"] == ("no-cache" if answer.url.path == "/" else "no-store")


def test_oversized_bodies_are_refused(server: Served, view: MadeUpView) -> None:
    server.do(view.propose)

    def chunks():
        for _ in range(10):
            yield b"x" * BODY_LIMIT

    for content in (b"x" * (BODY_LIMIT + 1), chunks()):
        answer = server.client().post("/api/proposals/1/approve", content=content)
        assert answer.status_code == 413
    assert server.do(lambda: view.offered[0].state) == "pending"


def exchange(server: Served, request: bytes) -> bytes:
    """What a raw connection gets back until it is closed."""
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(30)
        raw.connect(str(server.path))
        raw.sendall(request)
        raw.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: raw.recv(65536), b""))


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"\x00\x01\x02\r\n\r\n",
        b"GET /api/status\r\n\r\n",
        b"GET /api/status HTTP/1.1\r\n\r\n",
        b"GET /api/status HTTP/1.0\r\n\r\n",
        b"GET /api/status HTTP/1.1\r\nHost: localhost\r\nHost: evil\r\n\r\n",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 100_000 + b"\r\n\r\n",
        b"POST /api/proposals/1/approve HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"POST /api/proposals/1/approve HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999999\r\n\r\n",
        b"POST /api/proposals/1/approve HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        "GET /ü HTTP/1.1\r\nHost: localhost\r\n\r\n".encode(),
    ],
)
def test_malformed_requests_get_4xx(server: Served, view: MadeUpView, request_bytes: bytes) -> None:
    server.do(view.propose)
    answer = exchange(server, request_bytes)
    assert answer.startswith(b"HTTP/1.1 4"), answer[:200]
    assert server.do(lambda: view.offered[0].state) == "pending"
    assert server.client().get("/api/status").status_code == 200


def test_a_request_whose_body_ends_early_decides_nothing(server: Served, view: MadeUpView) -> None:
    server.do(view.propose)
    exchange(server, b"POST /api/proposals/1/approve HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n\r\n")
    assert server.client().get("/api/proposals").json()[0]["state"] == "pending"


@pytest.mark.parametrize("before", [b"", b"GET /nothing HTTP/1.1\r\nHost: localhost\r\n\r\n"], ids=["first", "second"])
@pytest.mark.parametrize("part", [b"", b"GET /api/status HTTP/1.1\r\nHost: local"], ids=["nothing", "half a head"])
def test_a_connection_that_sends_no_whole_request_is_cut(
    server: Served, monkeypatch: pytest.MonkeyPatch, before: bytes, part: bytes
) -> None:
    monkeypatch.setattr(connection_module, "PATIENCE_SECONDS", 0.2)
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(60)
        raw.connect(str(server.path))
        if before:
            raw.sendall(before)
            assert raw.recv(65536).startswith(b"HTTP/1.1 404")
        raw.sendall(part)
        try:
            rest = b"".join(iter(lambda: raw.recv(65536), b""))
        except ConnectionResetError:
            rest = b""
    assert b"HTTP/1.1" not in rest


def test_rate_limit_is_a_bucket_for_each_address() -> None:
    limit = RateLimit(Rate(burst=3, per_second=2))
    assert [limit.take("a", 0.0) for _ in range(4)] == [0, 0, 0, 0.5]
    assert limit.take("b", 0.0) == 0
    assert limit.take("a", 0.5) == 0
    assert limit.take("a", 0.5) > 0
    for number in range(2 * MOST_KEYS):
        limit.take(f"another {number}", 0.5)
    assert len(limit._buckets) == MOST_KEYS


def guarded(peer: Peer, times: int, headers: list[tuple[bytes, bytes]]) -> list[int]:
    """Status of so many requests at one moment."""
    statuses: list[int] = []

    async def app(scope, receive, send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def note(message) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])

    async def nothing():
        raise AssertionError("there is no body")

    async def run() -> None:
        guard = RequestGuard(app, Access(TOKEN, frozenset({"robot"}), now=lambda: 0.0))
        scope = {
            "type": "http",
            "method": "GET",
            "path": "/api/status",
            "query_string": b"",
            "headers": headers,
            "state": {PEER: peer},
        }
        for _ in range(times):
            await guard(scope, nothing, note)

    asyncio.run(run())
    return statuses


def test_rate_of_one_tcp_address_is_limited_and_that_of_the_socket_is_not() -> None:
    headers = [(b"host", b"robot"), (b"authorization", f"Bearer {TOKEN}".encode())]
    many = guarded(Peer("tcp", "192.0.2.1", tcp=True), int(REQUESTS.burst) + 5, headers)
    assert many == [200] * int(REQUESTS.burst) + [429] * 5
    assert guarded(Peer("ann", "", tcp=False), int(REQUESTS.burst) + 5, headers)[-1] == 200


def test_rate_of_wrong_tokens_is_limited_more() -> None:
    headers = [(b"host", b"robot"), (b"authorization", b"Bearer guess")]
    tries = guarded(Peer("tcp", "192.0.2.1", tcp=True), 10, headers)
    assert tries == [401] * int(WRONG_TOKENS.burst) + [429] * (10 - int(WRONG_TOKENS.burst))


def test_rate_limit_answers_over_a_real_connection(view: MadeUpView, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(guard_module, "REQUESTS", Rate(burst=3, per_second=1e-3))
    with served(MadeUpView, tmp_path / "api.sock") as server:
        answers = [server.tcp().get("/api/status") for _ in range(5)]
        assert [answer.status_code for answer in answers] == [200, 200, 200, 429, 429]
        assert int(answers[-1].headers["retry-after"]) > 0
        assert server.client().get("/api/status").status_code == 200


def test_the_token_is_compared_in_constant_time(monkeypatch) -> None:
    compared = []
    monkeypatch.setattr(guard_module.hmac, "compare_digest", lambda a, b: compared.append((a, b)) or True)
    headers = [(b"host", b"robot"), (b"authorization", b"Bearer x")]
    assert guarded(Peer("tcp", "192.0.2.1", tcp=True), 1, headers) == [200]
    assert compared == [(b"x", TOKEN.encode())]
