"""Simulated RobStride drives in the private protocol."""

import math
from collections.abc import Callable

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import EXTENDED, REMOTE
from armlink.drives.mit_packing import NO_COMMAND, Grid, grid_of
from armlink.drives.robstride.frames import (
    FAULTS,
    IDENTITY_TARGET,
    MOTION_BITS,
    MOTION_MODE,
    NEVER_READ,
    OUR_ID,
    RANGES,
    TIMEOUT_UNIT,
    Feedback,
    RobStrideParameter,
    RunMode,
    Type,
    data_of,
    identifier,
    kind_of,
    pack_feedback,
    pack_value,
    unpack_motion,
    unpack_value,
)
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import BUS_VOLTAGE, MOTOR_TEMPERATURE, SimulatedDrive
from sim_bus.sim_section import serial_of

ENCODER_FAULT = 1 << FAULTS.index("encoder")
REPORT_PERIOD = 0.01
"""Period of active reports (type 24) [s]."""
READ_ONLY = frozenset(RobStrideParameter[name] for name in ("POSITION", "CURRENT", "VELOCITY", "BUS_VOLTAGE"))


class RobStrideDrive(SimulatedDrive):
    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        """As the maker delivers it: deadman off, motion mode."""
        super().__init__(motor, send)
        self.address, self.serial = joint.settings.id, serial_of(arm, joint)
        self._ranges = RANGES[joint.settings.model]
        self._stored: dict[int, float] = {
            RobStrideParameter.RUN_MODE: MOTION_MODE,
            0x7006: 0.0,
            0x700A: 0.0,
            RobStrideParameter.LIMIT_TORQUE: self._ranges.torque,
            0x7010: 0.17,
            0x7011: 0.012,
            0x7014: 0.1,
            0x7016: 0.0,
            0x7017: 2.0,
            RobStrideParameter.LIMIT_CURRENT: 16.0,
            0x701E: 40.0,
            0x701F: 6.0,
            0x7020: 0.02,
            0x7021: 0.1,
            RobStrideParameter.TIMEOUT: 0,
            RobStrideParameter.ZERO_STATE: 1,
        }
        self.parameters = dict(self._stored)
        self.mode, self.fault_bits = RunMode.RESET, 0
        self.command = NO_COMMAND
        self._host = OUR_ID
        self._report_from(math.inf)

    @property
    def coding(self) -> Grid:
        """By which it really codes and decodes."""
        return grid_of(self.miscoded(self._ranges), MOTION_BITS)

    @property
    def patience(self) -> float:
        return self.parameters[RobStrideParameter.TIMEOUT] * TIMEOUT_UNIT

    def takes(self, can_id: int) -> bool:
        return bool(can_id & EXTENDED) and not can_id & REMOTE and can_id & 0xFF == self.address

    def sends(self, can_id: int) -> bool:
        return bool(can_id & EXTENDED) and can_id >> 8 & 0xFF == self.address

    def receive(self, can_id: int, data: bytes) -> None:
        kind = kind_of(can_id)
        if len(data) != 8:
            return
        if kind != Type.MOTION:
            self._host = data_of(can_id) & 0xFF
        if kind == Type.IDENTITY:
            self.answer(
                identifier(Type.IDENTITY, self.address, IDENTITY_TARGET) | EXTENDED, self.serial.to_bytes(8, "little")
            )
        elif kind == Type.READ:
            self._read(int.from_bytes(data[:2], "little"))
        elif kind == Type.SAVE:
            self.flash_writes += 1
            self._stored = dict(self.parameters)
        elif kind == Type.REPORT:
            self._report_from(self.now + REPORT_PERIOD if data[6] == 1 else math.inf)
        elif kind in (Type.MOTION, Type.ENABLE, Type.STOP, Type.WRITE):
            self._obey(kind, can_id, data)
            self._feed_back(Type.FEEDBACK)

    def _obey(self, kind: int, can_id: int, data: bytes) -> None:
        if kind == Type.WRITE:
            self._write(int.from_bytes(data[:2], "little"), data[4:8])
            return
        self.heard = self.now
        if kind == Type.ENABLE:
            if not self.fault_bits and not self.latched and self.mode is not RunMode.RUN:
                self.mode, self.command = RunMode.RUN, NO_COMMAND
                self._follow()
        elif kind == Type.STOP:
            self._stop()
            if data[0] == 1 and "feedback.lost" not in self.faults:
                self.fault_bits = 0
        elif self.parameters[RobStrideParameter.RUN_MODE] == MOTION_MODE:
            self.command = unpack_motion(can_id, data, self.coding)
            if self.mode is RunMode.RUN:
                self._follow()

    def _follow(self) -> None:
        command = self.command
        limit = min(self.coding.ranges.torque, max(self.parameters[RobStrideParameter.LIMIT_TORQUE], 0.0))
        self.motor.impede(command.kp, command.kd, command.position, command.velocity, command.torque, limit)

    def _stop(self) -> None:
        self.mode, self.command = RunMode.RESET, NO_COMMAND
        self.motor.free()

    def _feed_back(self, kind: int) -> None:
        if "feedback.lost" in self.faults and not self.fault_bits:
            return

        def send() -> None:
            feedback = Feedback(self.address, self.fault_bits, self.mode, self.told(), MOTOR_TEMPERATURE)
            can_id, data = pack_feedback(feedback, self._host, self.coding, kind)
            self.answer(can_id | EXTENDED, data)

        self.tell(send)

    def _read(self, parameter: int) -> None:
        live = {
            RobStrideParameter.POSITION: self.motor.position,
            RobStrideParameter.VELOCITY: self.motor.velocity,
            RobStrideParameter.CURRENT: self.motor.torque,
            RobStrideParameter.BUS_VOLTAGE: BUS_VOLTAGE,
        }
        value = (live | self.parameters).get(parameter)
        unknown = NEVER_READ << 8 if value is None else 0
        head = identifier(Type.READ, unknown | self.address, self._host)
        content = bytes(4) if value is None else pack_value(parameter, value)
        self.answer(head | EXTENDED, parameter.to_bytes(2, "little") + bytes(2) + content)

    def _write(self, parameter: int, content: bytes) -> None:
        if parameter not in self.parameters or parameter in READ_ONLY:
            return
        if parameter == RobStrideParameter.RUN_MODE and (self.mode is RunMode.RUN or "mode.refused" in self.faults):
            return
        value = unpack_value(parameter, content)
        if math.isfinite(value):
            self.parameters[parameter] = value

    def _report_from(self, instant: float) -> None:
        """Send active reports from an instant on [s]; infinite: none."""
        self.send_every(REPORT_PERIOD, Type.REPORT, instant)

    def send_cyclic(self, frame: int) -> None:
        self._feed_back(frame)

    def trip(self) -> None:
        """Mode reset, free; no fault is reported."""
        self._stop()

    def reboot(self) -> None:
        self.parameters = dict(self._stored)
        self.fault_bits, self._host = 0, OUR_ID
        self._report_from(math.inf)
        self._stop()

    def change_mode(self, mode: int) -> None:
        self.parameters[RobStrideParameter.RUN_MODE] = mode

    def lose_feedback(self) -> None:
        """Encoder fault: free, with the bit set."""
        self.fault_bits |= ENCODER_FAULT
        self._stop()
