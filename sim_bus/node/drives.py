"""The joints' drives (CiA 402): states, modes and readings, for all joints at once."""

from collections.abc import Callable, Sequence

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.canopen.cia402 import DriveState
from armlink.drives.canopen.settings import TorqueObject
from armlink.drives.canopen.units import USER_UNITS
from sim_bus.node.cia402 import STATUS, command, next_state
from sim_bus.node.devices import Device
from sim_bus.node.node import Node
from sim_bus.node.object_arrays import INPUT, ObjectArrays
from sim_bus.node.position_torque_loops import KINDS, OFF, POSITION, UNIT, Loops
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors

APPLIED = (0x6007, 0x605A, 0x6065, 0x607D, 0x6085, 0x60C2)
"""Objects of the drive profile that take effect when written."""
VELOCITY_FILTER = 0.008
"""Time constant of the low-pass filter of velocity readings [s]."""
REMOTE, INTERNAL_LIMIT, FOLLOWS = 0x0210, 0x0800, 0x1000
FOLLOWING_ERROR = 0x8611
UNWATCHED = 0xFFFFFFFF
"""6065h: following errors are not monitored."""


class SimulatedDrives:
    """All joints' drives; arrays (n,)."""

    def __init__(self, arm: ArmFile, plant: Plant, sensors: JointSensors, signals: ObjectArrays) -> None:
        """Drives switched off, at the plant's present position."""
        self.n = n = plant.n
        self._plant, self._sensors = plant, sensors
        self.loops = Loops(arm, plant, sensors, signals)
        self.rated = self.loops.rated
        self._per_mille = 1000 / self.rated
        self.state = [DriveState.SWITCH_ON_DISABLED] * n
        self.quick_stop_option = [6] * n
        self.following_window = np.full(n, np.inf)
        """Following error window (6065h) [rad]."""
        self.refused_modes: list[set[int]] = [set() for _ in range(n)]
        self.gain, self.offset = np.ones(n), np.zeros(n)
        """Active calibration (2100h)."""
        self.on_state: Callable[[int], None] = lambda joint: None
        self.on_fault: Callable[[int, int], None] = lambda joint, code: None
        self._words = [0] * n
        self._status = np.full(n, STATUS[DriveState.SWITCH_ON_DISABLED] | REMOTE, np.uint16)
        self._counts, self._velocity = sensors.position_counts(plant.motor_position), np.zeros(n)
        self._position_out, self._velocity_out = signals[0x6064, 0], signals[0x606C, 0]
        self._reading_out, self._motor_out = signals[0x2100, 1], signals[0x6077, 0]
        self._status_out, self._mode_out = signals[0x6041, 0], signals[0x6061, 0]
        self.error_code = signals[0x603F, 0]
        self._word_in, self._mode_in, self._limit_in = signals[0x6040, 0], signals[0x6060, 0], signals[0x6072, 0]
        self._seen_words, self._seen_modes = self._word_in.copy(), self._mode_in.copy()
        self._seen_limit = self._limit_in.copy()
        self._user_per_count = USER_UNITS / sensors.increments
        self._velocity_per_count = self._user_per_count.copy()
        self._input_out, self._input_scale = signals[INPUT, 1], np.full(n, np.inf)
        self._input_zero = np.zeros(n)
        for joint, row in enumerate(arm.require_link().joints):
            wired = row.settings.torque if row.settings.family == "canopen" else None
            if isinstance(wired, TorqueObject) and wired.index == INPUT:
                self._input_scale[joint], self._input_zero[joint] = wired.scale, wired.offset
        self._with_inputs = bool(np.isfinite(self._input_scale).any())
        self._last_elapsed, self._share = 0.0, 0.0

    def set_devices(self, devices: Sequence[Device], places: Sequence[int]) -> None:
        for place, device in zip(places, devices, strict=True):
            if device.modes is not None:
                self.refused_modes[place] = set(KINDS) - device.modes
            if device.rpm:
                self._velocity_per_count[place] = 60.0 / self._sensors.increments[place]

    def bring_into_force(self, node: Node) -> None:
        """Apply a node's calibration record and drive settings to its drive."""
        joint, record, window = node.place, node.record.active, node.value(0x6065)
        self.gain[joint], self.offset[joint] = record.gain, record.offset
        self.quick_stop_option[joint] = node.value(0x605A)
        self.following_window[joint] = np.inf if window == UNWATCHED else window * UNIT
        loops = self.loops
        loops.deceleration[joint] = max(node.value(0x6085), 1) * UNIT
        loops.interpolate(joint, node.value(0x60C2, 1) * 10.0 ** node.value(0x60C2, 2))
        loops.lowest[joint], loops.highest[joint] = node.value(0x607D, 1), node.value(0x607D, 2)

    def units(self, joint: int) -> tuple[float, float, float]:
        """One count of position [rad], velocity [rad/s] and torque of the motor [N·m], as its PDOs have them."""
        step = float(self._sensors.position_step[joint])
        return (
            step / float(self._user_per_count[joint]),
            step / float(self._velocity_per_count[joint]),
            1.0 / float(self._per_mille[joint]),
        )

    # ---- readings

    def sample(self, time: float, elapsed: float) -> None:
        """Sample the sensors at `time` [s], `elapsed` [s] after the last sample, into the signals."""
        plant = self._plant
        counts = self._sensors.position_counts(plant.motor_position)
        if elapsed > 0:
            if elapsed != self._last_elapsed:
                self._last_elapsed, self._share = elapsed, float(1.0 - np.exp(-elapsed / VELOCITY_FILTER))
            self._velocity += self._share * ((counts - self._counts) / elapsed - self._velocity)
            self._counts = counts
            self._velocity_out[:] = np.rint(self._velocity * self._velocity_per_count)
        torque = (self._sensors.torque(plant.link_torque, time) - self.offset) / self.gain
        motor = plant.drive_torque
        self._position_out[:] = np.rint(counts * self._user_per_count)
        self._reading_out[:] = np.rint(torque * 1e6)
        if self._with_inputs:
            counts_in = torque / self._input_scale + self._input_zero
            self._input_out[:] = np.clip(np.rint(counts_in), -32768, 32767)
        self._motor_out[:] = np.rint(motor * self._per_mille)
        limited = np.abs(motor) >= self.loops.limit
        self._status_out[:] = (
            self._status | limited * np.uint16(INTERNAL_LIMIT) if np.count_nonzero(limited) else self._status
        )

    # ---- commands

    def take_commands(self) -> None:
        """Process new control words, modes and limits in the signals."""
        if self._limit_in.tobytes() != self._seen_limit.tobytes():
            self._seen_limit[:] = self._limit_in
            self.loops.reconfigure()
        if self._mode_in.tobytes() != self._seen_modes.tobytes():
            for joint in np.flatnonzero(self._mode_in != self._seen_modes):
                self._select_mode(int(joint))
            self._seen_modes[:] = self._mode_in
        if self._word_in.tobytes() != self._seen_words.tobytes():
            for joint in np.flatnonzero(self._word_in != self._seen_words):
                self._control(int(joint), int(self._word_in[joint]))
            self._seen_words[:] = self._word_in

    def _control(self, joint: int, word: int) -> None:
        asked = command(word, self._words[joint])
        self._words[joint] = word
        state = next_state(self.state[joint], asked)
        if self.state[joint] is DriveState.ENABLED and state is DriveState.QUICK_STOP:
            self.quick_stop(joint)
        elif state is not self.state[joint]:
            self.enter(joint, state)

    def enter(self, joint: int, state: DriveState) -> None:
        """Enter `state`, with power stage and status word."""
        self.state[joint] = state
        mode = int(self.loops.mode[joint])
        if state is DriveState.ENABLED:
            self.loops.start(joint, KINDS.get(mode, POSITION), mode)
        elif state is not DriveState.QUICK_STOP:
            self.loops.start(joint, OFF, mode)
        if state is DriveState.SWITCH_ON_DISABLED:
            self.error_code[joint] = 0
        self._update_status(joint)
        self.on_state(joint)

    def quick_stop(self, joint: int) -> None:
        """Quick stop an enabled drive by 605Ah: 0 disables; 1, 2 stop, then disable; 5 to 8 stop and hold."""
        if self.quick_stop_option[joint] == 0:
            self.enter(joint, DriveState.SWITCH_ON_DISABLED)
            return
        self.loops.stop(joint)
        self.enter(joint, DriveState.QUICK_STOP)

    def fault(self, joint: int, code: int) -> None:
        """Enter fault with error code `code` (603Fh): torque off, brake closed."""
        self.enter(joint, DriveState.FAULT)
        self.error_code[joint] = code
        self.on_fault(joint, code)

    def watch(self) -> None:
        """Monitor following errors (6065h) and the end of a quick stop."""
        error = self.loops.following_error
        for joint in np.flatnonzero(np.abs(error) > self.following_window):
            if self.state[joint] is DriveState.ENABLED:
                self.fault(int(joint), FOLLOWING_ERROR)
        for joint in np.flatnonzero(self.loops.stopping):
            if self.quick_stop_option[joint] < 5 and self.loops.stopped(int(joint)):
                self.enter(int(joint), DriveState.SWITCH_ON_DISABLED)

    @property
    def needs_watch(self) -> bool:
        return bool(self.loops.stopping.any() or np.isfinite(self.following_window).any())

    def _select_mode(self, joint: int) -> None:
        """Enter the requested mode; an unsupported one is displayed as 0 and holds the position."""
        asked = int(self._mode_in[joint])
        mode = asked if asked in KINDS and asked not in self.refused_modes[joint] else 0
        self._mode_out[joint] = mode
        self.loops.mode[joint] = mode
        if self.state[joint] is DriveState.ENABLED:
            self.loops.start(joint, KINDS.get(mode, POSITION), mode)
        self._update_status(joint)

    def _update_status(self, joint: int) -> None:
        word = STATUS[self.state[joint]] | REMOTE
        if self.state[joint] is DriveState.ENABLED and self.loops.mode[joint]:
            word |= FOLLOWS
        self._status[joint] = word
        self._status_out[joint] = word
