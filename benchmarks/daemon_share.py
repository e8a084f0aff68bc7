"""The daemon listening on SocketCAN at 250 Hz beside another host: share of a core of its two processes.

    scripts/with-vcan .venv/bin/python benchmarks/daemon_share.py [CHANNEL [SECONDS]]

`paced_cycle.py` is the host, the kernel answers for the seven nodes (echo_nodes.py): what is measured is the daemon,
frames to journal. Prints JSON.
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


def processor_time(process: int) -> float:
    """User and system time of a process so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(channel: str = "vcan0", seconds: float = 40.0) -> int:
    """Measure for so many seconds and print the figures."""
    from daemon_bench import good_records

    from armlink.armfile import load_arm
    from calib.store import RecordStore
    from sim_bus.truth import Truth

    arm = load_arm("sarcos")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = RecordStore(str(folder / "records.db"))
        for record in good_records(arm, Truth.of(arm)):
            store.put(record, arm, by="benchmark", reason="to be watched")
        pace = [sys.executable, str(HERE / "paced_cycle.py"), channel, str(BEFORE + seconds + AFTER)]
        host = subprocess.Popen(pace, stdout=subprocess.DEVNULL, process_group=0)
        options = ["--bus", f"socketcan:{channel}", "--listen-only", "--store", str(folder / "records.db")]
        command = [str(Path(sys.executable).with_name("armlink")), "daemon", "sarcos", *options, "--state", name]
        time.sleep(BEFORE / 3)
        daemon = subprocess.Popen(command, stderr=(folder / "log").open("wb"))
        try:
            print(json.dumps(_measured(daemon, folder, seconds), indent=1))
        finally:
            daemon.terminate()
            os.killpg(host.pid, signal.SIGTERM)  # its nodes are a process of their own
            daemon.wait()
            host.wait()
    return 0


def _measured(daemon: "subprocess.Popen[bytes]", folder: Path, seconds: float) -> dict[str, Any]:
    began = time.monotonic()
    with httpx.Client(
        transport=httpx.HTTPTransport(uds=str(folder / "api.sock")), base_url="http://localhost"
    ) as asking:

        def status() -> dict[str, Any]:
            answer: dict[str, Any] = asking.get("/api/status", timeout=10.0).json()
            return answer

        while True:
            try:
                if status()["state"] == "observing":
                    break
            except httpx.TransportError:
                if daemon.poll() is not None or time.monotonic() - began > BEFORE:
                    raise SystemExit((folder / "log").read_text()) from None
            time.sleep(0.2)
        started = time.monotonic() - began
        children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split()
        processes = {"main": daemon.pid, **{f"bus {k}": int(child) for k, child in enumerate(children)}}
        first, before, since = status(), {k: processor_time(p) for k, p in processes.items()}, time.monotonic()
        time.sleep(seconds)
        elapsed, last = time.monotonic() - since, status()
        shares = {k: (processor_time(p) - before[k]) / elapsed for k, p in processes.items()}
    counted = {key: last["bus"][key] - first["bus"][key] for key in ("frames", "missed", "errors")}
    return {"observing_after_s": started, "core_share": shares, "state": last["state"], **counted, **last["bus"]}


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2], *(float(each) for each in sys.argv[2:])))
