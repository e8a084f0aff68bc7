"""A drive family on a simulated arm without the link: set-up, walks and cycles with orders given by hand."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from armlink.arm_file import ArmFile, load_arm
from armlink.drives.board import Board
from armlink.drives.family import family
from armlink.drives.orders import Limits, Mode, Order, Power, Reading
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

STEP = 0.001


class Bench:
    """One family's drives of an arm, and the arm; also what `set_up` asks by."""

    def __init__(self, arm: str | ArmFile, seed: int = 0, truth: Truth | None = None) -> None:
        described = load_arm(arm) if isinstance(arm, str) else arm
        self.described, self.link = described, described.require_link()
        self.arm = SimulatedArm(described, truth or Truth.of(described), seed)
        self.simulated = [self.arm.device(joint) for joint in range(self.arm.n)]
        self.drives = family(self.link.joints[0].settings.family).build(described, self.link.joints)
        self.period = 1 / self.link.rate
        self.limits = [
            Limits(row.max_torque, row.max_torque_rate, row.max_velocity, -6.0, 6.0, self.link.deadline, self.period)
            for row in self.link.joints
        ]
        self.routes, self.latest = self.drives.routes(), [Reading(joint) for joint in range(self.arm.n)]
        self.board = Board(self.arm.n)
        self.fast = self.drives.fill(self.board, range(self.arm.n))
        self.log: list[tuple[int, bytes]] = []
        """Frames that the host sent."""
        self.heard: list[tuple[int, bytes]] = []
        """The last frames of the drives."""

    # ---- Ask

    def __call__(self, frame, answer: Callable, timeout: float = 0.1, tries: int = 3):
        for _ in range(tries):
            self.send(*frame)
            end = self.arm.time + timeout
            while True:
                found = None
                for came in self._received():
                    told = answer(*came) if found is None else None
                    if told is None:
                        self.hear(*came)
                    else:
                        found = told
                if found is not None:
                    return found
                if self.arm.time >= end - 1e-9:
                    break
                self.arm.advance(STEP)
        return None

    def send(self, can_id: int, data: bytes) -> None:
        self.log.append((can_id, data))
        self.arm.on_frame(can_id, data)

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        end = self.arm.time + timeout
        while not done() and self.arm.time < end:
            self.arm.advance(STEP)
            self.listen()
        return done()

    def now(self) -> float:
        return self.arm.time

    # ---- cycles

    def _received(self):
        while self.arm.outbox:
            frame = self.arm.outbox.popleft()
            self.heard = [*self.heard[-60:], frame]
            yield frame

    def hear(self, can_id: int, data: bytes) -> None:
        if can_id in self.fast:
            self.fast[can_id](data)
            for joint, position in enumerate(self.board.position):
                if position == position:
                    self.latest[joint] = self.latest[joint]._replace(position=position)
            self.board.drop()
        elif can_id in self.routes or -1 in self.routes:
            reading = self.drives.take(can_id, data, self.arm.time)
            if reading is not None:
                old = self.latest[reading.joint]
                kept = [new if _tells(new) else before for new, before in zip(reading, old, strict=True)]
                self.latest[reading.joint] = Reading(*kept)

    def listen(self) -> None:
        for frame in self._received():
            self.hear(*frame)

    def set_up(self):
        setups = self.drives.set_up(self, self.limits)
        if self.fast:  # its frames do not pass `take`: readings as the set-up found them
            self.latest = [Reading(joint, each.position) for joint, each in enumerate(setups)]
            self.fast = self.drives.fill(self.board, range(self.arm.n))
        self.latest = [  # a walk begins where a joint stands, as the link's does
            reading if math.isfinite(reading.position) else reading._replace(position=each.position)
            for reading, each in zip(self.latest, setups, strict=True)
        ]
        return setups

    def cycle(self, orders: Sequence[Order | None]) -> list:
        sent = self.drives.frames(orders, self.arm.time)
        for frame in sent:
            self.send(*frame)
        self.listen()
        self.arm.advance(self.period)
        self.listen()
        return sent

    def order(
        self, joint: int, mode: int = Mode.POSITION, torque: float = 0.0, position=None, power=Power.ON, walk=False
    ):
        settings = self.link.joints[joint].settings
        stiff = mode == Mode.POSITION
        kp, kd = (getattr(settings, "kp", 0.0), getattr(settings, "kd", 0.0)) if stiff else (0.0, 0.0)
        at = self.latest[joint].position if position is None else position
        return Order(power, walk, mode, at, 0.0, torque, kp, kd)

    def walk(self, power: Power = Power.ON, seconds: float = 1.0) -> bool:
        held = [reading.position for reading in self.latest]
        for _ in range(round(seconds / self.period)):
            position = [h if math.isfinite(h) else self.latest[j].position for j, h in enumerate(held)]
            self.cycle([self.order(j, power=power, walk=True, position=position[j]) for j in range(self.arm.n)])
            if all(self.drives.power(j) is power for j in range(self.arm.n)):
                return True
        return False

    def at_joint(self, joint: int, drive_side: float) -> float:
        settings = self.link.joints[joint].settings
        return (drive_side - settings.zero) / (settings.direction * settings.gear)

    @property
    def position(self) -> np.ndarray:
        return np.array([reading.position for reading in self.latest])

    @property
    def powered(self) -> list[bool]:
        return [device.motor.powered for device in self.simulated]


def _tells(value) -> bool:
    return value is not None and value == value
