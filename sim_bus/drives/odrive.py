"""Simulated ODrive axes (CANSimple, firmware 0.6): cyclic messages, cascade of position and velocity, watchdog."""

import math
from collections.abc import Callable
from functools import partial

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import REMOTE
from armlink.drives.odrive import frames
from armlink.drives.odrive.frames import AxisError, AxisState, Message, identifier, pack, unpack
from sim_bus.drives.motor import Motor
from sim_bus.drives.simulated_drive import BUS_VOLTAGE, MOTOR_TEMPERATURE, STAGE_TEMPERATURE, SimulatedDrive
from sim_bus.sim_section import serial_of

HEARTBEAT_PERIOD = 0.1
"""axis0.config.can.heartbeat_msg_rate_ms, by default 100 [s]."""
TORQUE_CONSTANT = 0.083
"""8.27/KV as its user typed it in [N·m/A]."""
CARRIED: dict[int, tuple[str, ...]] = {Message.ESTIMATES: ("position", "velocity"), Message.TORQUES: ("torque",)}
"""Quantities in its cyclic messages."""
RATES = {Message.HEARTBEAT: HEARTBEAT_PERIOD, Message.TEMPERATURE: 0.5}


class ODriveAxis(SimulatedDrive):
    def __init__(self, arm: ArmFile, joint: LinkJoint, motor: Motor, send: Callable[[int, bytes], None]) -> None:
        """As it was configured over USB: gains tuned, watchdog on, estimates and torques once a cycle in whole ms."""
        super().__init__(motor, send)
        link = arm.require_link()
        self.address: int = joint.settings.node
        self.serial = serial_of(arm, joint)
        self.state, self.errors, self.reason = AxisState.IDLE, 0, 0
        self.control_mode = frames.POSITION_CONTROL
        stiffness, damping, integral = motor.tuned
        self._position_gain, self._velocity_gain = stiffness / damping, damping
        """[1/s], [N·m·s/rad]."""
        self._integral_gain = integral / self._position_gain
        self._integral = 0.0
        self._velocity_limit, self._current_limit = 1e3, 3 * motor.rated_torque / abs(motor.ratio) / TORQUE_CONSTANT
        self._input = (0.0, 0.0, 0.0)
        """Position [rad], velocity [rad/s], torque [N·m]."""
        self._watchdog = link.deadline
        period = max(int(1000 / link.rate + 1e-9), 1) / 1000
        for message, each in {**RATES, Message.ESTIMATES: period, Message.TORQUES: period}.items():
            self.send_every(each, message)

    @property
    def patience(self) -> float:
        return self._watchdog

    def takes(self, can_id: int) -> bool:
        return (can_id & ~REMOTE) >> 5 == self.address

    def sends(self, can_id: int) -> bool:
        return can_id >> 5 == self.address

    def receive(self, can_id: int, data: bytes) -> None:
        command = can_id & 0x1F
        if can_id & REMOTE:
            self._send_message(command)
            return
        if command == Message.ESTOP:
            self._disarm(AxisError.ESTOP)
            return
        values = unpack(command, data)
        if values is None:
            return
        if command == Message.AXIS_STATE:
            self._request(int(values[0]))
        elif command == Message.CONTROLLER_MODE:
            if "mode.refused" not in self.faults:
                self.control_mode = int(values[0])
        elif command == Message.INPUT_POSITION:
            ahead = self.scale("torque")
            position, velocity, torque = values
            velocity, torque = velocity * frames.INPUT_FEED_FORWARD, torque * frames.INPUT_FEED_FORWARD
            self._take_input(position * math.tau * self.scale("position"), velocity * math.tau, torque * ahead)
        elif command == Message.INPUT_VELOCITY:
            self._take_input(self._input[0], values[0] * math.tau, values[1] * self.scale("torque"))
        elif command == Message.INPUT_TORQUE:
            self._take_input(self._input[0], 0.0, values[0] * self.scale("torque"))
        elif command == Message.LIMITS and all(math.isfinite(value) and value >= 0 for value in values):
            self._velocity_limit, self._current_limit = values[0] * math.tau, values[1]
        elif command == Message.POSITION_GAIN and math.isfinite(values[0]):
            self._position_gain = values[0]
        elif command == Message.VELOCITY_GAINS and all(math.isfinite(value) for value in values):
            self._velocity_gain, self._integral_gain = values[0] / math.tau, values[1] / math.tau
        elif command == Message.CLEAR_ERRORS and not self.latched:
            self.errors = AxisError.MISSING_ESTIMATE if "feedback.lost" in self.faults else 0

    def _take_input(self, position: float, velocity: float, torque: float) -> None:
        if not all(math.isfinite(value) for value in (position, velocity, torque)):
            return
        self._input, self.heard = (position, velocity, torque), self.now
        if self.state is AxisState.CLOSED_LOOP:
            self.control(0.0)

    def _request(self, state: int) -> None:
        if state == AxisState.IDLE:
            self.state = AxisState.IDLE
            self.motor.free()
        elif state == AxisState.CLOSED_LOOP and not self.errors:
            if self.state is not AxisState.CLOSED_LOOP:
                self._input, self._integral = (self.motor.position, 0.0, 0.0), 0.0
                self.heard, self.reason = self.now, 0
            self.state = AxisState.CLOSED_LOOP
            self.control(0.0)
        self._send_message(Message.HEARTBEAT)

    def _disarm(self, error: int) -> None:
        self.errors |= error
        self.reason = error
        self.state = AxisState.IDLE
        self.motor.free()

    def control(self, duration: float) -> None:
        """Cascade: velocity = feed-forward + gain · position error; torque by its error, with an integral term."""
        if self.state is not AxisState.CLOSED_LOOP:
            return
        position, velocity, torque = self._input
        limit = self._current_limit * TORQUE_CONSTANT
        if self.control_mode == frames.TORQUE_CONTROL:
            self._integral = 0.0
            self.motor.impede(0.0, 0.0, 0.0, 0.0, torque, limit)
        else:
            led = self.control_mode == frames.POSITION_CONTROL
            error = position - self.motor.position if led else 0.0
            most, wanted = self._velocity_limit, velocity + self._position_gain * error
            short = max(-most, min(most, wanted)) - self.motor.velocity
            moved = self._integral + self._integral_gain * short * duration
            self._integral = max(-limit, min(limit, moved))
            gain = self._velocity_gain
            if led and abs(wanted) < most:
                kp = gain * self._position_gain
                self.motor.impede(kp, gain, position, velocity, torque + self._integral, limit)
            else:
                self.motor.pace(gain, max(-most, min(most, wanted)), torque + self._integral, limit)

    # ---- messages

    def send_cyclic(self, frame: int) -> None:
        self.tell(partial(self._send_message, frame), CARRIED.get(frame, ()))

    def _send_message(self, command: int) -> None:
        motor, estimated, told = self.motor, "feedback.lost" not in self.faults, self.coded()
        content: dict[int, tuple[float, ...]] = {
            Message.VERSION: (2, 4, 4, 58, 0, 6, 10, 0),
            Message.HEARTBEAT: (self.errors, self.state, 0, 1),
            Message.ERROR: (self.errors, self.reason),
            Message.CURRENT: (motor.torque / TORQUE_CONSTANT,) * 2,
            Message.TEMPERATURE: (STAGE_TEMPERATURE, MOTOR_TEMPERATURE),
            Message.BUS: (BUS_VOLTAGE, 0.5),
        }
        if estimated:
            content[Message.ESTIMATES] = (told.position / math.tau, told.velocity / math.tau)
            content[Message.TORQUES] = (self._input[2], told.torque)
        values = content.get(command)
        if values is not None:
            self.answer(identifier(self.address, command), pack(Message(command), *values))

    # ---- faults

    def trip(self) -> None:
        self._disarm(AxisError.WATCHDOG)

    def reboot(self) -> None:
        self.state, self.errors, self.reason = AxisState.IDLE, 0, 0
        self.control_mode = frames.POSITION_CONTROL
        self.motor.free()

    def change_mode(self, mode: int) -> None:
        self.control_mode = mode

    def lose_feedback(self) -> None:
        self._disarm(AxisError.MISSING_ESTIMATE)
