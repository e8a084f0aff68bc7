"""Campaign: the whole job where time passes, between processes: each step is a command that a user types.

    python tests/campaigns/real_time.py [--arm sarcos] [--seeds 1 2 3] [--bus udp_multicast] [--out DIR] [--busy]

A simulated arm in real time on a bus, and one after the other: sweep, mass bolted on by the control pipe, loaded sweep,
calibrate, identify, apply, verify, float, a daemon that finds an injected drift and corrects it, gap plan, collect,
diagnose. Estimates are compared with the arm's truth. Prints a line a step and a JSON summary; exit status 1 if a bound
is not met. With --busy both cores are kept busy and a file is written all the while.
"""

import argparse
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, load_arm
from sim_bus.truth import Truth

ARMLINK = str(Path(sys.executable).parent / "armlink")
GROUP = "239.74.163.{}"
FALSE = re.compile(r"encoder|cable|too weak|TPDO|babbles|second node|stuck", re.IGNORECASE)
"""What no message may say of this sound arm."""
FLOAT_SECONDS = 60
DRIFT_GAIN = 1.03
START_SECONDS = 120
OBSERVING_SECONDS, DAEMON_SECONDS = 60, 900
"""Longest waits for the daemon to observe, and to correct the drift [s]."""
GAIN_BOUND, OFFSET_BOUND = 0.005, 0.05
"""Largest error of a gain, and of an offset [N·m]."""


class Failed(Exception):
    """A step did not end as it must."""


