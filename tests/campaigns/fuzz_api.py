"""Campaign: hostile HTTP to the API of a whole daemon, raw and by the API's own description.

python tests/campaigns/fuzz_api.py [--seconds 3600] [--seed 0]

Half of the processor time goes to raw requests: broken heads, odd methods, targets and versions, chunked and false
lengths, pipelines, halves, wrong tokens, any bytes; half to requests that schemathesis makes. Exit status 1 for an
answer 5xx or none that is HTTP, a traceback in the log, a sound request that is not answered, something told without
the token, a decision made without it, or memory that grows by more than 200 MB. It is noted in `fuzz_runs.jsonl`.
"""

import argparse
import logging
import random
import re
import socket
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1] / "calib"))
sys.path.insert(0, str(Path(__file__).parents[1] / "calib" / "daemon" / "web"))

import numpy as np
from daemon_bench import DaemonBench
from fuzz_journal import for_seconds, memory
from fuzz_mutators import mutated_bytes
from served_page import TOKEN, Served, served
from small_arm import small_arm
from test_web_schema import SETTINGS, check_all

from calib.daemon.rate_limit import RateLimit
from calib.daemon.service_view import ServiceView
from calib.daemon.web import connection
from calib.observer.decision import DriftFinding

A_GO, EXAMPLES, GROWTH = 100, 5, 200.0
"""Raw requests and examples of each route between two looks at the clock; growth of memory [MB]."""
SERIAL = b"SIM-0003"
"""What nobody is told without the token."""
ROUTES = ("status", "overview", "joints", "estimates", "events", "history", "proposals", "arm", "window", "window.csv")
ROUTES += ("window.mcap", "report", "stream", "proposals/1/approve", "proposals/2/reject")
PATHS = (*(f"/api/{route}" for route in ROUTES), "/metrics", "/openapi.json", "/", "/static/page.js", "*", "//", "")
METHODS = ("GET", "GET", "GET", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "get", "G\0T")
VALUES = ("", "0", "-1", "1e999", "nan", "9" * 5000, "%00", "%zz", "..%2f..%2fetc%2fpasswd", "é", "a" * 70_000, "1;2")
VALUES += ("2026-01-01T00:00:00Z", "9999-12-31T23:59:59+14:00", "0001-01-01T00:00:00-14:00", "[]", "true", "elbow")
KEYS = ("limit", "after", "since", "until", "joint", "seconds", "most", "rows", "x", "")
TOKENS = (f"Bearer {TOKEN}", "Bearer wrong", "Bearer", "", "Basic YTpi", f"bearer  {TOKEN} ", "Bearer " + "a" * 9000)
HEADERS = (
    *(
        "Connection: close",
        "Connection: keep-alive, upgrade",
        "Upgrade: websocket",
        "Upgrade: h2c",
        "Expect: 100-continue",
    ),
    *("Content-Length: 0", "Content-Length: 10", "Content-Length: -1", "Content-Length: 5, 5", "Content-Length: 9e9"),
    *("Transfer-Encoding: chunked", "Transfer-Encoding: gzip, chunked", "Transfer-Encoding: chunked, identity"),
    *(
        "Range: bytes=0-1",
        "Accept-Encoding: gzip",
        "Origin: http://evil",
        "Sec-Fetch-Site: cross-site",
        "Last-Event-ID: x",
    ),
    *("Host: evil", "Host: localhost:99999", "X", ": x", " folded", "X:\0", "X: \xff", "Cookie: " + "a=b; " * 2000),
    *(
        "Content-Type: application/json",
        "Content-Type: \u2028",
        "X-Forwarded-For: 127.0.0.1",
        "Last-Event-ID: 99999999999",
    ),
)
BODIES = (b"", b"{}", b"[" * 5000, b'{"by": "' + b"a" * 3000 + b'"}', b"\xff\xfe", b"x" * 70_000)
CHUNKS = (
    b"5\r\nhello\r\n0\r\n\r\n",
    b"0\r\n\r\n",
    b"zz\r\n",
    b"fffffffffffffffff\r\n",
    b"5;a=b\r\nhello\r\n0\r\nX: y\r\n\r\n",
)


def request(draw: random.Random) -> bytes:
    """One request, more or less."""
    if draw.random() < 0.4:
        asked = f"/api/{draw.choice(ROUTES)}?{draw.choice(KEYS)}={draw.choice(VALUES)}"
        return f"GET {asked} HTTP/1.1\r\nHost: localhost\r\nAuthorization: {TOKENS[0]}\r\n\r\n".encode("latin-1")
    path = draw.choice(PATHS)
    if draw.random() < 0.2:
        path = draw.choice([f"http://evil{path}", path + "/", path.upper(), path.replace("1", draw.choice(VALUES))])
    if draw.random() < 0.5:
        asked = [f"{draw.choice(KEYS)}={draw.choice(VALUES)}" for _ in range(draw.choice([1, 2, 5]))]
        path += "?" + draw.choice("&&;").join(asked)
    version = draw.choice(["HTTP/1.1"] * 8 + ["HTTP/1.0", "HTTP/2.0", "HTTP/1.1x", ""])
    lines = [f"{draw.choice(METHODS)} {path} {version}"]
    lines += ["Host: localhost"] * (draw.random() < 0.9) + [f"Authorization: {draw.choice(TOKENS)}"] * draw.choice(
        [0, 1, 1, 2]
    )
    lines += draw.sample(HEADERS, draw.choice([0, 1, 1, 2, 4]))
    end = draw.choice(["\r\n"] * 9 + ["\n"])
    body = draw.choice(BODIES if draw.random() < 0.5 else CHUNKS) if draw.random() < 0.4 else b""
    return (end.join(lines) + end + end).encode("latin-1", "replace") + body


