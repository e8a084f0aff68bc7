"""Campaign: the daemon killed (SIGKILL) at random moments; nothing kept is lost, nothing is left half done.

python tests/campaigns/daemon_kills.py [--kills 100] [--bus-kills 30] [--seed 0]
Exit status 1 if a bound fails. Two parts. In the first the service runs as fast as it can on an arm whose sensors keep
drifting, policy apply, so that kills fall into writes too; controllers are a table in a file. In the second the whole
`armlink daemon` drives `armlink sim` over a bus (udp_multicast, no root); service, bus process or both are killed, and
the joints are looked at after each kill.
"""

import argparse
import contextlib
import logging
import multiprocessing
import os
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))

from bounds import exit_status
from fast_daemon import QUIET, FastDaemon

from armlink.arm_file import ArmFile
from calib.daemon.settings import DaemonSection
from calib.records.records import CalibrationRecord

LOST_ROWS = 8
"""Stops of the arm that the observer may have to see again: five seconds of work, and one moved on meanwhile."""
START_SECONDS = 2.0
"""A daemon that was killed knows all that it knew, and tells it, so long after it was started again (median)."""
STILL = 0.02
"""How far a joint may move after a kill, once it has stopped [rad]."""


def life(folder: Path, seed: int, told: Connection) -> None:
    """One life of the service, until it is killed: tells what is on disk."""
    logging.disable(logging.CRITICAL)
    given = {"policy": "apply", "recording": QUIET, "rest_between_writes": 1.0, "writes_per_day": 100000}
    world = np.memmap(folder / "world", dtype=float, mode="r+", shape=(6, 7))  # survives the kill, as an arm does
    fresh = world[5, 0] == 0

    class Daemon(FastDaemon):
        def start(self, up: bool = True) -> None:
            fast = self.fast
            fast.random = np.random.default_rng([seed, 3])
            self.clock_shift = float(world[5, 0])
            if fresh:
                world[0], world[2] = 1.0, 1.0
            fast.gain, fast.offset, fast.held_gain, fast.held_offset = world[0], world[1], world[2], world[3]
            self.ids = [int(number) for number in world[4]]
            super().start(up)

        def write_calibration(self, joint: int, *args: Any, **kwargs: Any) -> Any:
            answer = super().write_calibration(joint, *args, **kwargs)
            world[4, joint] = self.ids[joint]
            return answer

    daemon = Daemon(folder, 1, DaemonSection.model_validate(given), records=fresh)
    current = daemon.store.current(CalibrationRecord, daemon.arm)
    right = np.allclose(daemon.fast.held_gain, current.values("gain"), rtol=1e-6)
    right &= np.allclose(daemon.fast.held_offset, current.values("offset"), atol=1e-5)
    told.send({"start": daemon.view.status().rows, "right": bool(right), "record": current.id})
    drifts = np.random.default_rng([seed, 4])
    while True:
        joint = int(drifts.integers(7))
        if np.abs(daemon.fast.error()[1]).max() < 0.1:
            daemon.fast.offset[joint] += float(drifts.choice([-0.3, 0.3]))
        daemon.run(2.0)
        world[5, 0] = daemon.now()
        kept = daemon.service.journal.belief()
        rows = kept.state["rows"] if kept else 0
        proposals = [[row.id, row.proposal.state] for row in daemon.service.journal.proposals(5)]
        told.send({"event": daemon.service.journal.last_event, "rows": rows, "proposals": proposals})


def check_disk(folder: Path, acknowledged: dict[str, Any]) -> list[str]:
    """What is wrong with the files after a kill."""
    wrong = []
    for name in ("state/journal.db", "records.db"):
        with contextlib.closing(sqlite3.connect(folder / name)) as db:
            if db.execute("PRAGMA integrity_check").fetchone()[0] != "ok":
                wrong.append(f"{name} is torn")
    with contextlib.closing(sqlite3.connect(folder / "state" / "journal.db")) as db:
        ids = [row[0] for row in db.execute("SELECT id FROM events ORDER BY id")]
        proposals = {row[0] for row in db.execute("SELECT id FROM proposals")}
        records = [row[0] for row in db.execute("SELECT record FROM proposals")]
    if ids != list(range(1, len(ids) + 1)) or len(ids) < acknowledged.get("event", 0):
        wrong.append(f"events lost: {len(ids)} of {acknowledged.get('event')}")
    if not {number for number, _ in acknowledged.get("proposals", [])} <= proposals:
        wrong.append("a proposal is lost")
    with contextlib.closing(sqlite3.connect(folder / "records.db")) as db:
        kept = {row[0] for row in db.execute("SELECT id FROM records")}
    return wrong + ["a proposal without its record"] * (not set(records) <= kept)


