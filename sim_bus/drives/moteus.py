"""Simulated moteus controllers: registers, position mode with PID, watchdog to zero velocity."""

import contextlib
import math
from collections.abc import Callable

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import EXTENDED, REMOTE
from armlink.drives.moteus.frames import (
    CYCLE_COMMAND,
    CYCLE_REPLY,
    FLOAT,
    HOMED_AT_OUTPUT,
    INT32,
    READ,
    READ_ERROR,
    REPLY,
    REPLY_WANTED,
    WRITE,
    WRITE_ERROR,
    MoteusMode,
    MoteusRegister,
    Subframe,
    identifier,
    pack_subframes,
    unpack,
)
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import BUS_VOLTAGE, MOTOR_TEMPERATURE, STAGE_TEMPERATURE, SimulatedDrive
from sim_bus.sim_section import serial_of

DEFAULT_TIMEOUT = 0.1
"""servo.default_timeout_s [s]."""
TIMEOUT_TORQUE = 5.0
"""servo.timeout_max_torque_Nm: largest torque of the zero-velocity mode [N·m]."""
TORQUE_CONSTANT = 0.55
"""Of the motor at its output [N·m/A]."""
ENCODER_FAULT = 35
NO_REGISTER = 1
COMMANDS = {
    MoteusRegister.COMMAND_POSITION: math.nan,
    MoteusRegister.COMMAND_VELOCITY: 0.0,
    MoteusRegister.COMMAND_TORQUE: 0.0,
    MoteusRegister.COMMAND_KP_SCALE: 1.0,
    MoteusRegister.COMMAND_KD_SCALE: 1.0,
    MoteusRegister.COMMAND_MAX_TORQUE: math.nan,
    MoteusRegister.COMMAND_STOP_POSITION: math.nan,
    MoteusRegister.COMMAND_WATCHDOG: math.nan,
    0x028: math.nan,
    0x029: math.nan,
    0x02A: math.nan,
    MoteusRegister.COMMAND_ILIMIT_SCALE: 1.0,
    0x02C: math.nan,
    0x02D: 0.0,
}
"""Registers of a position command with the values that a command without them has."""


