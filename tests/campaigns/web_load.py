"""Campaign: the real daemon under every kind of client at once, beside the same time without any.

python tests/campaigns/web_load.py [--arm sarcos] [--bus armlink_sim:sarcos] [--seconds 600] [--alone 120] [--fsync 10]

50 clients on the stream, 100 requests a second on the Unix socket, 10 readers that ask for the whole history and never
read (a new one for each that is cut), and 500 idle strangers on TCP (likewise). With --fsync each fsync of the daemon
takes so many seconds meanwhile (a C compiler is needed). Exit status 1 if cycles are late or lost beyond the rate
without clients, if one local answer in a hundred takes longer than 100 ms (500 ms with --fsync), if systemd waits
longer than 3 s of its 10 s for a sign of life, or if the daemon's processes grow by more than 50 MB.
"""

import argparse
import asyncio
import contextlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from slow_disk import SlowDisk, SystemdSocket
from web import counters, cpu_seconds, free_port, start

from armlink.arm_file import load_arm
from calib.daemon.state.journal import Journal

STREAMS, READERS, STRANGERS = 50, 10, 500
REQUESTS, WORKERS = 100.0, 20
"""Requests a second, on this many connections."""
DAYS = 30
P99, P99_OF_A_SLOW_DISK, GROWTH, SIGN_OF_LIFE = 0.1, 0.5, 50e6, 3.0
"""Bounds: of a local answer [s], likewise with --fsync, of the memory [bytes], between two signs of life [s]."""
ENDING = 60.0
"""A daemon that has not ended this long after SIGTERM is killed [s]."""
LATEST = 5.0
"""A client that is further behind at the end gives up [s]."""
AGAIN = 10.0
"""After this a stranger that was cut comes back [s]."""
SPREAD = 3.0
"""Standard deviations by which a count of late cycles may exceed what it was without clients."""
PATHS = ("/api/status", "/api/joints", "/api/estimates", "/api/events?limit=20", "/api/proposals", "/metrics")
"""Answers with history in them are long: of those 16 are under way at once, and the next client gets 429."""
ITEM = b"event: joints"
LONG = "/api/history?limit=20000"


def request(path: str) -> bytes:
    """As a client on the Unix socket sends it."""
    return f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()


