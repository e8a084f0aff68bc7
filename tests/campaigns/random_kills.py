"""Campaign: kills (SIGKILL) of service, bus process, simulated arm or all of them, at random moments of their work.

python tests/campaigns/random_kills.py [--kills 1000] [--seed 0] [--bus udp_multicast:239.74.163.83]

`armlink sim` and `armlink daemon --work` on an arm of three joints, each begun in a fork of this process, which has
loaded all modules, so that a kill costs a second of processor time; SIGTERM ends it early. After each kill of a host
the joints must be safe within their deadline; journal and record store must be whole, no event missing; the daemon's
state must be right again within 3 s: "fault" after the arm or the bus process has gone, "observing" after the joints
are enabled. Exit status 1 if one is not so. On a machine with other work a time counts without what one of the
processes waited for a processor, as the kernel counts it; how many are late by the clock is said.
"""

import argparse
import contextlib
import importlib
import json
import os
import random
import resource
import signal
import socket
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))
sys.path.insert(0, str(Path(__file__).parents[1] / "calib"))

from daemon_bench import good_records
from processes import ENABLED, SAFE, Ear, write_arm

from armlink.arm_file import load_arm
from armlink.cli import main as armlink
from calib.records.store import RecordStore
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

RATE, DEADLINE = 50.0, 0.25
SLACK = 0.15
"""What this machine may add to the deadline [s]."""
RIGHT = 3.0
"""The state is right this long after a kill, or after the joints are enabled [s]."""
LONGEST = 30.0
MOMENT = 0.3
"""Mean time from when the daemon observes to the kill [s]."""
SO_RCVBUFFORCE, EAR_BYTES = 33, 8 << 20
"""Linux's option, which Python does not name; needs CAP_NET_ADMIN."""
HITS = ("service", "loop", "arm", "all")


def preload() -> None:
    """Load what the programs need, so that their forks have it."""
    for module in ("calib.commands.daemon", "calib.daemon.main_loop", "calib.daemon.web.server"):
        importlib.import_module(module)
    for module in ("armlink.loop.process", "sim_bus.commands.sim", "sim_bus.bus.server"):
        importlib.import_module(module)


def begin(*arguments: object, notify: Path | None = None) -> int:
    """`armlink` with these arguments, in a fork of its own group; returns its process id."""
    process = os.fork()
    if process:
        return process
    os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    silent = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(silent, descriptor)
    if notify is not None:
        os.environ["NOTIFY_SOCKET"] = str(notify)
    sys.argv = ["armlink", *map(str, arguments)]
    with contextlib.suppress(BaseException):
        armlink()
    os._exit(1)


def waited(process: int) -> float:
    """How long a process has been ready to run and had no processor, the longest of its threads [s]."""
    found = [0.0]
    for thread in Path(f"/proc/{process}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):
            found.append(int(thread.read_text().split()[1]) / 1e9)
    return max(found)


def kill(process: int) -> None:
    """At once, and wait until it is gone."""
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)


class Told:
    """What the daemon tells systemd: its status, and since when."""

    def __init__(self, path: Path) -> None:
        self.path, self.status = path, ""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))

    def seconds_until(self, state: str, seconds: float) -> float:
        """Seconds until the status begins so, infinite where it does not."""
        began = time.monotonic()
        while not self.status.startswith(state):
            left = began + seconds - time.monotonic()
            if left <= 0:
                return float("inf")
            self._take(left)
        return time.monotonic() - began

    def catch_up(self) -> None:
        """Take in what has come."""
        while self._take(0.0):
            pass

    def _take(self, seconds: float) -> bool:
        self._socket.settimeout(seconds)
        try:
            lines = self._socket.recv(4096).decode().splitlines()
        except (TimeoutError, BlockingIOError):
            return False
        for line in lines:
            if line.startswith("STATUS="):
                self.status = line.removeprefix("STATUS=")
        return True


def hears_all(bus: Any) -> None:
    """Let the socket keep what comes while this process has no processor; 200 kB are full after half a second."""
    with contextlib.suppress(PermissionError):
        bus._multicast._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, EAR_BYTES)


