"""Run by systemd_units.py as root under a systemd of its own: what that does with the units of packaging/, as JSON."""

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import time
from pathlib import Path

GUARD, DAEMON = "armlink-guard@bench", "armlink@bench"
FRAME = struct.Struct("=IB3x8s")
SHORTER = {"TimeoutAbortSec": "2"}
"""Of the unit's times: a process that is stopped does not take its SIGABRT, and is killed after this."""


def systemctl(*words: str) -> str:
    return subprocess.run(["systemctl", *words], check=True, capture_output=True, text=True).stdout.strip()


def shown(unit: str, name: str) -> str:
    return systemctl("show", "--value", "-p", name, unit)


def until(unit: str, restarts: int, seconds: float = 90.0) -> int:
    """Its process once it has been restarted so often and is active again."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if int(shown(unit, "NRestarts")) >= restarts and shown(unit, "ActiveState") == "active":
            return int(shown(unit, "MainPID"))
        time.sleep(0.2)
    raise SystemExit(f"{unit}: not active after {restarts} restarts:\n{journal(unit)}")


def journal(unit: str) -> str:
    command = ["journalctl", "--no-pager", "-o", "cat", "-u", unit]
    return subprocess.run(command, check=False, capture_output=True, text=True).stdout


def cgroup(unit: str, name: str) -> str:
    return Path(f"/sys/fs/cgroup{shown(unit, 'ControlGroup')}/{name}").read_text().strip()


def writes(process: int, path: str) -> bool:
    """Whether a file can be made where this process lives."""
    command = ["nsenter", "-t", str(process), "-m", "touch", path]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def can(interface: str) -> socket.socket:
    port = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    port.bind((interface,))
    port.settimeout(1.0)
    return port


def heard(port: socket.socket) -> list[int]:
    """Identifiers that come within a second."""
    found = []
    with contextlib.suppress(TimeoutError):
        while True:
            found.append(FRAME.unpack(port.recv(16))[0])
    return found


def passes(program: socket.socket, wire: socket.socket) -> list[int]:
    """What comes through of a SYNC, once anything does: the guard takes a while to start."""
    for _ in range(30):
        program.send(FRAME.pack(0x80, 0, b""))
        found = heard(wire)
        if found:
            return found
    return []


def guard() -> dict[str, object]:
    systemctl("start", GUARD)
    first = until(GUARD, 0)
    with can("arm0") as program, can("vcan0") as wire:
        passed = passes(program, wire)
        program.send(FRAME.pack(0x123, 1, b"\x01"))
        program.send(FRAME.pack(0x80, 0, b""))
        after = heard(wire)
        found: dict[str, object] = {
            "passed": passed,
            "after_a_hostile_frame": after,
            "user": os.stat(f"/proc/{first}").st_uid,
            "policy": os.sched_getscheduler(first),
            "memory_max": int(cgroup(GUARD, "memory.max")),
            "writes_etc": writes(first, "/etc/probe"),
        }
        os.kill(first, signal.SIGKILL)
        second = until(GUARD, 1)
        return {**found, "restarted": second != first, "passed_again": passes(program, wire)}


def daemon() -> dict[str, object]:
    drop_in = Path(f"/etc/systemd/system/{DAEMON}.service.d/shorter.conf")
    drop_in.parent.mkdir()
    drop_in.write_text("[Service]\n" + "".join(f"{key}={value}\n" for key, value in SHORTER.items()))
    systemctl("daemon-reload")
    systemctl("start", DAEMON)  # returns once it is ready
    first = until(DAEMON, 0)
    found: dict[str, object] = {
        "watchdog_of_the_unit": shown(DAEMON, "WatchdogUSec"),
        "user": os.stat(f"/proc/{first}").st_uid,
        "memory_max": int(cgroup(DAEMON, "memory.max")),
        "writes_etc": writes(first, "/etc/probe"),
        "writes_state": writes(first, "/var/lib/armlink/bench/probe"),
        "sees_homes": writes(first, "/root/probe"),
        "outside_writes_etc": writes(1, "/etc/probe"),
    }
    time.sleep(12.0)
    found |= {"restarts_while_it_lives": int(shown(DAEMON, "NRestarts")), "status": shown(DAEMON, "StatusText")}
    os.kill(first, signal.SIGSTOP)
    second = until(DAEMON, 1)
    systemctl("set-property", "--runtime", DAEMON, "MemoryMax=4M")
    time.sleep(1.0)
    systemctl("set-property", "--runtime", DAEMON, "MemoryMax=1G")
    third = until(DAEMON, 2)
    while not Path("/run/armlink/bench/api.sock").exists():
        time.sleep(0.2)
    systemctl("stop", DAEMON)
    said = journal(DAEMON)
    return {
        **found,
        "lives": len({first, second, third}),
        "real_time": "real-time scheduling, memory locked" in said,
        "watchdog": "Watchdog timeout" in said,
        "out_of_memory": "oom-kill" in said,
        "stopped": shown(DAEMON, "Result"),
    }


if __name__ == "__main__":
    print(json.dumps({"guard": guard(), "daemon": daemon()}, indent=1), flush=True)
