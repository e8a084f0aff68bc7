"""Torque and position sensors of all joints: gain, offset, imperfections, noise, quantisation."""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from sim_bus.effects.state import Imperfections
from sim_bus.physics.joint_torques import coldness
from sim_bus.sim_section import NOISE_SHARE, sim_section
from sim_bus.truth import Truth

TORQUE_RANGE = 2.0
"""The torque sensors saturate at this many rated torques."""
NOISE_BLOCK = 512
EXACT = 1e-13
"""Error of a position reading that is as good as none [rad]."""


class JointSensors:
    """Readings of the joints' sensors; all arrays (n,)."""

    def __init__(self, arm: ArmFile, truth: Truth, imperfections: Imperfections, seed: int) -> None:
        """Sensors with the parameters of `truth`; `seed` of the noise."""
        section, link = sim_section(arm).sensors, arm.require_link()
        rated = link.rated_torques
        n = len(rated)
        bits = np.broadcast_to(np.array(section.bits), n)
        self.noise = NOISE_SHARE * rated if section.noise is None else np.array(section.noise)
        self.torque_limit = TORQUE_RANGE * rated
        self.torque_step = 2 * self.torque_limit / 2.0**bits
        self.increments = (2**bits).astype(int)
        self.position_step = 2 * np.pi / 2.0**bits
        self._truth = truth
        self._random = np.random.default_rng((seed, 1))
        self._block, self._next = np.empty((NOISE_BLOCK, n)), NOISE_BLOCK
        self._drift_gain, self._drift_offset = np.ones(n), np.zeros(n)
        self._play = np.zeros(n)
        self._late: list[tuple[float, Array]] = []
        self.set_imperfections(imperfections)

    def set_imperfections(self, imperfections: Imperfections) -> None:
        """Apply the sensors' part of `imperfections`."""
        self._imperfections = state = imperfections
        self.gain = self._truth.gain * state.torque_gain * self._drift_gain
        self.offset = self._truth.offset + state.torque_offset + self._drift_offset
        self.position_gain = self._truth.position_gain * state.position_gain
        self.position_offset = self._truth.position_offset + state.position_offset
        self._bent = bool(
            state.crosstalk.any()
            or state.hysteresis.any()
            or state.deadband.any()
            or state.torque_drift.any()
            or state.cubic.any()
            or state.warm_up.any()
            or np.isfinite(state.torque_saturation).any()
        )
        self.warms = bool(state.warm_constant[:, 0].any())
        """Whether gains change as the drives warm up."""
        self._delayed = bool(state.torque_delay.any())
        self._eccentric = bool(state.eccentricity.any())
        contraction = float(np.max(state.eccentricity[:, 0] / np.abs(self.position_gain)))
        self._turns = 1 if contraction < 1e-15 else min(8, int(np.ceil(np.log(EXACT) / np.log(min(contraction, 0.5)))))

    def drift(self, joint: int, gain: float, offset: float) -> None:
        """Multiply the torque sensor's gain by `gain` and add `offset` [N·m] from now on."""
        self._drift_gain[joint] *= gain
        self._drift_offset[joint] += offset
        self.set_imperfections(self._imperfections)

    def torque(self, link_torque: Array, time: float) -> Array:
        """Raw readings `v` [N·m] of the transmitted torques at `time` [s]."""
        if self._delayed:
            link_torque = self._delay(link_torque, time)
        if self._bent:
            link_torque = self._bend(link_torque)
        gain = self.gain_at(time) if self.warms else self.gain
        reading = gain * link_torque + self.offset
        if self._bent:
            reading += self._imperfections.torque_drift * time + self.cold_zero(time)
        if self._next == NOISE_BLOCK:
            self._block = self.noise * self._random.standard_normal(self._block.shape)
            self._next = 0
        reading += self._block[self._next]
        self._next += 1
        np.maximum(np.minimum(reading, self.torque_limit, out=reading), -self.torque_limit, out=reading)
        counts: Array = np.rint(reading / self.torque_step)
        return counts * self.torque_step

    def cold_zero(self, time: float) -> Array:
        """Shift of the torque sensors' zero (n,) at `time` [s], which vanishes as they warm up [N·m]."""
        shift: Array = -self._imperfections.warm_up[:, 0] * coldness(self._imperfections, time)
        return shift

    def gain_at(self, time: float) -> Array:
        """Gains (n,) at `time` [s]: a drive whose torque constant falls reads too much."""
        gain: Array = self.gain / (1.0 - self._imperfections.warm_constant[:, 0] * self.warmth(time))
        return gain

    def warmth(self, time: float) -> Array:
        """How warm each drive is (n,) at `time` [s]: 0 at power-on, 1 in the end."""
        constant = self._imperfections.warm_constant[:, 1]
        warm: Array = 1.0 - np.exp(-time / np.where(constant > 0, constant, np.inf))
        return warm

    def heating(self, time: float) -> Array:
        """Rise of the drives' temperatures (n,) [K] at `time` [s] since power-on."""
        rise: Array = self._imperfections.warm_constant[:, 2] * self.warmth(time)
        return rise

    def position_counts(self, angle: Array) -> Array:
        """Readings `φ` of true angles in whole encoder increments."""
        return np.rint(self.reading_of(angle) / self.position_step)

    def reading_of(self, angle: Array) -> Array:
        """Exact solution `φ` of `θ = position_gain·φ + position_offset + amplitude·sin(φ + phase)`."""
        reading = (angle - self.position_offset) / self.position_gain
        if self._eccentric:
            amplitude, phase = self._imperfections.eccentricity.T
            for _ in range(self._turns):  # fixed-point iteration, contracts by amplitude / gain
                bent = amplitude * np.sin(reading + phase)
                reading = (angle - self.position_offset - bent) / self.position_gain
        return reading

    def angle_of(self, reading: Array) -> Array:
        angle = self.position_gain * reading + self.position_offset
        if self._eccentric:
            amplitude, phase = self._imperfections.eccentricity.T
            angle = angle + amplitude * np.sin(reading + phase)
        return angle

    def _bend(self, torque: Array) -> Array:
        state = self._imperfections
        torque = torque + state.crosstalk @ torque
        torque = torque * (1 + state.cubic * (torque / self.torque_limit) ** 2)
        self._play = np.clip(self._play, torque - state.hysteresis, torque + state.hysteresis)
        torque = np.where(state.hysteresis > 0, self._play, torque)
        torque = np.sign(torque) * np.maximum(np.abs(torque) - state.deadband, 0.0)
        return np.clip(torque, -state.torque_saturation, state.torque_saturation)

    def _delay(self, torque: Array, time: float) -> Array:
        """Each joint's torque `torque_delay` ago, interpolated linearly between samples."""
        delays = self._imperfections.torque_delay
        self._late.append((time, torque))
        while len(self._late) > 2 and self._late[1][0] <= time - delays.max():
            del self._late[0]
        times, torques = np.array([item[0] for item in self._late]), np.array([item[1] for item in self._late])
        columns = range(len(torque))
        return np.array([np.interp(time - delays[j], times, torques[:, j]) for j in columns])
