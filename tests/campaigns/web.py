"""Campaign: the real daemon with many clients on its stream, the page's load time, generated requests at length.

python tests/campaigns/web.py [--arm sarcos] [--bus armlink_sim:sarcos] [--clients 50] [--seconds 30] [--examples 200]
Exit status 1 if a bound fails. On real SocketCAN: scripts/with-vcan, with --bus socketcan:vcan0 --kernel-nodes (the
kernel answers for nodes that hold still, since a user-mode kernel has one slow processor), --no-page --examples 0.
"""

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import httpx
import yaml

TESTS = Path(__file__).parent.parent
sys.path[:0] = [str(TESTS / "calib" / "daemon" / "web"), str(TESTS / "calib")]

LOAD_SECONDS = 1.0
"""A page must show its numbers by then."""
LOADS = 7


def free_port() -> int:
    """A TCP port of loopback that nobody listens on."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start(
    arm: str,
    bus: str,
    folder: Path,
    port: int,
    work: bool = True,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> "subprocess.Popen[bytes]":
    """`armlink daemon` with records of a good sweep, on the Unix socket and on TCP; returns when it observes.

    `environment` comes on top of this process's own.
    """
    from daemon_bench import good_records

    from armlink.arm_file import load_arm
    from calib.records.store import RecordStore
    from sim_bus.truth import Truth

    described = load_arm(arm)
    store = RecordStore(str(folder / "records.db"))
    for record in good_records(described, Truth.of(described)):
        store.put(record, described, by="campaign", reason="sweep")
    (folder / "token").write_text("campaign-token-0123456789")
    options = ["--work"] if work else []
    options += ["--bus", bus, "--state", str(folder), "--store", str(folder / "records.db")]
    options += ["--tcp", f"127.0.0.1:{port}", "--token-file", str(folder / "token")]
    command = [str(Path(sys.executable).with_name("armlink")), "daemon", arm, *options]
    daemon = subprocess.Popen(command, stderr=(folder / "log").open("wb"), env={**os.environ, **environment})
    with client(folder) as asking:
        while daemon.poll() is None:
            try:
                if asking.get("/api/status").json()["state"] == "observing":
                    return daemon
            except httpx.TransportError:
                pass
            time.sleep(0.2)
    raise SystemExit(f"the daemon ended: {(folder / 'log').read_text()}")


@contextlib.contextmanager
def kernel_nodes(bus: str, folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """Nodes on SocketCAN that cost next to nothing, which hold still: their arm's file, and what to call once it is
    driven, from when on the kernel answers each SYNC for them."""
    sys.path.insert(0, str(TESTS.parent / "benchmarks"))
    from echo_nodes import answer_in_kernel, remove_gateway, start_nodes

    from armlink.arm_file import load_arm

    channel = bus.partition(":")[2]
    content = yaml.safe_load(load_arm("sarcos").path.read_text())
    content["link"]["deadline"] = 10.0
    for joint in content["link"]["joints"]:
        joint |= {"rated_torque": 40.0, "max_torque": 30.0}
    (folder / "sarcos.yaml").write_text(yaml.safe_dump(content))
    nodes = start_nodes(channel)

    def take_over() -> None:
        if not answer_in_kernel(channel):
            print("this kernel has no can-gw: a process answers for the nodes", file=sys.stderr)

    try:
        yield str(folder / "sarcos.yaml"), take_over
    finally:
        nodes.terminate()
        with contextlib.suppress(OSError):
            remove_gateway()


def client(folder: Path) -> httpx.Client:
    """On the daemon's Unix socket."""
    transport = httpx.HTTPTransport(uds=str(folder / "api.sock"))
    return httpx.Client(transport=transport, base_url="http://localhost", timeout=30)


def counters(folder: Path) -> dict[str, Any]:
    """The bus as the loop counts it."""
    with client(folder) as asking:
        return dict(asking.get("/api/status").json()["bus"])


def cpu_seconds(process: int) -> float:
    """CPU that a process and its children have used so far [s]."""
    ticks, total = os.sysconf("SC_CLK_TCK"), 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(stat.parent.name) == process or int(fields[1]) == process:
            total += (int(fields[11]) + int(fields[12])) / ticks
    return total


