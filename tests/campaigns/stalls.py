"""Campaign: sweeps in real time while job, loop and simulated arm are stopped at random, or the machine is kept busy.

    python tests/campaigns/stalls.py [--short 100] [--long 10] [--busy 20] [--rate 250] [--out DIR]

`--short` stops of 50 ms and `--long` ones of 1 s (SIGSTOP, SIGCONT) hit each of job, loop and arm so often, during
sweeps of a two-joint arm over udp_multicast with --keep-going. `--busy` sweeps are made with all cores and disk kept
busy, without --keep-going: one that stops must name the lateness in one line, and is finished with --resume. Every pair
of sweeps is calibrated and compared with the arm's truth and with an undisturbed pair. Prints a line a sweep and a JSON
summary; exit status 1 if anything was said of hardware that is sound, a joint did not stop by itself while its host was
stopped for 1 s, a sweep did not finish, or its result is further off than its intervals allow.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from real_time import ARMLINK, FALSE, keep_busy

from armlink.arm_file import ArmFile, load_arm
from armlink.bus.open import open_link_bus
from armlink.drives.canopen.pdo import RPDO1
from calib.dataset import load_data
from calib.fit.sensor_fit import fit_sensors
from gcomp.arrays import Array
from sim_bus.truth import Truth

NODES = (1, 2)
EMCY_ID, NO_ERROR, ENABLE = 0x80, b"\x00\x00", b"\x0f"
BUS_FAULT = 3
"""Exit status."""
MASS = 1.5
SHORT, LONG = 0.05, 1.0
"""Length of a stop [s]."""
GAPS = {SHORT: 0.7, LONG: 6.0}
"""Mean time between two stops [s]."""
STALL = re.compile(r"the host was \d+ ms late|no joint has sent a reading|no reading for|stopped itself|RPDO|heartbeat")
"""What a line may say of a stall."""
OWN_STOP = 0.5
"""After a host fell silent its joints have stopped by then [s]: five deadlines."""
SIGMAS = 4.0
"""Largest difference of two gains or offsets, in their common standard deviation."""
PAIR: dict[str, Any] = {
    "name": "pair",
    "serial": "STALLS",
    "kinematics": {
        "gravity": [9.81, 0.0, 0.0],
        "joints": [
            {"name": "j1", "a": 0.4, "alpha": 0.0, "d": 0.0, "lower": -1.6, "upper": 1.6},
            {"name": "j2", "a": 0.3, "alpha": 0.0, "d": 0.0, "lower": -1.7, "upper": 1.7},
        ],
    },
    "link": {
        "joints": [
            {"name": "j1", "node": 1, "rated_torque": 40.0, "max_torque": 40.0, "max_velocity": 2.0},
            {"name": "j2", "node": 2, "rated_torque": 20.0, "max_torque": 20.0, "max_velocity": 2.0},
        ],
    },
    "sweep": {"steps": 5, "poses": 1, "reference_mass": MASS},
    "sim": {
        "links": [
            {"mass": 3.0, "com": [-0.15, 0.02, 0.1], "inertia": [0.03, 0.03, 0.03]},
            {"mass": 2.0, "com": [0.2, 0.03, 0.0], "inertia": [0.02, 0.02, 0.02]},
        ],
        "effects": [
            {"effect": "friction.coulomb", "joint": "j1", "torque": 0.5},
            {"effect": "friction.coulomb", "joint": "j2", "torque": 0.25},
        ],
    },
}


class Ear:
    """Hears what host and joints send: emergencies, and when each node was last told to be enabled."""

    def __init__(self, arm: ArmFile, bus: str) -> None:
        """On this bus."""
        self.heard: list[tuple[float, int]] = []
        """(monotonic time [s], node) of each emergency."""
        self.commanded = dict.fromkeys(NODES, -np.inf)
        self._bus = open_link_bus(bus, arm.require_link())
        self._port = self._bus.open_listening_port()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while True:
            frame = self._port.receive(1.0)
            if frame is None:
                continue
            can_id, data = frame
            if can_id - RPDO1.cob_base in NODES and data[:1] == ENABLE:
                self.commanded[can_id - RPDO1.cob_base] = time.monotonic()
            elif can_id - EMCY_ID in NODES and data[:2] != NO_ERROR:
                self.heard.append((time.monotonic(), can_id - EMCY_ID))

    def enabled(self) -> bool:
        """Whether every node was told so within the last tenth of a second."""
        return min(self.commanded.values()) > time.monotonic() - 0.1

    def stopped(self, begin: float, end: float) -> set[int]:
        """Nodes that sent an emergency in this time."""
        return {node for t, node in self.heard if begin <= t <= end}


class Bench:
    """A simulated arm in real time, and sweeps of it."""

    def __init__(self, folder: Path, rate: float, group: int) -> None:
        """Start the arm in `folder`."""
        self.folder, self.random = folder, np.random.default_rng(0)
        self._path, self._pipe = folder / "pair.yaml", folder / "arm.pipe"
        self._path.write_text(yaml.safe_dump(PAIR | {"link": {**PAIR["link"], "rate": rate}}))
        self.arm: ArmFile = load_arm(str(self._path))
        self.truth = Truth.draw(self.arm, 3)
        self.bus = f"udp_multicast:239.74.165.{group}"
        self.ear = Ear(self.arm, self.bus)
        words = ["sim", str(self._path), "--bus", self.bus, "--seed", "3", "--control", str(self._pipe)]
        self._log = (folder / "sim.log").open("w")
        self.process = subprocess.Popen([ARMLINK, *words], stdout=self._log, stderr=self._log)
        while not self._pipe.exists():
            time.sleep(0.1)
        self.wrong: list[str] = []
        self.stops = dict.fromkeys(("job", "loop", "arm"), 0)
        self.stalls = self.interrupted = 0

    def end(self) -> None:
        """End the arm."""
        self.process.terminate()
        self.process.wait(20)

    def sweep(self, name: str, mass: float, length: float, *options: str) -> tuple[int, list[str]]:
        """One sweep into folder `name`, with stops of this length [s] (0: none); exit status, and what it said."""
        with self._pipe.open("w") as pipe:
            pipe.write(f"mass {mass:g}\n")
        words = ["sweep", str(self._path), "--bus", self.bus, "--out", str(self.folder / name), "--yes", *options]
        words += ["--reference-mass", f"{mass:g}"] if mass else []
        log = self.folder / f"{name}.log"
        begin = time.monotonic()
        with log.open("a") as file:
            job = subprocess.Popen([ARMLINK, *words], stdin=subprocess.DEVNULL, stdout=file, stderr=file)
            while job.poll() is None:
                if length:
                    self._stop(job, length)
                else:
                    time.sleep(0.1)
        lines = [line.strip() for line in log.read_text().splitlines() if line.strip()]
        self.wrong += [f"{name}: {line}" for line in lines if FALSE.search(line)]
        said = [line for line in lines if STALL.search(line)]
        self.stalls += len(said)
        print(f"  {name}: exit {job.returncode}, {time.monotonic() - begin:.0f} s, {len(said)} stalls", flush=True)
        return job.returncode, lines

    def _stop(self, job: subprocess.Popen[bytes], length: float) -> None:
        """After a random time stop one of the three; a loop that stands still for long must leave joints that stop."""
        time.sleep(self.random.exponential(GAPS[length]))
        loop = _child(job.pid)
        who = min(self.stops, key=self.stops.__getitem__)
        pid = {"job": job.pid, "loop": loop, "arm": self.process.pid}[who]
        if pid is None or job.poll() is not None:
            return
        enabled, begin = self.ear.enabled(), time.monotonic()
        os.kill(pid, signal.SIGSTOP)
        time.sleep(length)
        os.kill(pid, signal.SIGCONT)
        self.stops[who] += 1
        if who == "loop" and length > OWN_STOP and enabled:
            stopped = self.ear.stopped(begin, begin + OWN_STOP)
            if stopped != set(NODES):
                self.wrong.append(f"of nodes {NODES} only {sorted(stopped)} stopped within {OWN_STOP} s of silence")

    def calibrated(self, unloaded: str, loaded: str) -> tuple[Array, Array]:
        """Gains and offsets (2n,) of a pair of sweeps, and their standard deviations."""
        fit = fit_sensors(self.arm, [load_data(self.folder / name) for name in (unloaded, loaded)])
        return tuple(np.concatenate([each("gain"), each("offset")]) for each in (fit.value, fit.std))  # type: ignore

    def pair(self, name: str, length: float, *options: str) -> tuple[Array, Array] | None:
        """Both sweeps with stops of this length, and their calibration; None if one did not finish."""
        names = (f"{name} unloaded", f"{name} loaded")
        for each, mass in zip(names, (0.0, MASS), strict=True):
            status, lines = self.sweep(each, mass, length, *options)
            if status == BUS_FAULT and not options:
                if not any(STALL.search(line) for line in lines[-2:]):
                    self.wrong.append(f"{each}: stopped, and did not say that the host was late: {lines[-1:]}")
                print(f"    {lines[-1]}", flush=True)
                self.interrupted += 1
                status, lines = self.sweep(each, mass, 0.0, "--resume", "--keep-going", "1000")
            if status:
                self.wrong.append(f"{each}: exit {status}: {lines[-1:]}")
                return None
        return self.calibrated(*names)

    def stopped(self, length: float, wanted: int, reference: tuple[Array, Array]) -> dict[str, Any]:
        """Pairs of sweeps until each of the three was stopped so often."""
        self.stops, before = dict.fromkeys(self.stops, 0), self.stalls
        pairs: list[dict[str, Any]] = []
        while min(self.stops.values()) < wanted:
            name = f"stops of {length} s {len(pairs)}"
            pairs.append(self.compare(name, self.pair(name, length, "--keep-going", "1000"), reference))
        return {"stops": self.stops, "stalls": self.stalls - before, "pairs": pairs}

    def compare(self, name: str, found: tuple[Array, Array] | None, reference: tuple[Array, Array]) -> dict[str, Any]:
        """A calibration against the truth and against an undisturbed one, in standard deviations."""
        if found is None:
            return {"finished": False}
        true = np.concatenate([self.truth.gain, self.truth.offset])
        away = np.abs(found[0] - true) / found[1]
        apart = np.abs(found[0] - reference[0]) / np.hypot(found[1], reference[1])
        if max(away.max(), apart.max()) > SIGMAS:
            self.wrong.append(f"{name}: {away.max():.1f} σ from the truth, {apart.max():.1f} σ from the undisturbed")
        gain = np.abs(found[0] / true - 1)[: len(NODES)].max()
        print(f"  {name}: gain within {gain:.2%}, {away.max():.1f} σ; {apart.max():.1f} σ apart", flush=True)
        return {"finished": True, "gain": float(gain), "sigmas": float(away.max()), "apart": float(apart.max())}


def _child(pid: int) -> int | None:
    """The process that keeps the cycle for a job."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return None
    return int(children[0]) if children else None


