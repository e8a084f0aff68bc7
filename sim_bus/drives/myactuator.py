"""Simulated MyActuator RMD-X drives (V3 protocol): replies in the drive's coarse units, loops, time-out kept in flash.

Frames are coded here by the maker's manual V4.2 alone, apart from what codes them in the host.
"""

import math
import struct
from collections.abc import Callable

from armlink.arm_file import ArmFile, LinkJoint
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import BUS_VOLTAGE, MOTOR_TEMPERATURE, SimulatedDrive

CENTIDEGREE, DEGREE = math.radians(0.01), math.radians(1.0)
CENTIAMPERE = 0.01
SOFTWARE_DATE = 20220206
NO_LOOP, CURRENT_LOOP, SPEED_LOOP, POSITION_LOOP = 0, 1, 2, 3
"""Running modes, as command 70h tells them; 0 stands for none."""
STALL, ENCODER = 0x0002, 0x2000
"""Errors: of the first level, which only a restart ends; of the second, which ends by itself."""
KEPT = frozenset((0x20, 0x32, 0x43, 0x63, 0x64))
"""Commands that write the flash, besides that of the time-out."""


class MyActuatorDrive(SimulatedDrive):
    """With the time-out that its arm file states in its flash, gains tuned, no planned acceleration, and no brake."""

    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        super().__init__(motor, send)
        settings = joint.settings
        self.address: int = settings.id
        self.constant: float = settings.constant
        self.model = (settings.model or "X8S2V10").replace("-", "")[:7]
        self.timeout: float = settings.timeout_ms / 1000
        """[s]; 0: none."""
        self.mode, self.stalled, self.started = NO_LOOP, False, 0.0
        self._gains = motor.tuned
        self._limit = 3 * motor.rated_torque / abs(motor.ratio)
        """Of its current, as torque [N·m]."""
        self._torque = self._target = self._speed = self._integral = 0.0
        """Targets [N·m], [rad], [rad/s]; integral term of the position loop [N·m]."""
        self._most_speed = math.inf
        """[rad/s]."""
        self._was = (0.0, motor.position, 0.0)
        """When a step of the arm ended [s], the position then, and the mean speed in it."""

    # ---- bus

    @property
    def patience(self) -> float:
        return self.timeout

    def takes(self, can_id: int) -> bool:
        return can_id in (0x140 + self.address, 0x280)

    def sends(self, can_id: int) -> bool:
        return can_id == 0x240 + self.address

    def receive(self, can_id: int, data: bytes) -> None:
        if len(data) != 8:
            return
        command, self.heard = data[0], self.now
        if command == 0x76:
            self.reboot()
            return
        if command in (0x9C, 0xA1, 0xA2, 0xA4):
            self._obey(command, data)
            self.tell(lambda: self._reply(self._state(command)))
        elif command == 0x92:
            self.tell(lambda: self._reply(self._angle()), ("position",))
        elif command in (0x77, 0x78, 0x80, 0x81):  # it has no brake to release or to lock
            self._obey(command, data)
            self._reply(data)
        elif command in KEPT or command == 0xB3:
            self.flash_writes += 1
            if command == 0xB3:
                self.timeout = struct.unpack_from("<I", data, 4)[0] / 1000
            self._reply(data)
        else:
            self._read(command, data)

    def _read(self, command: int, data: bytes) -> None:
        runtime = round(1000 * (self.now - self.started))
        replies: dict[int, bytes] = {
            0x42: bytes([0x42, data[1]]) + bytes(6),
            0x70: bytes([0x70]) + bytes(6) + bytes([self.mode]),
            0x9A: struct.pack("<BbBBHH", 0x9A, self._temperature, 0, 1, round(10 * BUS_VOLTAGE), self.error),
            0xB1: struct.pack("<II", 0xB1, runtime & 0xFFFFFFFF),
            0xB2: struct.pack("<II", 0xB2, SOFTWARE_DATE),
            0xB5: b"\xb5" + self.model.encode().ljust(7, b"\0"),
        }
        if command in replies:
            self._reply(replies[command])

    def _reply(self, data: bytes) -> None:
        self.answer(0x240 + self.address, data)

    @property
    def _temperature(self) -> int:
        return int(MOTOR_TEMPERATURE + self.motor.heating)

    def _state(self, command: int) -> bytes:
        position, velocity, torque = self.coded()
        values = (torque / self.constant / CENTIAMPERE, velocity / DEGREE, position / DEGREE)
        within = (max(-0x7FFF, min(0x7FFF, round(each))) for each in values)
        return struct.pack("<Bbhhh", command, self._temperature, *within)

    def _angle(self) -> bytes:
        counts = round(self.coded().position / CENTIDEGREE)
        return struct.pack("<Ii", 0x92, max(-0x7FFFFFFF, min(0x7FFFFFFF, counts)))

    @property
    def speed(self) -> float:
        """The mean of a step, in which its many cycles follow a target that stands still, not that of its end."""
        return self._was[2]

    def pass_time(self, now: float) -> None:
        super().pass_time(now)
        then, before, _ = self._was
        if now > then:
            self._was = (now, self.motor.position, (self.motor.position - before) / (now - then))

    # ---- loops

    @property
    def error(self) -> int:
        return STALL * self.stalled | ENCODER * ("feedback.lost" in self.faults)

    def _obey(self, command: int, data: bytes) -> None:
        """Only without an error; a loop is entered by its command alone."""
        if command == 0x80:
            self._leave()
        elif command in (0x77, 0x78, 0x9C) or self.error or (command == 0x81 and not self.mode):
            return
        elif command == 0xA1:
            current = struct.unpack_from("<h", data, 4)[0] * CENTIAMPERE
            self.mode, self._torque = CURRENT_LOOP, current * self.constant * self.scale("torque")
        elif command == 0xA4:
            most, counts = struct.unpack_from("<Hi", data, 2)
            self._enter(POSITION_LOOP)
            self._target = counts * CENTIDEGREE * self.scale("position")
            self._most_speed = most * DEGREE or math.inf
        else:
            self._enter(SPEED_LOOP)
            speed = struct.unpack_from("<i", data, 4)[0] * CENTIDEGREE if command == 0xA2 else 0.0
            self._speed = speed * self.scale("velocity")
        self.control(0.0)

    def _enter(self, mode: int) -> None:
        if self.mode != mode:
            self.mode, self._target, self._most_speed = mode, self.motor.position, math.inf

    def _leave(self) -> None:
        self.mode, self._integral = NO_LOOP, 0.0
        self.motor.free()

    def control(self, duration: float) -> None:
        """PID on the position, whose speed is limited; a speed is held by a target that moves."""
        motor, (kp, kd, ki) = self.motor, self._gains
        if self.mode == CURRENT_LOOP:
            motor.impede(0.0, 0.0, 0.0, 0.0, self._torque, self._limit)
        elif self.mode != NO_LOOP:
            self._target += self._speed * duration * (self.mode == SPEED_LOOP)
            error = self._target - motor.position
            wanted = kp * error / kd
            pace = max(-self._most_speed, min(self._most_speed, wanted))
            change = ki * error if pace == wanted else kp * (pace - motor.velocity)
            self._integral = max(-self._limit, min(self._limit, self._integral + change * duration))
            if pace == wanted:
                motor.impede(kp, kd, self._target, 0.0, self._integral, self._limit)
            else:
                motor.pace(kd, pace, self._integral, self._limit)

    # ---- faults

    def trip(self) -> None:
        """Time-out of communication: off, and the next command acts at once; latched: it has stalled."""
        self.stalled = self.stalled or self.latched
        self._leave()

    def reboot(self) -> None:
        self.started, self.stalled = self.now, False
        self._leave()

    def lose_feedback(self) -> None:
        self._leave()
