"""A simulated arm on a real bus, in a process of its own, that tells how its joints truly move.

    python witnessed_arm.py ARM BUS REPORT

REPORT gets a line of JSON about ten times a second: time by the machine's monotonic clock [s], fastest true joint speed
since the line before [rad/s], torque on or off, and true angles [rad].
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from armlink.arm_file import load_arm
from armlink.bus.open import open_link_bus
from armlink.drives.canopen.cia402 import DriveState
from sim_bus.bus.server import ArmServer
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

EVERY = 0.1
"""Simulated time between two lines [s]."""


@dataclass(frozen=True)
class Motion:
    """What the joints truly did for a while."""

    fastest: float
    """[rad/s]."""
    moved: float
    """Farthest that a joint ended from where it began [rad]."""
    powered: bool
    """Whether some joint has power at the end."""


class Witness:
    """Reads the report of a witnessed arm."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def motion(self, since: float = 0.0, until: float = float("inf")) -> Motion:
        """Between two times by the machine's monotonic clock [s]."""
        lines = [json.loads(line) for line in self.path.read_text().splitlines()[:-1] if line]
        lines = [line for line in lines if since <= line["t"] <= until]
        angles = np.array([line["angles"] for line in lines])
        return Motion(
            max(line["fastest"] for line in lines), float(np.abs(angles[-1] - angles[0]).max()), lines[-1]["powered"]
        )


@contextlib.contextmanager
def witnessed(arm: Path, bus: str, report: Path) -> Iterator[Witness]:
    """The arm's process; ready when entered."""
    report.write_text("")
    with subprocess.Popen([sys.executable, __file__, str(arm), bus, str(report)]) as process:
        try:
            end = time.monotonic() + 30
            while report.read_text().count("\n") < 2:
                assert process.poll() is None
                assert time.monotonic() < end
                time.sleep(0.05)
            yield Witness(report)
        finally:
            process.terminate()
            process.wait(timeout=30)


def powered(arm: SimulatedArm) -> bool:
    """Whether some joint is under power."""
    states = [arm.drives.state[node.place] for node in arm.nodes]
    return DriveState.ENABLED in states or any(drive.motor.powered for drive in arm.drive_at.values())


def main(path: str, bus: str, report: str) -> int:
    """Serve until SIGTERM."""
    mujoco.set_mjcb_time(lambda: 0.0)
    with contextlib.suppress(OSError):  # drives keep their time, whatever else this machine has to do
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    described = load_arm(path)
    arm = SimulatedArm(described, Truth.of(described), 1)
    end_of_bus = open_link_bus(bus, described.require_link())
    server = ArmServer(arm, end_of_bus)
    advance, fastest, due = arm.advance, 0.0, 0.0
    with open(report, "a", buffering=1, encoding="utf-8") as out:

        def witness(duration: float) -> None:
            nonlocal fastest, due
            advance(duration)
            fastest = max(fastest, float(np.abs(arm.plant.velocity).max()))
            if arm.time >= due:
                row = {"t": time.monotonic(), "fastest": fastest, "powered": powered(arm)}
                out.write(json.dumps({**row, "angles": arm.plant.position.tolist()}) + "\n")
                fastest, due = 0.0, arm.time + EVERY

        arm.advance = witness  # type: ignore[method-assign]
        try:
            return server.run()
        finally:
            end_of_bus.shutdown()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
