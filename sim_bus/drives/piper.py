"""A simulated AgileX Piper arm: one controller for its joints, which sends by its own clock and has no time-out.

Frames are coded here by piper_sdk's `protocol_v2` alone, apart from what codes them in the host. Joints 1 to 3 make
four times the torque of an MIT command up to firmware S-V1.8-2, and their currents tell of four times what they make.
"""

import math
import struct
from collections.abc import Callable, Sequence

from armlink.arm_file import ArmFile, LinkJoint
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import BUS_VOLTAGE, MOTOR_TEMPERATURE, STAGE_TEMPERATURE, Front, SimulatedDrive

MILLIDEGREE, MILLI = math.radians(0.001), 0.001
MOTION_PERIOD, STATE_PERIOD = 0.005, 0.025
"""Of motion and positions, and of states [s]."""
FASTEST = 3.14
"""Speed of a way to a target at 100 % [rad/s]."""
STOP_DAMPING = 0.5
"""Share of a joint's damping with which an emergency stop lets it sink."""
NEWTON_METERS = (1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844)
"""By the ampere, as the SDK converts currents."""
MIT, MOVE_M, TARGETS = 0xAD, 4, 1
MOST_COUNTS = 0x7FFFFFFF
"""Of a position, a whole number of 32 bits [0.001°]."""
ENCODER = 0x20
"""Bit of a joint's state: its drive has an error."""


