"""The daemon listening on SocketCAN at 250 Hz beside another host: share of a core of its two processes.

    scripts/with-vcan .venv/bin/python benchmarks/daemon_share.py [CHANNEL [SECONDS]]
    .venv/bin/python benchmarks/daemon_share.py outside [SECONDS]

`paced_cycle.py` is the host, the kernel answers for the seven nodes (echo_nodes.py): what is measured is the daemon,
frames to journal. Prints JSON. The kernel of user-mode-linux counts processor time by its ticks of 10 ms, which a
process that wakes by the clock meets too often or not at all: `outside` starts it and asks this machine's own kernel
what all of it takes, with the host alone and with the daemon beside it.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "calib"))

BEFORE, AFTER = 60.0, 20.0
"""The host runs for so long before, while the daemon starts, and after it was measured [s]."""
SETTLE = 5.0
"""After it observes: page and API are loaded too [s]."""


def processor_time(process: int) -> float:
    """User and system time of a process so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(channel: str = "vcan0", seconds: float = 40.0, phase: Path | None = None) -> int:
    """Measure for `seconds` and print the figures; `phase` is told the current phase, for `outside`."""
    from daemon_bench import good_records

    from armlink.arm_file import load_arm
    from calib.records.store import RecordStore
    from sim_bus.truth import Truth

    def tell(what: str) -> None:
        if phase is not None:
            phase.write_text(what)

    arm = load_arm("sarcos")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = RecordStore(str(folder / "records.db"))
        for record in good_records(arm, Truth.of(arm)):
            store.put(record, arm, by="benchmark", reason="to be watched")
        pace = [sys.executable, str(HERE / "paced_cycle.py"), channel, str(BEFORE + 2 * seconds + AFTER)]
        host = subprocess.Popen(pace, stdout=subprocess.DEVNULL, process_group=0)
        options = ["--bus", f"socketcan:{channel}", "--listen-only", "--store", str(folder / "records.db")]
        command = [str(Path(sys.executable).with_name("armlink")), "daemon", "sarcos", *options, "--state", name]
        time.sleep(BEFORE / 3)
        if phase is not None:
            tell("alone")
            time.sleep(seconds)
            tell("")
        daemon = subprocess.Popen(command, stderr=(folder / "log").open("wb"))
        try:
            started = _observing(daemon, folder)
            time.sleep(SETTLE)
            tell("both")
            print(json.dumps({"observing_after_s": started, **_measured(daemon, folder, seconds)}, indent=1))
            tell("")
        finally:
            daemon.terminate()
            os.killpg(host.pid, signal.SIGTERM)  # its nodes run in a separate process
            daemon.wait()
            host.wait()
    return 0


def outside(seconds: float = 40.0) -> int:
    """Run it in user-mode-linux and print the share of a core that it takes in each phase."""
    with tempfile.TemporaryDirectory() as name:
        phase, now, since = Path(name) / "phase", "", (0.0, 0.0)
        phase.write_text(now)
        inside = [sys.executable, __file__, "vcan0", str(seconds), str(phase)]
        kernel = subprocess.Popen([str(HERE.parent / "scripts" / "with-vcan"), *inside], stdout=subprocess.DEVNULL)
        shares: dict[str, float] = {}
        while kernel.poll() is None:
            told = phase.read_text()
            if told != now:
                at = time.monotonic(), sum(map(processor_time, _family(kernel.pid)))
                if now:
                    shares[now] = (at[1] - since[1]) / (at[0] - since[0])
                now, since = told, at
            time.sleep(0.05)
    if len(shares) < 2:
        raise SystemExit("the run inside ended early")
    print(json.dumps({**shares, "daemon": shares["both"] - shares["alone"]}, indent=1))
    return kernel.returncode


def _family(process: int) -> set[int]:
    """A process and its descendants."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    family = {process}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return family


def _observing(daemon: "subprocess.Popen[bytes]", folder: Path) -> float:
    """Time until it observes [s]."""
    began = time.monotonic()
    while time.monotonic() - began < BEFORE:
        try:
            if _status(folder)["state"] == "observing":
                return time.monotonic() - began
        except httpx.TransportError:
            if daemon.poll() is not None:
                break
        time.sleep(0.2)
    raise SystemExit((folder / "log").read_text())


def _status(folder: Path) -> dict[str, Any]:
    transport = httpx.HTTPTransport(uds=str(folder / "api.sock"))
    with httpx.Client(transport=transport, base_url="http://localhost", timeout=10.0) as asking:
        return dict(asking.get("/api/status").json())


def _measured(daemon: "subprocess.Popen[bytes]", folder: Path, seconds: float) -> dict[str, Any]:
    children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split()
    processes = {"main": daemon.pid, **{f"bus {k}": int(child) for k, child in enumerate(children)}}
    first, before, since = _status(folder), {k: processor_time(p) for k, p in processes.items()}, time.monotonic()
    time.sleep(seconds)
    elapsed, last = time.monotonic() - since, _status(folder)
    shares = {k: (processor_time(p) - before[k]) / elapsed for k, p in processes.items()}
    counted = {key: last["bus"][key] - first["bus"][key] for key in ("frames", "missed", "errors")}
    return {"core_share": shares, "state": last["state"], **counted, **last["bus"]}


if __name__ == "__main__":
    if sys.argv[1:2] == ["outside"]:
        sys.exit(outside(*map(float, sys.argv[2:3])))
    sys.exit(main(*sys.argv[1:2], *map(float, sys.argv[2:3]), *map(Path, sys.argv[3:4])))