class MoteusDrive(SimulatedDrive):
    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        """As configured for its joint: gains tuned, encoder at the output."""
        super().__init__(motor, send)
        self.address, self.serial = joint.settings.id, serial_of(arm, joint)
        self.mode, self.fault_code = MoteusMode.STOPPED, 0
        self.command: dict[int, float] = dict(COMMANDS)
        self._gains = motor.tuned
        self._target = self._integral = 0.0
        self._largest = 3 * motor.rated_torque

    @property
    def patience(self) -> float:
        """See SimulatedDrive; a command's watchdog of 0 or NaN stands for the default."""
        asked = self.command[MoteusRegister.COMMAND_WATCHDOG]
        return asked if asked > 0 else DEFAULT_TIMEOUT

    @property
    def watches(self) -> bool:
        return super().watches and self.mode is MoteusMode.POSITION

    def takes(self, can_id: int) -> bool:
        """The low seven bits are the destination, 7Fh is all; 29 bits with a prefix are for other devices."""
        number, destination = can_id & 0x1FFFFFFF, can_id & 0x7F
        return not can_id & REMOTE and (destination == 0x7F or (destination == self.address and number < 0x10000))

    def sends(self, can_id: int) -> bool:
        return can_id >> 8 & 0x7F == self.address and can_id & 0x1FFFFFFF < 0x10000

    def receive(self, can_id: int, data: bytes) -> None:
        source, replies = can_id >> 8 & 0x7F, can_id >> 8 & REPLY_WANTED
        usual = CYCLE_COMMAND.unpack(data) if replies else None
        if usual is not None:
            self._write(usual)
            if "feedback.lost" not in self.faults or self.fault_code:
                self.tell(lambda: self._reply(source, CYCLE_REPLY.pack(self._shown_in_cycles())))
            return
        frames = list(unpack(data))
        errors = self._write({each.register: each.value for each in frames if each.kind == WRITE})
        asked = [each for each in frames if each.kind == READ]
        if not replies or ("feedback.lost" in self.faults and not self.fault_code):
            return

        def reply() -> None:
            shown = self._shown_registers() if asked else {}
            self._reply(source, pack_subframes([*errors, *(_shown(each, shown) for each in asked)]))

        with contextlib.suppress(ValueError):  # more than a frame holds: the controller sends none
            self.tell(reply)

    def _reply(self, source: int, content: bytes) -> None:
        answer = identifier(self.address, source)
        self.answer(answer | EXTENDED * (answer > 0x7FF), content)

    # ---- registers

    def _write(self, values: dict[int, float]) -> list[Subframe]:
        """Take the registers of a frame; errors for those that cannot be written."""
        unknown = [number for number in values if number not in COMMANDS and number != MoteusRegister.MODE]
        if MoteusRegister.MODE in values and not values[MoteusRegister.MODE] > max(MoteusMode):  # else it is refused
            self.command = COMMANDS | {number: value for number, value in values.items() if number in COMMANDS}
            self._enter(int(values[MoteusRegister.MODE]) if math.isfinite(values[MoteusRegister.MODE]) else 0)
        else:
            known = {number: value for number, value in values.items() if number in COMMANDS}
            self.command |= known
        return [Subframe(WRITE_ERROR, number, NO_REGISTER) for number in unknown]

    def _shown_in_cycles(self) -> dict[int, float]:
        """Registers of the reply to a host's usual frame."""
        position, velocity, torque = self.coded()
        return {
            MoteusRegister.MODE: self.mode,
            MoteusRegister.POSITION: position / math.tau,
            MoteusRegister.VELOCITY: velocity / math.tau,
            MoteusRegister.TORQUE: torque,
            MoteusRegister.TEMPERATURE: STAGE_TEMPERATURE,
            MoteusRegister.FAULT: self.fault_code,
        }

    def _shown_registers(self) -> dict[int, float]:
        motor = self.motor
        return (
            self.command
            | self._shown_in_cycles()
            | {
                MoteusRegister.Q_CURRENT: motor.torque / TORQUE_CONSTANT,
                0x005: 0.0,
                0x006: motor.position / math.tau,
                0x007: 0.0,
                MoteusRegister.MOTOR_TEMPERATURE: MOTOR_TEMPERATURE,
                0x00B: 1,
                MoteusRegister.HOME_STATE: HOMED_AT_OUTPUT,
                MoteusRegister.VOLTAGE: BUS_VOLTAGE,
                MoteusRegister.MODEL: 1,
                MoteusRegister.FIRMWARE: 0x0104,
                MoteusRegister.SERIAL1: self.serial & 0x7FFFFFFF,
                MoteusRegister.SERIAL2: 0,
                MoteusRegister.SERIAL3: 0,
            }
        )

    # ---- modes

    def _enter(self, mode: int) -> None:
        if mode == MoteusMode.STOPPED:
            if "feedback.lost" not in self.faults and not self.latched:
                self.mode, self.fault_code = MoteusMode.STOPPED, 0
            self.motor.free()
        elif self.mode in (MoteusMode.FAULT, MoteusMode.TIMEOUT) or "mode.refused" in self.faults:
            return
        elif mode == MoteusMode.POSITION:
            self.heard = self.now
            if self.mode is not MoteusMode.POSITION:
                self._target, self._integral = self.motor.position, 0.0
            position = self.command[MoteusRegister.COMMAND_POSITION] * math.tau * self.scale("position")
            if math.isfinite(position):
                self._target = position
            self.mode = MoteusMode.POSITION
            self._follow()
        elif mode in (MoteusMode.ZERO_VELOCITY, MoteusMode.BRAKE):
            self.mode = MoteusMode(mode)
            self._damp()

    def control(self, duration: float) -> None:
        """PID with a target that moves at the commanded velocity."""
        if self.mode is not MoteusMode.POSITION:
            return
        command, (_, _, integral) = self.command, self._gains
        velocity = command[MoteusRegister.COMMAND_VELOCITY] * math.tau
        if math.isfinite(velocity):
            self._target += velocity * duration
        error, most = self._target - self.motor.position, self._torque_limit
        share = command[MoteusRegister.COMMAND_ILIMIT_SCALE] * command[MoteusRegister.COMMAND_KP_SCALE]
        self._integral = max(-most, min(most, self._integral + integral * error * duration)) if share > 0 else 0.0
        self._follow()

    @property
    def _torque_limit(self) -> float:
        asked = self.command[MoteusRegister.COMMAND_MAX_TORQUE]
        return min(abs(asked), self._largest) if math.isfinite(asked) else self._largest

    def _follow(self) -> None:
        command, (stiffness, damping, _) = self.command, self._gains
        kp = max(0.0, min(1.0, command[MoteusRegister.COMMAND_KP_SCALE]))
        kd = max(0.0, min(kp, command[MoteusRegister.COMMAND_KD_SCALE]))
        velocity, torque = command[MoteusRegister.COMMAND_VELOCITY] * math.tau, command[MoteusRegister.COMMAND_TORQUE]
        ahead = (torque if math.isfinite(torque) else 0.0) * self.scale("torque") + self._integral
        velocity = velocity if math.isfinite(velocity) else 0.0
        self.motor.impede(stiffness * kp, damping * kd, self._target, velocity, ahead, self._torque_limit)

    def _damp(self) -> None:
        self.motor.impede(0.0, self._gains[1], 0.0, 0.0, 0.0, TIMEOUT_TORQUE)

    def trip(self) -> None:
        """Position timeout: zero velocity, until a stop."""
        if self.mode is MoteusMode.POSITION:
            self.mode = MoteusMode.TIMEOUT
            self._damp()

    def reboot(self) -> None:
        self.mode, self.fault_code, self.command = MoteusMode.STOPPED, 0, dict(COMMANDS)
        self.motor.free()

    def change_mode(self, mode: int) -> None:
        self.mode = MoteusMode.BRAKE
        self._damp()

    def lose_feedback(self) -> None:
        self.mode, self.fault_code = MoteusMode.FAULT, ENCODER_FAULT
        self.motor.free()


def _shown(asked: Subframe, shown: dict[int, float]) -> Subframe:
    value = shown.get(asked.register)
    if value is None:
        return Subframe(READ_ERROR, asked.register, NO_REGISTER)
    whole = asked.register in (MoteusRegister.MODEL, MoteusRegister.FIRMWARE, MoteusRegister.SERIAL1)
    return Subframe(REPLY, asked.register, value, INT32 if whole and asked.resolution == FLOAT else asked.resolution)