def memory(process: int) -> float:
    """Resident bytes of a process and its children."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    total = 0.0
    for each in (str(process), *children):
        with contextlib.suppress(OSError):
            total += int(Path(f"/proc/{each}/statm").read_text().split()[1]) * resource.getpagesize()
    return total


async def ask(socket: Path, end: float, took: list[tuple[float, float]], answers: Counter[str]) -> None:
    """Requests in their turn until the end, each at its time; how long each took since it was due, and was sent [s]."""
    every, number = WORKERS / REQUESTS, 0
    due, reader, writer = time.monotonic(), None, None
    while (due := due + every) < end and time.monotonic() < end + LATEST:
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        number += 1
        path = PATHS[number % len(PATHS)]
        while True:
            if reader is None or writer is None:
                reader, writer = await asyncio.open_unix_connection(str(socket))
            sent = time.monotonic()
            try:
                writer.write(request(path))
                status = await answered(reader)
                break
            except (asyncio.IncompleteReadError, ConnectionError):  # it was idle for too long: this client is late
                writer.transport.abort()
                reader, writer = None, None
                answers["again"] += 1
        answers["200" if status == 200 else f"{status} {path}"] += 1
        took.append((time.monotonic() - due, time.monotonic() - sent))
    if writer is not None:
        writer.close()


def ask_all(socket: Path, seconds: float) -> dict[str, Any]:
    """All requests, in a process that does nothing else; what the answers took."""
    took, answers = list[tuple[float, float]](), Counter[str]()

    async def run() -> None:
        end = time.monotonic() + seconds
        await asyncio.gather(*(ask(socket, end, took, answers) for _ in range(WORKERS)))

    spent = time.process_time()
    asyncio.run(run())
    due, sent = sorted(each for each, _ in took), sorted(each for _, each in took)
    middle, last = len(took) // 2, int(0.99 * len(took))
    return {
        "requests": len(took),
        "answers": dict(answers),
        "median_ms": 1e3 * due[middle],
        "p99_ms": 1e3 * due[last],
        "worst_ms": 1e3 * due[-1],
        "p99_since_sent_ms": 1e3 * sent[last],
        "client_cpu_share": (time.process_time() - spent) / seconds,
    }


async def answered(reader: asyncio.StreamReader) -> int:
    """The status of the next answer, whose body is read."""
    head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
    if "transfer-encoding: chunked" in head:
        while size := int(await reader.readline(), 16):
            await reader.readexactly(size + 2)
        await reader.readline()
    else:
        await reader.readexactly(int(head.partition("content-length:")[2].split()[0]))
    return int(head.split()[1])


async def never_read(socket: Path, end: float, cut: Counter[str]) -> None:
    """Ask for much, read nothing, until the server closes; then again."""
    while time.monotonic() < end:
        _, writer = await asyncio.open_unix_connection(str(socket), limit=1)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(request(LONG) * 20)
        for _ in range(int(max(1.0, min(30.0, end - time.monotonic())))):
            await asyncio.sleep(1.0)
            with contextlib.suppress(ConnectionError):
                writer.write(request("/api/status"))
                await asyncio.wait_for(writer.drain(), 0.01)
                continue
            cut["readers"] += 1
            break
        writer.transport.abort()


async def idle(port: int, end: float, cut: Counter[str]) -> None:
    """Say nothing on TCP; another one some seconds after the server has cut it."""
    while (left := end - time.monotonic()) > 0:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            with contextlib.suppress(TimeoutError, ConnectionError):
                await asyncio.wait_for(reader.read(1), left)
            writer.transport.abort()
        except OSError:
            pass
        cut["strangers"] += 1
        await asyncio.sleep(min(AGAIN, max(0.0, end - time.monotonic())))


async def stream(socket: Path, end: float) -> int:
    """A client of the stream; how many joints items it got."""
    reader, writer = await asyncio.open_unix_connection(str(socket), limit=1 << 20)
    writer.write(request("/api/stream"))
    count, rest = 0, b""
    with contextlib.suppress(TimeoutError):
        while content := await asyncio.wait_for(reader.read(1 << 16), max(0.0, end - time.monotonic())):
            content = rest + content
            count += content.count(ITEM)
            rest = content[-len(ITEM) + 1 :]
    writer.close()
    return count


async def crowd(folder: Path, port: int, seconds: float, process: int) -> dict[str, Any]:
    """Everybody at once for so long."""
    socket, end = folder / "api.sock", time.monotonic() + seconds
    cut, grown = Counter[str](), [memory(process)]

    async def weigh() -> None:
        while time.monotonic() < end:
            grown.append(memory(process))
            await asyncio.sleep(1.0)

    command = [sys.executable, __file__, "--ask", str(socket), "--seconds", str(seconds)]
    asking = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    others = [never_read(socket, end, cut) for _ in range(READERS)]
    others += [idle(port, end, cut) for _ in range(STRANGERS)]
    streams = asyncio.gather(*(stream(socket, end) for _ in range(STREAMS)))
    items, (said, _), *_ = await asyncio.gather(streams, asking.communicate(), weigh(), *others)
    return {
        **json.loads(said),
        "stream_items_least": min(items),
        "cut": dict(cut),
        "memory_mb": [round(each / 1e6, 1) for each in (grown[0], max(grown), grown[-1])],
    }


def month_of_history(folder: Path) -> None:
    """What a daemon has after 30 days: long answers for those that do not read."""
    values = [1.0] * len(load_arm("sarcos").joint_names)
    estimate = dict.fromkeys(("gain", "gain_std", "offset", "offset_std"), values)
    journal = Journal(folder / "journal.db", time.monotonic, lambda work, done: done(work()))
    now = datetime.now(UTC)
    with journal.transaction():
        for minute in range(DAYS * 1440):
            journal.add_history(now - timedelta(minutes=DAYS * 1440 - minute), 60.0 * minute, None, estimate)
    journal.close()


def counted(folder: Path, process: int, work: Any) -> dict[str, Any]:
    """What `work` returns, with the bus's counters over its time."""
    before, spent, began = counters(folder), cpu_seconds(process), time.monotonic()
    found = dict(work() or {})
    seconds = time.monotonic() - began
    after = counters(folder)
    rise = {key: after[key] - before[key] for key in ("frames", "missed", "late", "errors")}
    return {"seconds": seconds, **rise, "cpu_share": (cpu_seconds(process) - spent) / seconds, **found}