def main() -> int:
    """Run all, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--short", type=int, default=100, help="stops of 50 ms of each of job, loop and arm")
    parser.add_argument("--long", type=int, default=10, help="stops of 1 s of each")
    parser.add_argument("--busy", type=int, default=20, help="sweeps with all cores and the disk kept busy")
    parser.add_argument("--rate", type=float, default=250.0, help="cycles a second [Hz]")
    parser.add_argument("--out", type=Path, help="keep everything here")
    parser.add_argument("--group", type=int, default=os.getpid() % 200 + 10, help="last byte of the multicast group")
    options = parser.parse_args()
    folder = options.out or Path(tempfile.mkdtemp(prefix="stalls-"))
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{folder}", flush=True)
    bench = Bench(folder, options.rate, options.group)
    found: dict[str, Any] = {}
    busy: list[subprocess.Popen[bytes]] = []
    try:
        reference = bench.pair("undisturbed", 0.0, "--keep-going", "1000")
        if reference is not None:
            found["undisturbed"] = bench.compare("undisturbed", reference, reference)
            for length, wanted in ((SHORT, options.short), (LONG, options.long)):
                found[f"{length} s"] = bench.stopped(length, wanted, reference)
            busy = keep_busy(folder) if options.busy else []
            before, interrupted = bench.stalls, bench.interrupted
            each = [
                bench.compare(f"busy {k}", bench.pair(f"busy {k}", 0.0), reference)
                for k in range((options.busy + 1) // 2)
            ]
            found["busy"] = {
                "sweeps": 2 * len(each),
                "stopped": bench.interrupted - interrupted,
                "stalls": bench.stalls - before,
                "results": each,
            }
    finally:
        for process in busy:
            process.kill()
        bench.end()
    print(json.dumps({"wrong": bench.wrong, **found}, indent=1))
    return 1 if bench.wrong or reference is None else 0


if __name__ == "__main__":
    sys.exit(main())