class PiperJoint(SimulatedDrive):
    def __init__(self, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        super().__init__(motor, send)
        settings = joint.settings
        self.number: int = settings.joint
        self.firmware: str = settings.firmware
        old = [int(each) for each in self.firmware[3:].replace("-", ".").split(".")] <= [1, 8, 2]
        self.amplified = 4.0 if old and self.number <= 3 else 1.0
        self.arm: dict[int, PiperJoint] = {}
        """All joints, by number."""
        self.enabled, self.stopped, self.mode, self.share = False, False, 0, 1.0
        """Emergency stop in force; how it moves; share of the greatest speed."""
        self._law = (0.0, 0.0, 0.0, 0.0, 0.0)
        """kp, kd, position, velocity, torque of the newest MIT command."""
        self._goal = self._target = self._integral = 0.0
        self._motion_id, self._state_id = 0x250 + self.number, 0x260 + self.number
        self.send_every(MOTION_PERIOD, self._motion_id)
        self.send_every(STATE_PERIOD, self._state_id)

    # ---- bus

    def takes(self, can_id: int) -> bool:
        own = (0x155 + (self.number - 1) // 2, 0x159 + self.number)
        return can_id in (0x150, 0x151, 0x471, 0x475, *own) or (can_id == 0x4AF and self.number == min(self.arm))

    def sends(self, can_id: int) -> bool:
        return can_id in (self._motion_id, self._state_id)

    def receive(self, can_id: int, data: bytes) -> None:
        if len(data) != 8:
            return
        if can_id == 0x4AF:
            self._tell_firmware()
        elif can_id == 0x150:
            self._stop(data[0])
        elif can_id == 0x151:
            mit = data[3] == MIT or data[1] == MOVE_M
            self.mode, self.share = (MIT if mit else TARGETS) if data[0] == 1 else 0, min(data[2], 100) / 100
        elif can_id == 0x471 and data[0] in (self.number, 0xFF):
            self._enable(data[1] == 2)
        elif can_id == 0x159 + self.number:
            self._take_mit(data)
        elif can_id in range(0x155, 0x158):
            counts = struct.unpack(">ii", data)[(self.number - 1) % 2]
            self._goal = counts * MILLIDEGREE * self.scale("position")
            if self.mode == TARGETS:
                self.control(0.0)

    def _take_mit(self, data: bytes) -> None:
        bits, check = int.from_bytes(data, "big"), 0
        for byte in data[:7]:
            check ^= byte
        if bits & 0xF != check & 0xF or self.mode != MIT:
            return
        steps = (bits >> 48, bits >> 36 & 0xFFF, bits >> 24 & 0xFFF, bits >> 12 & 0xFFF, bits >> 4 & 0xFF)
        position, velocity = steps[0] / 65535 * 25 - 12.5, steps[1] / 4095 * 90 - 45
        kp, kd = steps[2] / 4095 * 500, max(steps[3] / 4095 * 10 - 5, 0.0)
        torque = (steps[4] / 255 * 16 - 8) * self.amplified
        self._law = (kp, kd, position * self.scale("position"), velocity, torque * self.scale("torque"))
        self.control(0.0)

    def _tell_firmware(self) -> None:
        text = f"H-V1.2-1\0{self.firmware}\0".encode()
        for place in range(0, len(text), 8):
            self.answer(0x4AF, text[place : place + 8].ljust(8, b"\0"))

    # ---- time

    def send_cyclic(self, frame: int) -> None:
        if frame == self._state_id:
            self.answer(frame, self._state())
        else:
            self.tell(self._send_motion)

    def _send_motion(self) -> None:
        _, velocity, torque = self.coded()
        values = (velocity, torque / (NEWTON_METERS[self.number - 1] / self.amplified))
        within = (max(-0x7FFF, min(0x7FFF, round(each / MILLI))) for each in values)
        self.answer(self._motion_id, struct.pack(">hhi", *within, 0))
        if self.number == min(self.arm):
            stopped = int(self.stopped)
            self.answer(
                0x2A1, struct.pack(">6BH", int(self.mode != 0), stopped, MOVE_M * (self.mode == MIT), 0, 0, 0, 0)
            )
        first = self.number - (self.number - 1) % 2
        plugged = [each for each in (first, first + 1) if each in self.arm and not self.arm[each].unplugged]
        if self.number == max(plugged, default=0):
            pair = (self.arm.get(number) for number in (first, first + 1))
            counts = (0 if each is None else each.position_counts() for each in pair)
            self.answer(0x2A5 + (first - 1) // 2, struct.pack(">ii", *counts))

    def position_counts(self) -> int:
        counts = round(self.coded().position / MILLIDEGREE)
        return max(-MOST_COUNTS, min(MOST_COUNTS, counts))

    def _state(self) -> bytes:
        bits = 0x40 * self.enabled | ENCODER * ("feedback.lost" in self.faults)
        temperature = int(MOTOR_TEMPERATURE + self.motor.heating)
        return struct.pack(">HhbBH", round(10 * BUS_VOLTAGE), int(STAGE_TEMPERATURE), temperature, bits, 0)

    # ---- loops

    def _enable(self, on: bool) -> None:
        if on and not self.enabled and "feedback.lost" not in self.faults:
            self.enabled, self._integral = True, 0.0
            self._goal = self._target = self.motor.position
            self._law = (0.0, 0.0, 0.0, 0.0, 0.0)
            self.control(0.0)
        elif not on:
            self.enabled = False
            self.motor.free()

    def _stop(self, how: int) -> None:
        if how == 1:
            self.stopped = True
            self.control(0.0)
        elif how == 2:
            self.stopped, self.mode = False, 0
            self._enable(False)

    def control(self, duration: float) -> None:
        motor, (kp, kd, ki) = self.motor, self.motor.tuned
        if not self.enabled:
            return
        if self.stopped:
            motor.impede(0.0, STOP_DAMPING * kd, 0.0, 0.0, 0.0)
        elif self.mode == MIT:
            motor.impede(*self._law)
        else:
            way = FASTEST * self.share * duration
            self._target += max(-way, min(way, self._goal - self._target))
            self._integral += ki * (self._target - motor.position) * duration
            motor.impede(kp, kd, self._target, 0.0, self._integral)

    # ---- faults

    def trip(self) -> None:
        """It has no time-out that could trip."""

    def reboot(self) -> None:
        self.stopped, self.mode = False, 0
        self._enable(False)

    def lose_feedback(self) -> None:
        self._enable(False)


def build(arm: ArmFile, joints: Sequence[tuple[LinkJoint, Motor]], send: Callable[[int, bytes], None]) -> Front:
    drives = [PiperJoint(joint, motor, send) for joint, motor in joints]
    for drive in drives:
        drive.arm = {each.number: each for each in drives}
    return Front(drives)