async def listen(folder: Path, clients: int, seconds: float) -> list[int]:
    """So many clients on the stream; how many joints items each one got."""

    async def read() -> int:
        reader, writer = await asyncio.open_unix_connection(str(folder / "api.sock"))
        writer.write(b"GET /api/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")
        count = 0
        try:
            async with asyncio.timeout(seconds):
                while line := await reader.readline():
                    count += line.startswith(b"event: joints")
        except TimeoutError:
            pass
        writer.close()
        return count

    return list(await asyncio.gather(*(read() for _ in range(clients))))


def stream(folder: Path, process: int, clients: int, seconds: float) -> dict[str, Any]:
    """Counters of the bus over a time without clients, and over as long with them."""
    found: dict[str, Any] = {}
    for name, number in (("alone", 0), ("with_clients", clients)):
        before, spent = counters(folder), cpu_seconds(process)
        items = asyncio.run(listen(folder, number, seconds)) if number else []
        if not number:
            time.sleep(seconds)
        after = counters(folder)
        rise = {key: after[key] - before[key] for key in ("frames", "missed", "late", "errors")}
        found[name] = {**rise, "cpu_share": (cpu_seconds(process) - spent) / seconds}
        if items:
            found[name] |= {"clients": number, "items_least": min(items), "items_most": max(items)}
    return found


def page(port: int, token: str) -> dict[str, Any]:
    """Time until the page shows all its numbers, by Chromium's own clock, token already known [s]."""
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        return {"skipped": "no Chromium"}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        shown = []
        for _ in range(LOADS):
            context = browser.new_context()
            context.add_init_script(f"localStorage.setItem('armlink-token', '{token}')")
            tab = context.new_page()
            tab.goto(f"http://127.0.0.1:{port}/")
            tab.wait_for_selector("body[data-shown]")
            shown.append(float(tab.get_attribute("body", "data-shown") or "nan") / 1000)
            context.close()
            time.sleep(0.5)
        browser.close()
    return {"median_s": statistics.median(shown), "worst_s": max(shown), "loads": LOADS}


def requests(examples: int) -> dict[str, Any]:
    """schemathesis at length; what it found wrong."""
    from made_up_view import MadeUpView
    from served_page import served
    from test_web_schema import SETTINGS, check_all

    from calib.daemon.rate_limit import RateLimit

    RateLimit.take = lambda *_: 0.0  # type: ignore[method-assign, assignment]
    view = MadeUpView()
    view.propose()
    with tempfile.TemporaryDirectory() as folder, served(lambda: view, Path(folder) / "api.sock") as server:
        try:
            checked = check_all(server, type(SETTINGS)(SETTINGS, max_examples=examples))
        except BaseExceptionGroup as group:
            return {"failed": str(group.exceptions[0])}
        except Exception as error:
            return {"failed": str(error)}
    return {"routes": len(checked), "examples_each": examples}


def main() -> int:
    """Run it all and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arm", default="sarcos")
    parser.add_argument("--bus", default="armlink_sim:sarcos")
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--examples", type=int, default=200)
    parser.add_argument("--kernel-nodes", action="store_true")
    parser.add_argument("--no-page", action="store_true")
    given = parser.parse_args()
    with contextlib.ExitStack() as there:
        folder, port = Path(there.enter_context(tempfile.TemporaryDirectory())), free_port()
        arm, take_over = given.arm, None
        if given.kernel_nodes:
            arm, take_over = there.enter_context(kernel_nodes(given.bus, folder))
        daemon = start(arm, given.bus, folder, port, work=not given.kernel_nodes)
        if take_over is not None:
            take_over()
        try:
            found = {
                "page": {} if given.no_page else page(port, (folder / "token").read_text()),
                "stream": stream(folder, daemon.pid, given.clients, given.seconds),
            }
        finally:
            daemon.terminate()
            daemon.wait(30)
    if given.examples:
        found["requests"] = requests(given.examples)
    print(json.dumps(found, indent=1))
    busy = found["stream"]["with_clients"]
    wrong = [key for key in ("missed", "late", "errors") if busy[key] > found["stream"]["alone"][key]]
    wrong += ["items"] if busy["items_least"] < 8 * given.seconds else []
    wrong += ["page"] if found["page"].get("median_s", 0.0) > LOAD_SECONDS else []
    wrong += ["requests"] if "failed" in found.get("requests", {}) else []
    print("out of bounds:", ", ".join(wrong) or "nothing", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
