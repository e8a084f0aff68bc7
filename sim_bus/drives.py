"""The joints' drives: CiA 402 states, modes and the position loop, for all joints at once.

The motor torque is `drive − stiffness·q − damping·q̇`, clamped to the max torque (6072h); the plant evaluates it at every
step of the physics. In position modes `drive = stiffness·target + damping·target rate + integral`, in torque modes it is
the target torque. A change of mode is bumpless: torque starts at what the joint now transmits, position at where it is.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from armlink.armfile import ArmFile
from sim_bus.cia402 import STATUS, Command, State, command, next_state
from sim_bus.plant import Plant
from sim_bus.section import sim_section
from sim_bus.sensors import Sensors
from sim_bus.signals import Signals

Array = NDArray[np.float64]
FEED = 1 << 20
"""User units a joint revolution (6092h)."""
UNIT = 2 * np.pi / FEED
PROFILE_POSITION, PROFILE_TORQUE, CSP, CSV, CST = 1, 4, 8, 9, 10
SUPPORTED_MODES = 1 << 7 | 1 << 8 | 1 << 9
"""6502h: CSP, CSV and CST."""
OFF, TORQUE, POSITION = 0, 1, 2
VELOCITY_FILTER = 0.008
"""Time constant of the velocity reading's low pass [s]."""
REMOTE, INTERNAL_LIMIT, FOLLOWS = 0x0210, 0x0800, 0x1000
INTEGRAL_SHARE = 0.3
"""Integral action: stiffness · bandwidth · this."""
TUNING_POSES = 50
"""The loops are tuned for the largest inertia among so many poses, so that they are stable in all of them."""


