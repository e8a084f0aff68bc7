"""Common part of simulated drives that are no CANopen nodes: motor, frames out, injected firmware faults."""

import math
from collections.abc import Callable, Sequence

from armlink.bus.port import CLASSICAL
from armlink.drives.mit_packing import NO_COMMAND, Grid, MitFeedback, Ranges
from sim_bus.drives.drive_faults import FALSE_READINGS, QUANTITIES, FalseReadings
from sim_bus.drives.motor import Motor

STAGE_TEMPERATURE, MOTOR_TEMPERATURE = 31.0, 33.0
"""Temperatures that every drive reports [°C]."""
BUS_VOLTAGE = 48.0


class SimulatedDrive:
    """One drive on one joint. A family's drive overrides what is addressed to it, and what commands and faults do."""

    def __init__(self, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        self.motor, self.joint = motor, motor.joint
        self.now = 0.0
        self.heard = 0.0
        """When its host last fed the watchdog [s]."""
        self.unplugged = False
        self.flash_writes = 0
        """Commands to write flash that it got."""
        self.faults: dict[str, float] = {}
        """Firmware faults in force, by id, with their values."""
        self.false, self._second = FalseReadings(), False
        """Falsehoods in force; whether the frame that is made now is a second node's."""
        self._send = send
        self._cyclic: dict[int, tuple[float, float]] = {}
        """Period and next instant of each frame that it sends by its own clock [s]."""
        self.own_period = math.inf
        """Shortest of these periods in force [s]; infinite where it sends nothing by its own clock."""

    # ---- bus

    def takes(self, can_id: int) -> bool:
        """Whether a frame of this identifier, with its flags, is addressed to it; here any, and receive() sifts."""
        return True

    def sends(self, can_id: int) -> bool:
        raise NotImplementedError

    def on_frame(self, can_id: int, data: bytes) -> None:
        """A frame that is addressed to it; lost where it is unplugged."""
        if not self.unplugged:
            self.receive(can_id, data)

    def receive(self, can_id: int, data: bytes) -> None:
        raise NotImplementedError

    def answer(self, can_id: int, data: bytes) -> None:
        if not self.unplugged:
            self._send(can_id | CLASSICAL * ("drive.classic" in self.faults), data)

    @property
    def speed(self) -> float:
        """Of its motor, as it measures it [rad/s]."""
        return self.motor.velocity

    def told(self) -> MitFeedback:
        """Position, velocity and torque of its motor, as its next frame tells them."""
        motor = self.motor
        true = MitFeedback(motor.position, self.speed, motor.torque)
        if not self.false.any:
            return true
        pairs = zip(QUANTITIES, true, strict=True)
        return MitFeedback(*(self.false.told(quantity, value, self._second) for quantity, value in pairs))

    def coded(self) -> MitFeedback:
        """As told(), for a drive that codes in fixed units: with the factors by which its coding differs."""
        position, velocity, torque = self.told()
        return MitFeedback(
            position / self.scale("position"), velocity / self.scale("velocity"), torque / self.scale("torque")
        )

    def tell(self, send: Callable[[], None], quantities: tuple[str, ...] = QUANTITIES) -> None:
        """Send a frame of readings by `send`; once more, where a second node sends in its name."""
        send()
        if self.false.repeated(quantities):
            self._second = True
            send()
            self._second = False

    # ---- time

    @property
    def patience(self) -> float:
        """Set time of the watchdog [s]; 0 or infinite where it is off."""
        return 0.0

    @property
    def due(self) -> float:
        """When the drive next acts by itself [s]."""
        patience = self.patience
        watchdog = self.heard + patience if patience and self.watches else math.inf
        return min([watchdog, *(instant for _, instant in self._cyclic.values())])

    @property
    def watches(self) -> bool:
        return self.motor.powered and "watchdog.off" not in self.faults

    def pass_time(self, now: float) -> None:
        """It is `now` [s]: watchdog and cyclic frames."""
        self.now = now
        self.motor.pass_time(now)
        if self.watches and self.patience and now - self.heard > self.patience:
            self.trip()
        for frame, (period, instant) in self._cyclic.items():
            if instant <= now + 1e-9:
                self._cyclic[frame] = (period, max(instant + period, now))
                self.send_cyclic(frame)

    def send_every(self, period: float, frame: int, first: float = 0.0) -> None:
        """Send a frame each `period` from the instant `first` on [s], by send_cyclic(); never where it is infinite."""
        self._cyclic[frame] = (period, first)
        self.own_period = min([each for each, instant in self._cyclic.values() if instant < math.inf], default=math.inf)

    def send_cyclic(self, frame: int) -> None:
        raise NotImplementedError

    def postpone(self, seconds: float) -> None:
        """Postpone the watchdog [s], because the simulated arm itself was late."""
        self.heard += seconds

    def control(self, duration: float) -> None:
        """Set the motor's law for the next `duration` [s], for drives with an integral term or a moving target."""

    # ---- faults

    def trip(self) -> None:
        raise NotImplementedError

    def reboot(self) -> None:
        """Power cycle: what is not in flash is lost; a latched fault ends."""
        raise NotImplementedError

    def inject(self, fault: str, value: float) -> None:
        """A firmware fault begins, or a falsehood."""
        if fault in FALSE_READINGS:
            self.false.begin(fault, value)
            return
        self.faults[fault] = value
        if fault in ("drive.trip", "drive.latched"):
            self.trip()
        elif fault == "feedback.lost":
            self.lose_feedback()
        elif fault == "drive.mode":
            self.change_mode(int(value))

    def lose_feedback(self) -> None:
        self.motor.free()

    def change_mode(self, mode: int) -> None:
        """It finds itself in another mode of control."""

    def end_faults(self) -> None:
        """All injected faults end; what they did stays until it is cleared by the host."""
        self.faults.clear()
        self.false.end()

    @property
    def latched(self) -> bool:
        """Whether nothing but a power cycle clears a trip."""
        return "drive.latched" in self.faults

    def scale(self, quantity: str) -> float:
        """Factor by which the drive's coding of `position`, `velocity` or `torque` differs from its registers."""
        return self.faults.get(f"scale.{quantity}", 1.0)

    def miscoded(self, ranges: Ranges) -> Ranges:
        """Ranges by which a drive with the MIT law really codes and decodes, whose registers tell `ranges`."""
        if not self.faults:
            return ranges
        position, velocity, torque = (self.scale(quantity) for quantity in ("position", "velocity", "torque"))
        return ranges._replace(
            position=ranges.position * position, velocity=ranges.velocity * velocity, torque=ranges.torque * torque
        )


class WrappingDrive(SimulatedDrive):
    """A drive with the MIT law whose position wraps within the range of its coding."""

    command = NO_COMMAND
    zero = 0.0
    """Where its position is zero [rad]."""

    @property
    def coding(self) -> Grid:
        """By which it really codes and decodes."""
        raise NotImplementedError

    def feedback(self) -> MitFeedback:
        told = self.told()
        return told._replace(position=self._wrapped(told.position))

    def follow(self) -> None:
        command, coding, position = self.command, self.coding, self.motor.position
        target = command.position + position - self._wrapped(position)
        self.motor.impede(command.kp, command.kd, target, command.velocity, command.torque, coding.ranges.torque)

    def _wrapped(self, position: float) -> float:
        largest = self.coding.ranges.position
        return (position - self.zero + largest) % (2 * largest) - largest


class Front:
    def __init__(self, drives: Sequence[SimulatedDrive]) -> None:
        self.drives = drives

    def on_frame(self, can_id: int, data: bytes) -> None:
        for drive in self.drives:
            if drive.takes(can_id):
                drive.on_frame(can_id, data)

    def joint_of(self, can_id: int) -> int | None:
        """Joint whose drive sends frames of this identifier, or None; None too where several share it."""
        found = [drive.joint for drive in self.drives if drive.sends(can_id)]
        return found[0] if len(found) == 1 else None
