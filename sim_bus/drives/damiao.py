"""Simulated Damiao drives: registers, MIT mode, state nibble, TIMEOUT register."""

import struct
from collections.abc import Callable

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.damiao.frames import (
    INTEGER_REGISTERS,
    MIT_MODE,
    MODELS,
    OTHER_MODES,
    READ,
    REFRESH,
    REGISTERS_ID,
    TIMEOUT_UNIT,
    WRITE,
    DamiaoRegister,
    DamiaoReply,
    DamiaoStatus,
    pack_reply,
    pack_value,
    unpack_value,
)
from armlink.drives.mit_packing import NO_COMMAND, Grid, Ranges, Special, grid_of, special_of, unpack_command
from armlink.errors import BadInput
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import MOTOR_TEMPERATURE, STAGE_TEMPERATURE, WrappingDrive
from sim_bus.sim_section import serial_of

LEAST_RANGE = 1e-3
"""A range register of 0 counts as this."""
STORE = 0xAA
STAGE = int(STAGE_TEMPERATURE)
WRITABLE = frozenset((0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34, 35))


class DamiaoDrive(WrappingDrive):
    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        """As the maker delivers it, but for the ids: the deadman is off, the mode is MIT."""
        super().__init__(motor, send)
        settings = joint.settings
        if settings.model not in MODELS:
            raise BadInput(
                f"{arm.path}: {joint.name}: drive.model {settings.model!r} cannot be simulated; the "
                f"simulated models are {', '.join(MODELS)}"
            )
        position, velocity, torque, _, _ = MODELS[settings.model]
        drive, reply, serial = settings.id, settings.reply, serial_of(arm, joint)
        self._taken = frozenset(drive + offset for offset in (0, *OTHER_MODES)) | {REGISTERS_ID}
        self._stored: dict[int, float] = {
            0: 15.0, 1: 1.2, 2: 100.0, 3: 0.95, 4: 50.0, 5: -50.0, 6: 200.0, 7: reply, 8: drive, 9: 0, 10: MIT_MODE,
            11: 1e-4, 12: 1e-4, 13: 3, 14: 5016, 15: serial, 16: 14, 17: 0.6, 18: 4e-4, 19: 0.005, 20: 10.0,
            21: position, 22: velocity, 23: torque, 24: 1000.0, 25: 0.004, 26: 0.002, 27: 50.0, 28: 1.0, 29: 60.0,
            30: 1.0, 31: 4.0, 32: 100.0, 33: 1000.0, 34: 1000.0, 35: 4, 36: 1, 50: 0.0, 51: 0.0, 52: 0.0, 53: 0.0,
            54: 0.0, 55: 1.0, 56: 0.0, 59: 40.0, 60: 48.0, 61: STAGE_TEMPERATURE, 62: MOTOR_TEMPERATURE, 63: 0.0,
            64: 0.0, 65: 0.0, 80: 0.0, 81: 0.0,
        }  # fmt: skip
        self.registers = dict(self._stored)
        self.state = DamiaoStatus.DISABLED
        self._coded: object = None
        """Source of `coding`."""
        self._coding = grid_of(Ranges(position, velocity, torque))

    @property
    def coding(self) -> Grid:
        registers, faults = self.registers, self.faults
        told = (registers[21], registers[22], registers[23])
        made_of = (told, tuple(faults.items()) if faults else ())
        if made_of != self._coded:
            self._coded = made_of
            self._coding = grid_of(self.miscoded(Ranges(*(max(each, LEAST_RANGE) for each in told))))
        return self._coding

    @property
    def patience(self) -> float:
        return self.registers[DamiaoRegister.TIMEOUT] * TIMEOUT_UNIT

    def takes(self, can_id: int) -> bool:
        return can_id in self._taken

    def sends(self, can_id: int) -> bool:
        return can_id == self.registers[DamiaoRegister.REPLY_ID]

    def receive(self, can_id: int, data: bytes) -> None:
        """A command, or a register request that names this drive."""
        if len(data) != 8:
            return
        if can_id == REGISTERS_ID:
            self._register(data)
            return
        special = special_of(data)
        if special is not None:
            self._obey(special)
        elif can_id == self.registers[DamiaoRegister.COMMAND_ID] and self.registers[10] == MIT_MODE:
            self.command = unpack_command(data, self.coding)
        self.heard = self.now
        if self.state is DamiaoStatus.ENABLED:
            self.follow()
        self._reply()

    def _obey(self, special: Special) -> None:
        if special is Special.ENABLE and self.state is DamiaoStatus.DISABLED:
            self.state, self.command = DamiaoStatus.ENABLED, NO_COMMAND
        elif (special is Special.DISABLE and self.state is DamiaoStatus.ENABLED) or (
            special is Special.CLEAR_ERROR and self.state is not DamiaoStatus.ENABLED and not self.latched
        ):
            self._stop(DamiaoStatus.DISABLED)

    def _stop(self, state: DamiaoStatus) -> None:
        self.state, self.command = state, NO_COMMAND
        self.motor.free()

    def _reply(self) -> None:
        if "feedback.lost" in self.faults:
            return
        self.tell(self._feed_back)

    def _feed_back(self) -> None:
        drive, warm = int(self.registers[DamiaoRegister.COMMAND_ID]), int(MOTOR_TEMPERATURE + self.motor.heating)
        reply = DamiaoReply(drive, self.state, self.feedback(), STAGE, warm)
        self.answer(int(self.registers[DamiaoRegister.REPLY_ID]), pack_reply(reply, self.coding))

    def _register(self, data: bytes) -> None:
        drive, request, register = struct.unpack_from("<HBB", data)
        if drive != self.registers[DamiaoRegister.COMMAND_ID]:
            return
        reply_id = int(self.registers[DamiaoRegister.REPLY_ID])
        if request == REFRESH:
            self._reply()
        elif request == STORE:
            self.flash_writes += 1
            self._stored = dict(self.registers)
        elif register in self.registers and request in (READ, WRITE):
            if request == WRITE and register in WRITABLE:
                self._write(register, unpack_value(register, data[4:]))
            value = pack_value(register, self.registers[register])
            self.answer(reply_id, struct.pack("<HBB4s", drive, request, register, value))

    def _write(self, register: int, value: float) -> None:
        if register in INTEGER_REGISTERS:
            value = int(value)
        if register == DamiaoRegister.CONTROL_MODE:
            if "mode.refused" in self.faults or value not in (1, 2, 3, 4):
                return
            self.command = NO_COMMAND
            if self.state is DamiaoStatus.ENABLED:
                self.follow()
        if register in (21, 22, 23) and not 0.0 < value < 1e6:
            return
        self.registers[register] = value

    def trip(self) -> None:
        """Torque off, state D, until the error is cleared."""
        self._stop(DamiaoStatus.LOST_COMMUNICATION)

    def reboot(self) -> None:
        self.registers = dict(self._stored)
        self._stop(DamiaoStatus.DISABLED)

    def change_mode(self, mode: int) -> None:
        self.registers[DamiaoRegister.CONTROL_MODE] = mode

    def lose_feedback(self) -> None:
        """Replies stop; the drive itself goes on."""