def kill_service(given: argparse.Namespace) -> list[str]:
    """The first part."""
    folder = Path(tempfile.mkdtemp(prefix="armlink-kills-"))
    np.zeros((6, 7)).tofile(folder / "world")
    context = multiprocessing.get_context("fork")
    choose, wrong, written, acknowledged = random.Random(given.seed), list[str](), 0, dict[str, Any]()
    for number in range(given.kills):
        ours, theirs = context.Pipe()
        process = context.Process(target=life, args=(folder, number, theirs))
        process.start()
        theirs.close()
        started = ours.recv()
        if not started["right"]:
            wrong.append(f"kill {number}: after it the controllers do not hold the record in force: {started}")
        if started["start"] < acknowledged.get("rows", 0) - LOST_ROWS:
            wrong.append(f"kill {number}: the observer went back from {acknowledged} to {started}")
        time.sleep(choose.expovariate(1 / given.life))
        process.kill()
        process.join()
        with contextlib.suppress(EOFError):
            while ours.poll():
                acknowledged = ours.recv()
        wrong += [f"kill {number}: {what}" for what in check_disk(folder, acknowledged)]
    with contextlib.closing(sqlite3.connect(folder / "state" / "journal.db")) as db:
        states = dict(db.execute("SELECT state, COUNT(*) FROM decisions GROUP BY state").fetchall())
        written = states.get("applied", 0)
        undone = db.execute("SELECT COUNT(*) FROM events WHERE kind = 'roll-back' AND joint IS NULL").fetchone()[0]
    print(
        f"service: {given.kills} kills, {acknowledged.get('event')} events, {written} recalibrations, "
        f"{undone} cut-off writes undone, {len(wrong)} wrong",
        flush=True,
    )
    return wrong


def kill_daemon(given: argparse.Namespace) -> list[str]:
    """The second part: the joints hold after each kill, whichever process it hits, and the next life goes on."""
    from daemon_bench import good_records

    from armlink.arm_file import load_arm
    from calib.records.store import RecordStore
    from sim_bus.simulated_arm import SimulatedArm
    from sim_bus.truth import Truth

    folder, armlink = Path(tempfile.mkdtemp(prefix="armlink-kills-")), Path(sys.executable).with_name("armlink")
    choose, wrong, lives = random.Random(given.seed), list[str](), list[Life]()
    arm = load_arm("sarcos")
    store = RecordStore(str(folder / "records.db"))
    for record in good_records(arm, SimulatedArm(arm, Truth.of(arm), 0).true_sensors):
        store.put(record, arm, by="ann", reason="sweep")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    daemon = [armlink, "daemon", "sarcos", "--bus", given.bus, "--work", "--store", folder / "records.db"]
    daemon = [str(part) for part in [*daemon, "--state", folder / "state"]]
    with subprocess.Popen([armlink, "sim", "sarcos", "--bus", given.bus], **quiet) as simulated:
        time.sleep(5)
        for number in range(given.bus_kills):
            lives.append(one_life(daemon, folder, choose, ("service", "both", "bus")[number % 3], lives))
            wrong += [f"bus kill {number}: {what}" for what in lives[-1].wrong + not_holding(arm, given.bus)]
            print(f"bus kill {number}: {lives[-1]}", flush=True)
        simulated.terminate()
    again = lives[1:] or lives  # the first one also compiles what an installation has compiled
    for name, times in {name: [getattr(life, name) for life in again] for name in TIMES}.items():
        print(f"daemon: {name} after {np.median(times):.2f} s (median), {max(times):.2f} s at most", flush=True)
    print(f"daemon: {given.bus_kills} kills, {len(wrong)} wrong", flush=True)
    told = float(np.median([life.answering for life in again]))
    return wrong + [f"a daemon that was killed answers after {told:.2f} s"] * (told > START_SECONDS)


TIMES = ("ready", "answering", "observing", "cpu")