class Run:
    """One seed."""

    def __init__(self, arm: str, bus: str, seed: int, folder: Path) -> None:
        self.arm, self.bus, self.seed, self.folder = arm, bus, seed, folder
        self.described: ArmFile = load_arm(arm)
        self.truth = Truth.draw(self.described, seed)
        self.store = folder / "records.db"
        self.found: dict[str, Any] = {"seed": seed, "steps": {}, "false_statements": []}
        self._pipe = folder / "arm.pipe"
        self._arm: subprocess.Popen[bytes] | None = None

    def armlink(self, step: str, *words: str, ok: tuple[int, ...] = (0,)) -> dict[str, Any]:
        """One command; its JSON answer."""
        begin, answer = time.monotonic(), self.folder / f"{step.replace(' ', '-')}.json"
        options = [] if words[0] in ("rollback",) else ["--json", str(answer)]
        command = [ARMLINK, *words, *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        (self.folder / f"{answer.stem}.log").write_text(done.stdout + done.stderr)
        took = time.monotonic() - begin
        last = done.stderr.strip().splitlines()[-1:] or [""]
        print(f"  {step}: exit {done.returncode}, {took:.0f} s", *(last if done.returncode else ()), flush=True)
        self.found["steps"][step] = {"exit": done.returncode, "seconds": round(took, 1)}
        self.found["false_statements"] += [f"{step}: {line}" for line in done.stderr.splitlines() if FALSE.search(line)]
        if done.returncode not in ok:
            raise Failed(f"{step}: exit {done.returncode}: {last[0]}")
        content: dict[str, Any] = json.loads(answer.read_text()) if answer.exists() else {}
        return content

    def order(self, line: str) -> None:
        """One line to the simulated arm."""
        with self._pipe.open("w") as pipe:
            pipe.write(line + "\n")

    def __enter__(self) -> "Run":
        """Start the arm."""
        words = ["sim", self.arm, "--bus", self.bus, "--seed", str(self.seed), "--control", str(self._pipe)]
        with (self.folder / "sim.log").open("w") as log:
            self._arm = subprocess.Popen([ARMLINK, *words], stdout=log, stderr=log)
        end, scan = time.monotonic() + START_SECONDS, [ARMLINK, "scan", self.arm, "--bus", self.bus]
        while subprocess.run(scan, capture_output=True, check=False).returncode:
            if time.monotonic() > end:
                raise Failed(f"the simulated arm has not answered within {START_SECONDS} s")
        return self

    def __exit__(self, *error: object) -> None:
        """End it."""
        assert self._arm is not None
        self._arm.send_signal(signal.SIGTERM)
        self._arm.wait(10)

    def work(self, sweeps_only: bool) -> None:
        """All steps; raises Failed."""
        bus, store, folder = ("--bus", self.bus), ("--store", str(self.store)), self.folder
        unloaded, loaded = str(folder / "unloaded"), str(folder / "loaded")
        first = self.armlink("sweep", "sweep", self.arm, *bus, "--out", unloaded, "--yes", "--keep-going", "20")
        mass = first["recommended_reference_mass"]
        self.order(f"mass {mass}")
        mass_words = ("--reference-mass", str(mass), "--yes", "--keep-going", "20")
        second = self.armlink("loaded sweep", "sweep", self.arm, *bus, "--out", loaded, *mass_words)
        self.order("mass 0")
        self.found["stalls"] = len(first.get("stalls", [])) + len(second.get("stalls", []))
        self.found["late_ms"] = {"sweep": first.get("late_ms"), "loaded sweep": second.get("late_ms")}
        self.calibrated(self.armlink("calibrate", "calibrate", unloaded, loaded, *store))
        self.armlink("identify", "identify", unloaded, loaded, *store)
        self.armlink("apply", "calibrate", unloaded, loaded, *store, "--apply", *bus)
        if sweeps_only:
            return
        check = self.armlink("verify", "verify", self.arm, *bus, *store, ok=(0, 1))
        self.found["verify_rms"] = check["rms"]
        floated = self.armlink("float", "float", self.arm, *bus, *store, "--seconds", str(FLOAT_SECONDS))
        self.found["float"] = {key: floated[key] for key in ("seconds", "moved")}
        self.daemon()
        self.gap()

    def calibrated(self, answer: dict[str, Any]) -> None:
        """Errors of the calibration against the truth."""
        del answer
        from calib.records.records import CalibrationRecord
        from calib.records.store import RecordStore

        record = RecordStore(str(self.store)).current(CalibrationRecord, self.described)
        assert record is not None
        errors, inside = {}, []
        for name in ("gain", "offset", "position_gain"):
            value, std, true = record.values(name), record.std(name), getattr(self.truth, name)
            known = np.isfinite(value)
            relative = value[known] - true[known] if name == "offset" else value[known] / true[known] - 1
            errors[name] = float(np.abs(relative).max())
            inside += (np.abs(value - true) < 1.96 * std)[known & (std > 0)].tolist()
        self.found["errors"], self.found["intervals"] = errors, [int(sum(inside)), len(inside)]
        print(f"    largest errors {errors}; {sum(inside)} of {len(inside)} intervals hold", flush=True)

    def daemon(self) -> None:
        """A daemon among ordinary work; one sensor drifts, and its controller is corrected."""
        api, state = self.folder / "api.sock", self.folder / "state"
        words = ["daemon", self.arm, "--bus", self.bus, "--store", str(self.store), "--policy", "apply", "--work"]
        words += ["--socket", str(api), "--state", str(state)]
        joint = min(2, len(self.described.joint_names) - 1)
        name = self.described.joint_names[joint]
        with (self.folder / "daemon.log").open("w") as log:
            process = subprocess.Popen([ARMLINK, *words], stdout=log, stderr=log)
        begin = time.monotonic()
        try:
            if not self._until(api, lambda status, _: status["state"] == "observing", OBSERVING_SECONDS):
                raise Failed(f"daemon: not observing after {OBSERVING_SECONDS} s")
            observing = time.monotonic() - begin
            time.sleep(30)
            self.order(f"drift {name}:{DRIFT_GAIN}:0")
            drifted = time.monotonic()
            kept = self._until(api, lambda _, events: _holds(events, name), DAEMON_SECONDS)
            took = time.monotonic() - drifted
            events, status = _get(api, "/api/events?limit=500"), _get(api, "/api/status")
            self.found["daemon"] = {
                "found": kept,
                "seconds": round(took, 1),
                "observing_after": round(observing, 1),
                "bus": status["bus"],
                "events": [f"{event['kind']}: {event['text']}" for event in events],
            }
            print(f"  daemon: drift of {name} {'corrected' if kept else 'NOT corrected'}, {took:.0f} s", flush=True)
            if not kept:
                raise Failed("daemon: drift not corrected")
            others = {event["joint"] for event in events if event["kind"] == "recalibration"} - {name}
            if others or any(event["kind"] in ("fault", "roll-back") for event in events):
                raise Failed(f"daemon: a fault, a roll-back, or joints written without cause: {sorted(others)}")
        finally:
            process.send_signal(signal.SIGTERM)
            self.found["daemon_exit"] = process.wait(20)

    def _until(self, api: Path, done: Any, seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(1.0)
            try:
                status, events = _get(api, "/api/status"), _get(api, "/api/events?limit=500")
            except OSError:
                continue
            if done(status, events):
                return True
        return False

    def gap(self) -> None:
        """Motion, recordings, diagnosis."""
        train, heldout = str(self.folder / "train.mcap"), str(self.folder / "heldout.mcap")
        for seed, out in enumerate((train, heldout)):
            motion = f"{out}.csv"
            few = ("--joint", self.described.joint_names[0], "--poses", "1")  # all joints would take half an hour
            self.armlink(f"gap plan {seed}", "gap", "plan", self.arm, *few, "--seed", str(seed), "--out", motion)
            words = ("collect", self.arm, "--motion", motion, "--bus", self.bus, "--out", out)
            self.armlink(f"gap collect {seed}", "gap", *words)
        words = ("diagnose", "--sim", self.arm, "--train", train, "--heldout", heldout)
        answer = self.armlink("gap diagnose", "gap", *words)
        self.found["gap"] = {"verdict": answer["verdict"], "causes": [each["effect"] for each in answer["causes"]][:3]}


def _holds(events: list[dict[str, Any]], joint: str) -> bool:
    """Whether a write to this joint has passed the check at the next rests."""
    return any(event["joint"] == joint and event["kind"] == "check" and event["evidence"]["kept"] for event in events)


def _get(api: Path, path: str) -> Any:
    connection = http.client.HTTPConnection("localhost", timeout=5)
    connection.sock = socket.socket(socket.AF_UNIX)
    connection.sock.settimeout(5)
    connection.sock.connect(str(api))
    connection.request("GET", path)
    return json.loads(connection.getresponse().read())


def keep_busy(folder: Path) -> list[subprocess.Popen[bytes]]:
    """A process a core that computes, and one that writes to the disk; they end with this process."""
    while_here = f"import os\nwhile os.getppid() == {os.getpid()}:\n "
    compute = f"{while_here}sum(range(10**6))"
    write = f"{while_here}f = open({str(folder / 'busy')!r}, 'wb'); f.write(bytes(10**7)); os.fsync(f.fileno())"
    programs = [compute] * (os.cpu_count() or 1) + [write]
    return [subprocess.Popen([sys.executable, "-c", program]) for program in programs]


def main() -> int:
    """Run all seeds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--arm", default="sarcos")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--bus", default="udp_multicast", help="udp_multicast, or a bus INTERFACE:CHANNEL")
    parser.add_argument("--out", type=Path, help="keep everything here")
    parser.add_argument("--busy", action="store_true", help="keep all cores and the disk busy")
    parser.add_argument("--sweeps-only", action="store_true", help="end after calibrate --apply")
    options = parser.parse_args()
    top = options.out or Path(tempfile.mkdtemp(prefix="real-time-"))
    results, wrong = [], 0
    for seed in options.seeds:
        folder = top / f"seed{seed}"
        folder.mkdir(parents=True)
        bus = f"udp_multicast:{GROUP.format(seed % 200 + 10)}" if options.bus == "udp_multicast" else options.bus
        busy = keep_busy(folder) if options.busy else []
        print(f"seed {seed}, {bus}, {folder}", flush=True)
        run = Run(options.arm, bus, seed, folder)
        try:
            with run:
                run.work(options.sweeps_only)
            errors = run.found["errors"]
            run.found["ok"] = errors["gain"] < GAIN_BOUND and errors["offset"] < OFFSET_BOUND
        except Failed as failed:
            run.found |= {"ok": False, "failed": str(failed)}
        finally:
            for process in busy:
                process.kill()
        run.found["ok"] = run.found["ok"] and not run.found["false_statements"]
        wrong += not run.found["ok"]
        results.append(run.found)
    print(json.dumps(results, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