class Rig:
    """Arm and daemon, and what is seen of them."""

    def __init__(self, folder: Path, bus: str) -> None:
        self.folder, self.bus, self.arm_file = folder, bus, write_arm(folder, RATE, DEADLINE)
        self.ear, self.told = Ear(bus), Told(folder / "notify")
        hears_all(self.ear.bus)
        self.arm = self.daemon = self.events = 0
        self.safe, self.right, self.late = list[float](), list[float](), 0
        """How long after a kill the joints were safe, and after what changed it the state was right [s]; late ones."""
        arm = load_arm(self.arm_file)
        store = RecordStore(str(folder / "records.db"))
        for record in good_records(arm, SimulatedArm(arm, Truth.of(arm), 0).true_sensors):
            store.put(record, arm, by="ann", reason="sweep")
        store.close()

    def work(self) -> list[str]:
        """Start what does not run, and wait until the daemon observes; what was wrong."""
        self.ear.forget()
        self.arm = self.arm or begin("sim", self.arm_file, "--bus", self.bus)
        if not self.daemon:
            options = ["--store", self.folder / "records.db", "--state", self.folder / "state", "--work"]
            self.told.status = ""
            self.daemon = begin("daemon", self.arm_file, "--bus", self.bus, *options, notify=self.told.path)
        if not self.ear.listen(ENABLED, LONGEST):
            return [f"the joints are not enabled: {self.ear.states}, the daemon says {self.told.status}"]
        return self._right("observing")

    def hit(self, what: str) -> list[str]:
        """Kill; what was wrong then."""
        self.told.catch_up()
        self.events = self._rows("events")
        loop = self._loop()
        self.ear.forget()
        struck, wrong = time.monotonic(), list[str]()
        if what in ("loop", "all"):
            os.kill(loop, signal.SIGKILL)
        if what in ("service", "all"):
            kill(self.daemon)
            self.daemon = 0
        if what in ("arm", "all"):
            kill(self.arm)
            self.arm = 0
        if what in ("service", "loop"):
            before = self._waited()
            safe = self.ear.listen(SAFE, 5.0)
            self.safe.append(max(self.ear.when.values()) - struck if safe else float("inf"))
            if not safe:
                asked = "safe" if self.ear.see(SAFE) else f"{self.ear.states}"
                print(f"not heard to be safe; the joints say when asked: {asked}", file=sys.stderr, flush=True)
            wrong += self._late(self.safe[-1], DEADLINE + SLACK, before, f"the joints are safe: {self.ear.states}")
        return wrong + (self._right("fault") if self.daemon else self.whole())

    def _loop(self) -> int:
        """The bus process; what Python's multiprocessing tracks resources with is a child too."""
        children = Path(f"/proc/{self.daemon}/task/{self.daemon}/children").read_text().split()
        (loop,) = (each for each in children if b"resource_tracker" not in Path(f"/proc/{each}/cmdline").read_bytes())
        return int(loop)

    def _right(self, state: str) -> list[str]:
        before = self._waited()
        self.right.append(self.told.seconds_until(state, LONGEST))
        return self._late(self.right[-1], RIGHT, before, f"{state}: {self.told.status}")

    def _waited(self) -> dict[int, float]:
        """What each process has waited for a processor [s]."""
        children = Path(f"/proc/{self.daemon}/task/{self.daemon}/children") if self.daemon else None
        loops = map(int, children.read_text().split()) if children is not None and children.exists() else ()
        return {process: waited(process) for process in (os.getpid(), self.arm, self.daemon, *loops) if process}

    def _late(self, seconds: float, most: float, before: dict[int, float], what: str) -> list[str]:
        """What is wrong with a time since when the processes had waited so long."""
        if seconds <= most:
            return []
        self.late += 1
        starved = max(after - before.get(process, 0.0) for process, after in self._waited().items())
        said = f"{what}, after {seconds:.2f} s, of which {starved:.2f} s without a processor"
        print(f"late: {said}", file=sys.stderr, flush=True)
        return [said] * (seconds - starved > most)

    def _rows(self, table: str) -> int:
        with contextlib.closing(sqlite3.connect(self.folder / "state" / "journal.db")) as db:
            return int(db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

    def whole(self) -> list[str]:
        """What is wrong with journal and record store of a daemon that was killed."""
        wrong = []
        for name in ("state/journal.db", "records.db"):
            with contextlib.closing(sqlite3.connect(self.folder / name)) as db:
                found = db.execute("PRAGMA integrity_check").fetchone()[0]
                wrong += [f"{name}: {found}"] * (found != "ok")
        with contextlib.closing(sqlite3.connect(self.folder / "state" / "journal.db")) as db:
            count, last = db.execute("SELECT COUNT(*), MAX(id) FROM events").fetchone()
        wrong += [f"{last} events, {count} of them kept, {self.events} before"] * (count != last or count < self.events)
        return wrong + [f"set aside: {each.name}" for each in (self.folder / "state").glob("journal.db.damaged*")]

    def end(self) -> None:
        """Stop both."""
        for process in filter(None, (self.daemon, self.arm)):
            os.kill(process, signal.SIGTERM)
            os.waitpid(process, 0)


def main() -> int:
    """Kill, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bus", default="udp_multicast:239.74.163.83")
    given = parser.parse_args()
    os.environ["CAN_CONFIG"] = json.dumps({"port": 44200 + os.getpid() % 1000})
    preload()
    choose, hits, bad = random.Random(given.seed), Counter[str](), 0
    began, spent = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory(prefix="armlink-kills-") as folder:
        rig = Rig(Path(folder), given.bus)
        ended: list[bool] = []
        signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
        for number in range(given.kills):
            if ended:
                given.kills = number
                break
            wrong, what = rig.work(), choose.choice(HITS)
            time.sleep(choose.expovariate(1 / MOMENT))
            wrong += rig.hit(what)
            hits[what] += 1
            bad += bool(wrong)
            for line in wrong:
                print(f"FAILED: kill {number}, {what}: {line}", flush=True)
            if number % 50 == 49:
                print(f"{number + 1} kills, {bad} wrong, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        wrong = rig.work() + rig.whole()
        rig.end()
        rig.ear.bus.shutdown()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = used.ru_utime + used.ru_stime - spent.ru_utime - spent.ru_stime
    struck = ", ".join(f"{count} {what}" for what, count in sorted(hits.items()))
    print(f"{given.kills} kills ({struck}), {bad} wrong, {rig.late} late by the clock")
    for name, times in (("joints safe", rig.safe), ("state right", rig.right)):
        print(f"{name} after {sorted(times)[len(times) // 2]:.3f} s (median), {max(times):.3f} s at most")
    cost = f"{seconds / given.kills:.2f} s of processor time a kill"
    print(f"{rig.events} events kept; {cost}; {wrong or 'whole at the end'}")
    return int(bool(bad or wrong))


if __name__ == "__main__":
    sys.exit(main())