@dataclass
class Life:
    """One life of `armlink daemon`."""

    hit: str
    ready: float = np.nan
    """Seconds from its start until it knows what it knew (READY=1)."""
    answering: float = np.nan
    """Seconds from its start until its API has answered with that."""
    observing: float = np.nan
    """Seconds from its start to its first observing: the joints are configured, enabled and read."""
    cpu: float = np.nan
    """Processor seconds that it and its bus process had used when it answered."""
    rows: int = 0
    """Stops of the arm that it knew last."""
    wrong: list[str] = field(default_factory=list)


def one_life(daemon: list[str], folder: Path, choose: random.Random, hit: str, before: list[Life]) -> Life:
    """Start, wait until it observes, kill what is to be hit; where that is the bus process, the service after it."""
    life, quiet = Life(hit), {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with Told(folder / "notify") as told:
        environment = {**os.environ, "NOTIFY_SOCKET": str(told.path), "PYTHONPYCACHEPREFIX": str(folder / "bytecode")}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation has its byte code
        began = time.monotonic()
        process = subprocess.Popen(daemon, process_group=0, env=environment, **quiet)
        told.until("READY=1")
        life.ready = time.monotonic() - began
        known = before[-1].rows if before else 0
        while not listens(folder / "state" / "api.sock") and time.monotonic() - began < 60.0:
            time.sleep(0.01)
        rows = status(folder).get("rows", 0)
        life.answering = time.monotonic() - began
        life.cpu = cpu_of(process.pid) + sum(map(cpu_of, children(process.pid)))
        if not np.isnan(told.until("STATUS=observing")):
            life.observing = time.monotonic() - began
        if rows < known - LOST_ROWS:
            life.wrong.append(f"the observer knows {rows} stops, before the kill {known}")
        time.sleep(choose.uniform(0.0, 3.0))
        if hit == "bus":
            for child in children(process.pid):
                os.kill(child, signal.SIGKILL)
            if np.isnan(told.until("STATUS=observing")):
                life.wrong.append("the bus process was not begun anew")
        life.rows = max(rows, status(folder).get("rows", 0))
        if hit == "service":
            process.kill()  # its bus process sees that and stops the arm itself
        else:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if np.isnan(life.observing):
        life.wrong.append("it never observed")
    return life


class Told:
    """What a service tells systemd."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> "Told":
        self.path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def until(self, line: str, seconds: float = 60.0) -> float:
        """Seconds until a line that begins like this, NaN where none came."""
        began = time.monotonic()
        while (left := began + seconds - time.monotonic()) > 0:
            self._socket.settimeout(left)
            with contextlib.suppress(TimeoutError):
                if any(each.startswith(line) for each in self._socket.recv(4096).decode().splitlines()):
                    return time.monotonic() - began
        return float("nan")


def children(process: int) -> list[int]:
    """Ids of its child processes."""
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def cpu_of(process: int) -> float:
    """Processor seconds that it has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def listens(path: Path) -> bool:
    """Whether somebody takes connections there; costs next to nothing, unlike a request."""
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0


def status(folder: Path) -> dict[str, Any]:
    """The daemon's status by its API, empty where it does not answer."""
    transport = httpx.HTTPTransport(uds=str(folder / "state" / "api.sock"))
    try:
        with httpx.Client(transport=transport, base_url="http://localhost", timeout=5.0) as client:
            return dict(client.get("/api/status").json())
    except (httpx.HTTPError, ValueError):
        return {}


def not_holding(arm: ArmFile, bus: str) -> list[str]:
    """What another host sees of the joints a second after a kill, where they do not all hold still in quick stop."""
    from armlink.bus.open import open_link_bus
    from armlink.monitor.monitor import Monitor

    time.sleep(1.0)
    opened = open_link_bus(bus, arm.require_link())
    try:
        monitor = Monitor(arm, opened, True, False)
        before, after = (monitor.describe(monitor.watch(0.5))["joints"] for _ in range(2))
    finally:
        opened.shutdown()
    states = {joint["state"] for joint in after}
    moved = max(abs(a["position"] - b["position"]) for a, b in zip(before, after, strict=True))
    return [] if states == {"quick stop active"} and moved < STILL else [f"{states}, moved {moved:.3f} rad"]


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--bus-kills", type=int, default=30)
    parser.add_argument("--bus", default="udp_multicast:239.74.166.9")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--life", type=float, default=1.0, help="Mean seconds from a start to the kill.")
    given = parser.parse_args()
    wrong = kill_service(given) if given.kills else []
    wrong += kill_daemon(given) if given.bus_kills else []
    return exit_status(wrong)


if __name__ == "__main__":
    sys.exit(main())