def hostile(draw: random.Random) -> bytes:
    """What a connection sends: one request or several, whole, cut or spoilt."""
    sent = b"".join(request(draw) for _ in range(draw.choice([1, 1, 1, 2, 5, 30])))
    kind = draw.random()
    if kind < 0.2:
        return mutated_bytes(sent, draw)
    if kind < 0.3:
        return sent[: draw.randrange(len(sent))]
    return draw.randbytes(draw.randrange(300)) if kind < 0.33 else sent


def exchange(server: Served, sent: bytes, tcp: bool, draw: random.Random) -> bytes:
    """What comes back until the connection is closed, at most a megabyte; often the client does not wait for it."""
    client = socket.create_connection(("127.0.0.1", server.port)) if tcp else socket.socket(socket.AF_UNIX)
    with client:
        client.settimeout(30)
        if not tcp:
            client.connect(str(server.path))
        answer = b""
        try:
            client.sendall(sent)
            if draw.random() < 0.1:
                return b""
            client.shutdown(socket.SHUT_WR)
            while len(answer) < 1 << 20 and b"text/event-stream" not in answer:
                if not (piece := client.recv(1 << 16)):
                    break
                answer += piece
        except TimeoutError:
            Path("fuzz-corpus-api.http").write_bytes(sent)
            raise AssertionError(f"nothing for 30 s: {len(answer)} bytes answered, {sent[:300]!r}") from None
        except OSError:  # cut
            pass
    return answer


def statuses(sent: bytes, answer: bytes, tcp: bool) -> list[str]:
    """Status and first words of each answer. Raises AssertionError for one that must not be."""
    assert not answer or answer.startswith(b"HTTP/1.1 "), (sent[:300], answer[:200])
    found = re.findall(rb"(?:^|\r\n|\})HTTP/1\.1 (\d{3} [^\r]*)", answer)
    assert all(status < b"500" for status in found), (sent[:500], answer[:500])
    assert not (tcp and TOKEN.encode() not in sent and SERIAL in answer), (sent[:500], answer[:500])
    return [status.decode("latin-1") for status in found]


class Tracebacks(logging.Handler):
    """Keeps what is logged with a traceback."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1] is not None:
            self.seen.append(f"{record.getMessage()}: {record.exc_info[1]!r}"[:300])


def raw(server: Served, seed: int, told: Tracebacks) -> dict[str, int]:
    """A go of raw requests; answers by status."""
    draw, found = random.Random(seed), Counter[str]()
    for _ in range(A_GO):
        sent, tcp = hostile(draw), draw.random() < 0.5
        answer = exchange(server, sent, tcp, draw)
        found["connections"] += 1
        for status in statuses(sent, answer, tcp):
            found[f"{status[0]}xx"] += 1
        assert not told.seen, (sent[:500], told.seen)
    with server.client() as sound:
        assert sound.get("/api/status").status_code == 200
    return dict(found)


def described(server: Served, seed: int, told: Tracebacks) -> dict[str, int]:
    """A go of requests by the API's description."""
    random.seed(seed)
    routes = check_all(server, type(SETTINGS)(SETTINGS, max_examples=EXAMPLES, derandomize=False))
    assert not told.seen, told.seen
    return {"routes": len(routes), "examples": 2 * EXAMPLES * len(routes)}


def begin(folder: Path) -> ServiceView:
    """A daemon that has observed for a while, with proposals."""
    bench = DaemonBench(folder, small_arm())
    bench.run(3.0)
    for joint in ("base", "elbow"):
        finding = DriftFinding(2, "drift", 1.02, 0.1, np.diag([1e-6, 1e-4]), 40, 0.99)
        bench.service.journal.add_proposal(bench.wall(), joint, "ab" * 4, "cd" * 4, finding)
    for _ in range(20):
        bench.service.save(history=True)
        bench.service.events.say("drift", "elbow", "gain", {"value": float("inf")})
    return bench.view


def main() -> int:
    """Fuzz both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    told = Tracebacks()
    logging.getLogger().handlers, logging.getLogger().propagate = [told], False
    RateLimit.take = lambda *_: 0.0  # type: ignore[method-assign, assignment]
    connection.PATIENCE_SECONDS = 0.5
    ways = {"api raw": raw, "api by its description": described}
    folder = tempfile.TemporaryDirectory()
    with folder as name, served(lambda: begin(Path(name)), Path(name) / "api.sock") as server:
        for run in ways.values():  # what is imported for the first time is no growth
            run(server, given.seed, told)
        before = memory()
        for kind, run in ways.items():
            for_seconds(kind, given.seconds / 2, given.seed, lambda seed, run=run: run(server, seed, told))
    grown = memory() - before
    if grown > GROWTH:
        print(f"FAILED: memory grew by {grown:.0f} MB")
    return int(grown > GROWTH)


if __name__ == "__main__":
    sys.exit(main())
