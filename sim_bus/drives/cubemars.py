"""Simulated CubeMars AK drives in MIT mode: replies without a state, CAN timeout by cycles of the drive's own loop."""

import math
from collections.abc import Callable

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.cubemars.frames import CubeMarsReply, pack_reply
from armlink.drives.mit_packing import NO_COMMAND, Grid, Special, grid_of, special_of, unpack_command
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import MOTOR_TEMPERATURE, WrappingDrive

LOOP_RATE = 40_000.0
"""Cycles of the drive's loop a second: those of the open firmware that it descends from, bgkatz/motorcontrol."""
ENCODER_FAULT = 5
ZEROING = 1.0
"""After its zero was set a drive answers nothing for so long [s]."""


class CubeMarsDrive(WrappingDrive):
    """One AK drive, with the CAN timeout that its arm file states."""

    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        super().__init__(motor, send)
        settings = joint.settings
        self.address: int = settings.id
        self.reply: int = settings.reply
        self.can_timeout: int = settings.can_timeout
        self._ranges = settings.ranges
        self.motor_mode, self.error = False, 0
        self._deaf_until = -math.inf

    @property
    def coding(self) -> Grid:
        return grid_of(self.miscoded(self._ranges))

    @property
    def patience(self) -> float:
        return self.can_timeout / LOOP_RATE

    def takes(self, can_id: int) -> bool:
        return can_id == self.address

    def sends(self, can_id: int) -> bool:
        return can_id == self.reply

    def receive(self, can_id: int, data: bytes) -> None:
        """A command; in another mode than MIT none is understood."""
        if len(data) != 8 or "drive.mode" in self.faults or self.now < self._deaf_until:
            return
        special = special_of(data)
        if special is Special.ENABLE:
            self.motor_mode = not self.error and not self.latched
        elif special is Special.DISABLE:
            self.motor_mode = False
        elif special is Special.SET_ZERO:
            self.zero, self._deaf_until = self.motor.position, self.now + ZEROING
            return
        elif special is None and self.motor_mode:
            self.command = unpack_command(data, self.coding)
        self.tell(self._answer)
        self.heard = self.now
        if self.motor_mode:
            self.follow()  # the command of before the mode was left included
        else:
            self.motor.free()

    def _answer(self) -> None:
        reply = CubeMarsReply(self.address, self.feedback(), int(MOTOR_TEMPERATURE + self.motor.heating), self.error)
        self.answer(self.reply, pack_reply(reply, self.coding))

    def trip(self) -> None:
        """CAN timeout: its command becomes one of no torque; motor mode goes on."""
        self.command = NO_COMMAND
        self.motor_mode = self.motor_mode and not self.latched
        self.motor.free()

    def reboot(self) -> None:
        self.motor_mode, self.command, self.error = False, NO_COMMAND, 0
        self.motor.free()

    def lose_feedback(self) -> None:
        """Encoder fault: out of motor mode."""
        self.error, self.motor_mode = ENCODER_FAULT, False
        self.motor.free()