class Drives:
    """All joints' drives; arrays (n,)."""

    def __init__(self, arm: ArmFile, plant: Plant, sensors: Sensors, signals: Signals) -> None:
        """Switched off, at the plant's present position."""
        section, self.n = sim_section(arm).servo, plant.n
        self._plant, self._sensors, self._signals = plant, sensors, signals
        self.rated = np.array([joint.rated_torque for joint in arm.require_link().joints])
        poses = np.random.default_rng(0).uniform(plant.lower, plant.upper, (TUNING_POSES, self.n))
        inertia = np.max([np.diag(plant.inertia(pose)) for pose in poses], axis=0)
        self._stiffness = inertia * section.bandwidth**2
        self._damping = 2 * section.damping * inertia * section.bandwidth
        self._integration = INTEGRAL_SHARE * section.bandwidth * self._stiffness
        self._deadband, self.deceleration = section.deadband, np.full(self.n, section.quick_stop_deceleration)
        self._with_brake = section.brake
        self.state = [State.SWITCH_ON_DISABLED] * self.n
        self.mode = np.zeros(self.n, int)
        self.kind = np.zeros(self.n, int)
        self.on_state: Callable[[int], None] = lambda joint: None
        self.quick_stop_option = [6] * self.n
        self._stop_then_disable = np.zeros(self.n, bool)
        self._words = [0] * self.n
        self._status = np.full(self.n, STATUS[State.SWITCH_ON_DISABLED] | REMOTE, int)
        self._torque, self._target, self._rate = np.zeros(self.n), plant.position, np.zeros(self.n)
        self._integral, self._limit = np.zeros(self.n), np.zeros(self.n)
        self._stopping = np.zeros(self.n, bool)
        self.new_torque, self.new_position = np.zeros(self.n, bool), np.zeros(self.n, bool)
        self.new_velocity = np.zeros(self.n, bool)
        self._last_reading, self._velocity = sensors.position(plant.position), np.zeros(self.n)
        self.gain, self.offset = np.ones(self.n), np.zeros(self.n)
        """Calibration in force (2100h)."""
        self._bind(signals)
        self._reconfigure()

    def _bind(self, signals: Signals) -> None:
        self._position_out, self._velocity_out = signals[0x6064, 0], signals[0x606C, 0]
        self._reading_out, self._motor_out = signals[0x2100, 1], signals[0x6077, 0]
        self._status_out, self._mode_out = signals[0x6041, 0], signals[0x6061, 0]
        self._demand_out, self.error_code = signals[0x6074, 0], signals[0x603F, 0]
        self._word_in, self._mode_in = signals[0x6040, 0], signals[0x6060, 0]
        self._torque_in, self._feed_forward_in = signals[0x6071, 0], signals[0x60B2, 0]
        self._position_in, self._max_torque_in = signals[0x607A, 0], signals[0x6072, 0]
        self._velocity_in = signals[0x60FF, 0]
        self._seen_words, self._seen_modes = self._word_in.copy(), self._mode_in.copy()
        self._seen_limit = np.full(self.n, -1)

    # ---- readings

    def sample(self, time: float, elapsed: float) -> None:
        """Read the sensors at `time` [s], `elapsed` after the last time, into the signals."""
        plant, sensors = self._plant, self._sensors
        reading = sensors.position(plant.position)
        if elapsed > 0:
            share = 1.0 - np.exp(-elapsed / VELOCITY_FILTER)
            self._velocity += share * ((reading - self._last_reading) / elapsed - self._velocity)
            self._last_reading = reading
        torque = (sensors.torque(plant.link_torque, time) - self.offset) / self.gain
        motor = plant.drive_torque
        self._position_out[:] = np.rint(reading / UNIT)
        self._velocity_out[:] = np.rint(self._velocity / UNIT)
        self._reading_out[:] = np.rint(torque * 1e6)
        self._motor_out[:] = np.rint(motor * 1000 / self.rated)
        limited = np.abs(motor) >= self._limit
        self._status_out[:] = self._status | np.where(limited & (self.kind != OFF), INTERNAL_LIMIT, 0)

    # ---- commands

    def take_commands(self) -> None:
        """Act on new control words, modes and limits in the signals."""
        if (self._word_in != self._seen_words).any():
            for joint in np.flatnonzero(self._word_in != self._seen_words):
                self._control(int(joint), int(self._word_in[joint]))
            self._seen_words[:] = self._word_in
        if (self._mode_in != self._seen_modes).any():
            for joint in np.flatnonzero(self._mode_in != self._seen_modes):
                self._select_mode(int(joint), int(self._mode_in[joint]))
            self._seen_modes[:] = self._mode_in
        if (self._max_torque_in != self._seen_limit).any():
            self._seen_limit = self._max_torque_in.astype(int)
            self._reconfigure()

    def _control(self, joint: int, word: int) -> None:
        asked = command(word, self._words[joint])
        self._words[joint] = word
        state = next_state(self.state[joint], asked)
        if self.state[joint] is State.ENABLED and state is State.QUICK_STOP:
            self.quick_stop(joint)
        elif state is not self.state[joint]:
            self.enter(joint, state)

    def enter(self, joint: int, state: State) -> None:
        """Go to `state`: the power stage follows, the status word too."""
        self.state[joint] = state
        self._stopping[joint] = False
        if state is State.ENABLED:
            self._select_mode(joint, int(self._mode_in[joint]))
        elif state is not State.QUICK_STOP:
            self._set_kind(joint, OFF)
        if state is State.SWITCH_ON_DISABLED:
            self.error_code[joint] = 0
        self._update_status(joint)
        self.on_state(joint)

    def quick_stop(self, joint: int) -> None:
        """Quick stop an enabled drive as 605Ah says: 0 disables; 1, 2 stop then disable; 5 to 8 stop and hold."""
        option = self.quick_stop_option[joint]
        if option == 0:
            self.enter(joint, State.SWITCH_ON_DISABLED)
            return
        self._set_kind(joint, POSITION)
        self._rate[joint] = self._velocity[joint]
        self._stopping[joint] = True
        self._stop_then_disable[joint] = option < 5
        self.state[joint] = State.QUICK_STOP
        self._update_status(joint)
        self.on_state(joint)

    def _select_mode(self, joint: int, mode: int) -> None:
        """Enter a mode; an unsupported one leaves the drive enabled but without torque demand of its own: mode 0."""
        known = {CST: TORQUE, CSP: POSITION, CSV: POSITION}
        self.mode[joint] = mode if mode in known else 0
        self._mode_out[joint] = self.mode[joint]
        self.new_torque[joint] = self.new_position[joint] = self.new_velocity[joint] = False
        if self.state[joint] is State.ENABLED:
            self._set_kind(joint, known.get(mode, POSITION))
        self._update_status(joint)

    def _set_kind(self, joint: int, kind: int) -> None:
        """Change the loop without a bump: start from the torque now transmitted and the position now held."""
        plant = self._plant
        powered = self.kind[joint] != OFF or not self._with_brake
        torque = (plant.drive_torque if powered else plant.link_torque)[joint]
        position, velocity = plant.position[joint], plant.velocity[joint]
        self._torque[joint] = torque
        self._target[joint], self._rate[joint] = position, 0.0
        self._integral[joint] = torque + self._damping[joint] * velocity
        self.kind[joint] = kind
        self._reconfigure()

    def _reconfigure(self) -> None:
        self._limit = self._max_torque_in * self.rated / 1000
        closed = self.kind == POSITION
        self._closed = bool(closed.any())
        self._mask = closed
        enabled = np.where(self.kind == OFF, 0.0, self._limit)
        self._plant.set_servo(self._stiffness * closed, self._damping * closed, enabled)
        if self._with_brake:
            self._plant.set_brakes(self.kind == OFF)

    def _update_status(self, joint: int) -> None:
        word = STATUS[self.state[joint]] | REMOTE
        if self.state[joint] is State.ENABLED and self.mode[joint]:
            word |= FOLLOWS
        self._status[joint] = word
        self._status_out[joint] = word

    # ---- control

    def advance(self, duration: float, synchronous: bool) -> None:
        """Run plant and loops for `duration` [s]; `synchronous` where it follows a SYNC, which brings new targets."""
        feed_forward = self._feed_forward_in * self.rated / 1000
        following = self.kind == TORQUE
        self._torque = np.where(following & self.new_torque, self._torque_in * self.rated / 1000, self._torque)
        if not self._closed:
            level = np.where(following, self._torque + feed_forward, 0.0)
            self._demand_out[:] = np.rint(level * 1000 / self.rated)
            self._plant.step(level, level, duration)
            return
        mask = self._mask
        self._plan(duration, synchronous)
        end = self._target + self._rate * duration
        error = np.where(mask, self._target - self._plant.position, 0.0)
        error[np.abs(error) < self._deadband] = 0.0
        self._integral = np.clip(self._integral + self._integration * error * duration, -self._limit, self._limit)
        open_loop = np.where(following, self._torque + feed_forward, 0.0)
        base = self._damping * self._rate + self._integral + feed_forward
        first = np.where(mask, self._stiffness * self._target + base, open_loop)
        last = np.where(mask, self._stiffness * end + base, open_loop)
        self._demand_out[:] = np.rint(
            np.clip(np.where(mask, self._integral, open_loop) * 1000 / self.rated, -32768, 32767)
        )
        self._plant.step(first, last, duration)
        self._target = np.where(mask, end, self._target)

    def _plan(self, duration: float, synchronous: bool) -> None:
        """Rates with which the position targets move during the next `duration`."""
        if self._stopping.any():
            slower = np.maximum(np.abs(self._rate) - self.deceleration * duration, 0.0) * np.sign(self._rate)
            self._rate = np.where(self._stopping, slower, self._rate)
            for joint in np.flatnonzero(self._stopping & self._stop_then_disable & (self._rate == 0)):
                self.enter(int(joint), State.SWITCH_ON_DISABLED)
        moving = (self.mode == CSP) & self._mask & ~self._stopping
        if moving.any():
            wanted = self._sensors.angle_of(self._position_in * UNIT)
            rate = (wanted - self._target) / duration if synchronous else np.zeros(self.n)
            self._rate = np.where(moving, np.where(self.new_position, rate, 0.0), self._rate)
        turning = (self.mode == CSV) & self._mask & ~self._stopping
        if turning.any():
            rate = self._velocity_in * UNIT * self._sensors.position_gain
            self._rate = np.where(turning, np.where(self.new_velocity, rate, 0.0), self._rate)
