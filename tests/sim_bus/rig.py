"""A simulated arm behind raw frames, written out by hand: what the tests of this folder drive it with."""

import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, load_arm, parse_arm
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

Frame = tuple[int, bytes]
UNIT = 2 * np.pi / 2**20


def one_joint(**sim: Any) -> ArmFile:
    """A pendulum about a horizontal axis, stops at ±1 rad, rated 10 N·m, 1 kg at 0.2 m, no noise."""
    section: dict[str, Any] = {
        "links": [{"mass": 1.0, "com": [0.2, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]}],
        "sensors": {"noise": [0.0], "bits": 20},
    }
    content = {
        "name": "pendulum",
        "kinematics": {
            "gravity": [0.0, -9.81, 0.0],
            "joints": [{"name": "hinge", "lower": -1.0, "upper": 1.0}],
        },
        "link": {"joints": [{"name": "hinge", "node": 5, "rated_torque": 10.0, "max_torque": 20.0}]},
        "sim": {**section, **sim},
    }
    return parse_arm(content, Path("pendulum.yaml"))


class Hand:
    """A clock moved by hand."""

    time = 0.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, instant: float) -> None:
        self.time = max(self.time, instant)


class Rig:
    """One simulated arm and its frames."""

    def __init__(self, arm: ArmFile | str = "sarcos", truth: Truth | None = None, seed: int = 0) -> None:
        described = load_arm(arm) if isinstance(arm, str) else arm
        self.arm = SimulatedArm(described, truth or Truth.of(described), seed)
        self.bus = LockStepBus(arm=self.arm)
        self.nodes = [node.node_id for node in self.arm.nodes]
        self.rated = described.require_link().rated_torques
        self.position = np.zeros(len(self.nodes), int)
        self.torque = np.zeros(len(self.nodes))
        self.word = 0
        self.boot = self.drain()

    def drain(self) -> list[Frame]:
        frames = []
        while (frame := self.bus.take()) is not None:
            frames.append(frame)
        return frames

    def send(self, can_id: int, data: bytes) -> list[Frame]:
        self.bus.put(can_id, data)
        return self.drain()

    def sdo(self, node: int, request: bytes) -> bytes:
        frames = [data for can_id, data in self.send(0x600 + node, request) if can_id == 0x580 + node]
        assert len(frames) == 1
        return frames[0]

    def write(self, node: int, index: int, sub: int, value: bytes) -> bytes:
        command = 0x23 | (4 - len(value)) << 2
        return self.sdo(node, struct.pack("<BHB4s", command, index, sub, value))

    def read(self, node: int, index: int, sub: int = 0) -> bytes:
        answer = self.sdo(node, struct.pack("<BHB4x", 0x40, index, sub))
        assert answer[0] & 0xF0 == 0x40, answer.hex()
        return answer[4 : 8 - (answer[0] >> 2 & 3)]

    def cycle(self, torque: Sequence[int] | None = None) -> list[Frame]:
        """One SYNC period: RPDO1 of every node with the rig's word, torque [‰] and position [user units], then SYNC."""
        if torque is not None:
            self.torque = np.array(torque)
        for node, per_mille, position in zip(self.nodes, self.torque, self.position, strict=True):
            self.bus.put(0x200 + node, struct.pack("<Hhi", self.word, int(per_mille), int(position)))
        self.bus.put(0x80, b"")
        frames = self.drain()
        for can_id, data in frames:
            if 0x180 < can_id < 0x200:
                place = self.nodes.index(can_id - 0x180)
                self.reading_position[place], self.reading_torque[place] = struct.unpack("<ii", data)
        return frames

    def start(self, mode: int) -> None:
        """NMT start; into operation enabled in `mode`, holding where the arm stands."""
        self.reading_position, self.reading_torque = np.zeros(len(self.nodes), int), np.zeros(len(self.nodes))
        self.send(0, bytes([1, 0]))
        self.cycle()
        self.position = self.reading_position.copy()
        self.torque = np.rint(self.arm.plant.link_torque / self.rated * 1000)
        self.select(mode)
        for self.word in (0x06, 0x07, 0x0F):
            self.cycle()

    def select(self, mode: int) -> None:
        for node in self.nodes:
            self.bus.put(0x300 + node, bytes([mode]))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.004)):
            self.cycle()

    def status(self, node: int) -> int:
        return int(struct.unpack("<H", self.read(node, 0x6041))[0])


def wait_for(condition: Callable[[], Any], seconds: float = 20.0) -> bool:
    """Whether `condition` comes true; the time is that of a busy machine, not a bound."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True
