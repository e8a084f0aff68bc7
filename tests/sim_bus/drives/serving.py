"""One simulated pendulum whose drive is of any family, served in real time on a virtual bus of python-can."""

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import can
from rig import wait_for as wait_for

from armlink.arm_file import ArmFile, Bus, parse_arm
from armlink.bus.open import open_bus
from sim_bus.bus.server import ArmServer
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

CHANNELS = count()
GRAVITY_TORQUE = 1.0 * 9.81 * 0.2
"""Largest torque of the pendulum [N·m]."""
KINEMATICS: dict[str, Any] = {
    "gravity": [9.81, 0.0, 0.0],
    "joints": [{"name": "hinge", "lower": -2.0, "upper": 2.0}],
}
"""Of the pendulum."""


def drives(kd: float) -> dict[str, dict[str, Any]]:
    """Settings of one drive of every family but CANopen; `kd` is the damping of those that take one."""
    return {
        "damiao": {"family": "damiao", "id": 2, "reply": 0x12, "model": "DM4340", "kp": 40, "kd": kd},
        "cubemars": {"family": "cubemars", "id": 2, "model": "AK80-9", "can_timeout": 10_000, "kp": 40, "kd": kd},
        "robstride": {"family": "robstride", "id": 3, "model": "RS01", "kp": 40, "kd": kd},
        "moteus": {"family": "moteus", "id": 4},
        "odrive": {"family": "odrive", "node": 5},
        "myactuator": {"family": "myactuator", "id": 1, "model": "X8-25", "timeout_ms": 250},
    }


def pendulum(drive: dict[str, Any], **link: Any) -> ArmFile:
    """A pendulum that hangs at 0 and may swing to ±2 rad, 1 kg at 0.2 m, no noise, no friction."""
    content = {
        "name": "pendulum",
        "kinematics": KINEMATICS,
        "link": {"joints": [{"name": "hinge", "drive": drive, "rated_torque": 10.0, "max_torque": 20.0}], **link},
        "sim": {
            "links": [{"mass": 1.0, "com": [0.2, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]}],
            "sensors": {"noise": [0.0], "bits": 20},
            "start": [0.0],
        },
    }
    return parse_arm(content, Path("pendulum.yaml"))


class Served:
    """The arm in its thread; `drive` is the simulated drive."""

    def __init__(self, arm: ArmFile, fd: bool, bus: Bus | None = None) -> None:
        self.channel, self.fd = f"drives-{next(CHANNELS)}", fd
        self.arm = SimulatedArm(arm, Truth.of(arm))
        self.drive = self.arm.device(0)
        self._bus = open_bus(None, bus or Bus(interface="virtual", channel=self.channel, fd=fd))
        self._server = ArmServer(self.arm, self._bus)
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ends.is_set():
            while not self._jobs.empty():
                self._jobs.get()()
            self._server.turn()

    def inject(self, fault: str, value: float = 0.0) -> None:
        """A firmware fault."""
        self.do(lambda: self.drive.inject(fault, value))

    def do(self, action: Callable[[], None]) -> None:
        """Do something to the arm, in its thread."""
        done = threading.Event()
        self._jobs.put(lambda: (action(), done.set()))
        assert done.wait(10.0)

    def client(self) -> can.BusABC:
        """A bus of python-can's own for a client."""
        protocol = can.CanProtocol.CAN_FD if self.fd else can.CanProtocol.CAN_20
        return can.Bus(interface="virtual", channel=self.channel, protocol=protocol)

    @property
    def angle(self) -> float:
        """True joint angle [rad]."""
        return float(self.arm.plant.position[0])

    def close(self) -> None:
        self._ends.set()
        self._thread.join(10.0)
        self._bus.shutdown()


@contextmanager
def served(drive: dict[str, Any], fd: bool = False, bus: Bus | None = None, **link: Any) -> Iterator[Served]:
    """By default on a virtual bus of its own; `link` are further keys of the arm file."""
    served = Served(pendulum(drive, bus={"interface": "virtual", "fd": fd}, **link), fd, bus)
    try:
        yield served
    finally:
        served.close()