def beyond(alone: dict[str, Any], busy: dict[str, Any], key: str) -> bool:
    """Whether a count is higher than its rate without clients explains."""
    expected = alone[key] / alone["seconds"] * busy["seconds"]
    return bool(busy[key] > expected + SPREAD * (expected + alone[key] + 1.0) ** 0.5)


def told(alone: dict[str, Any], busy: dict[str, Any]) -> None:
    """All of it in one paragraph."""
    first, most, last = busy["memory_mb"]
    print(
        f"{STREAMS} streams, {REQUESTS:g} requests/s, {READERS} readers that never read, {STRANGERS} idle strangers, "
        f"{busy['seconds']:.0f} s: {busy['late']} late and {busy['missed']} lost cycles, {alone['late']} and "
        f"{alone['missed']} in {alone['seconds']:.0f} s without; {busy['requests']} answers, median "
        f"{busy['median_ms']:.1f} ms, p99 {busy['p99_ms']:.1f} ms ({busy['p99_since_sent_ms']:.1f} ms since sent), "
        f"worst {busy['worst_ms']:.0f} ms; memory {first:g} MB, {most:g} at most, {last:g} at the end; the daemon used "
        f"{busy['cpu_share']:.2f} of a processor, {alone['cpu_share']:.2f} without, the client that asks "
        f"{busy['client_cpu_share']:.2f}; the longest time without a sign of life {busy['sign_of_life_s']:.2f} s; "
        f"ended within {busy['ended_s']:.1f} s."
    )


def main() -> int:
    """Run it all; print one JSON object and one paragraph."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="sarcos")
    parser.add_argument("--bus", default="armlink_sim:sarcos")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--alone", type=float, default=120.0)
    parser.add_argument("--fsync", type=float, default=0.0, help="what each fsync takes longer under load [s]")
    parser.add_argument("--ask", type=Path, metavar="SOCKET", help="only the requests; their times as JSON")
    given = parser.parse_args()
    if given.ask:
        print(json.dumps(ask_all(given.ask, given.seconds)))
        return 0
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        month_of_history(folder)
        systemd, disk = SystemdSocket(folder), SlowDisk(folder) if given.fsync else None
        environment = systemd.environment | (disk.environment if disk else {})
        daemon = start(given.arm, given.bus, folder, port, environment=environment)
        try:
            time.sleep(10.0)
            alone = counted(folder, daemon.pid, lambda: time.sleep(given.alone))
            if disk is not None:
                disk.seconds(given.fsync)
            begun = time.monotonic()
            busy = counted(folder, daemon.pid, lambda: asyncio.run(crowd(folder, port, given.seconds, daemon.pid)))
            busy["sign_of_life_s"] = systemd.longest_gap(begun, time.monotonic())
        finally:
            ending = time.monotonic()
            daemon.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(ENDING)
            ended_s = time.monotonic() - ending
            daemon.kill()
    busy["ended_s"] = ended_s
    print(json.dumps({"alone": alone, "busy": busy}, indent=1))
    first, most, _ = busy["memory_mb"]
    wrong = [key for key in ("missed", "late", "errors") if beyond(alone, busy, key)]
    wrong += ["p99"] * (busy["p99_ms"] > 1e3 * (P99_OF_A_SLOW_DISK if given.fsync else P99))
    wrong += ["sign of life"] * (busy["sign_of_life_s"] > SIGN_OF_LIFE)
    wrong += ["end"] * (busy["ended_s"] >= ENDING)
    wrong += ["memory"] * ((most - first) * 1e6 > GROWTH)
    wrong += ["answers"] * (not set(busy["answers"]) <= {"200", "again"})
    told(alone, busy)
    print("out of bounds:", ", ".join(wrong) or "nothing", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
