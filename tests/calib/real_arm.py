"""An arm with all small troubles of a real one (`sim.realism`), at rest, with the model that a calibration left."""

import mujoco
import numpy as np
from rest_arm import RestArm

from armlink.arm_file import ArmFile
from calib.observer.config import ObserverConfig
from calib.observer.discrepancy import DiscrepancyLevel
from calib.observer.observer import Observer
from gcomp.gravity.torque import gravity_regressor
from sim_bus.effects.realism import add_realism
from sim_bus.effects.state import Imperfections
from sim_bus.physics.joint_torques import Cables, coldness
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import TORQUE_RANGE

CALIBRATION_POSES = 150
WARM = 1e6
"""Time since power-on at which the joints are warm [s]."""


class RealArm(RestArm):
    """`row` as the rest arm; statics by the simulated arm's own physics. Warm unless `cold_at` is set."""

    def __init__(self, arm: str | ArmFile, level: float, seed: int) -> None:
        super().__init__(arm, seed)
        self.state = Imperfections(self.file.joint_names)
        add_realism(self.state, self.rated, level, seed)
        self.plant = Plant(self.file, self.state)
        self._scratch = mujoco.MjData(self.plant.model)  # to make one takes as long as all else at a rest
        self.scale, self.cold_at = 1.0, -WARM
        middle = (self.arm.lower + self.arm.upper) / 2
        self._cables = Cables(self.state, middle, middle)
        self._play = np.zeros(self.n)
        self.zero = lambda t: np.zeros(self.n)
        """Shift of the zeros (n,) [N·m] at a time [s], beside that of warming up."""
        self._calibrate()

    def carry(self, mass: float, point: np.ndarray) -> None:
        self.plant.attach_mass(mass, point)

    def put_down(self) -> None:
        self.plant.detach_mass()

    def sensed(self, q: np.ndarray, t: float) -> np.ndarray:
        """Reading (n,) [N·m] of ideal gain and offset at position readings (n,) [rad], without noise."""
        amplitude, phase = self.state.eccentricity.T
        angle = q + amplitude * np.sin(q + phase)
        angle = angle - self.state.compliance * self._gravity_torque(angle)
        torque = self._gravity_torque(angle) - self._cables.torque(angle)
        torque = torque + self.state.crosstalk @ torque
        torque = torque * (1 + self.state.cubic * (torque / (TORQUE_RANGE * self.rated)) ** 2)
        self._play = np.clip(self._play, torque - self.state.hysteresis, torque + self.state.hysteresis)
        cold = self.state.warm_up[:, 0] * coldness(self.state, t - self.cold_at)
        reading: np.ndarray = np.where(self.state.hysteresis > 0, self._play, torque) - cold + self.zero(t)
        return reading

    def reading(self, q: np.ndarray, side: np.ndarray) -> np.ndarray:
        torque = self.sensed(q, self.t)
        return torque if self.push is None else torque + self.push(q[None])[0]

    def _gravity_torque(self, angle: np.ndarray) -> np.ndarray:
        """As `sim_bus.physics.plant.Plant.gravity_torque`, (n,) [N·m] at link angles (n,) [rad]."""
        model, data = self.plant.model, self._scratch
        data.qpos[: self.n] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        return np.array(data.qfrc_bias[: self.n])

    def _calibrate(self) -> None:
        """The gravity model and offsets of least squares over poses of the whole range, as a calibration has them."""
        q = self.random.uniform(self.arm.lower, self.arm.upper, (CALIBRATION_POSES, self.n))
        torque = np.array([self.sensed(each, 0.0) for each in q])
        regressor, ones = gravity_regressor(self.arm, q), np.tile(np.eye(self.n), (len(q), 1, 1))
        scale = 1 / (1e-3 * self.rated)
        design = (np.concatenate([regressor, ones], axis=2) * scale[:, None]).reshape(-1, 3 * self.n)
        ridge = np.vstack([design, 1e-3 * np.eye(3 * self.n)])
        wanted = np.append((torque * scale).ravel(), np.zeros(3 * self.n))
        solution = np.linalg.lstsq(ridge, wanted, rcond=None)[0]
        self.model, offset = solution[: 2 * self.n], solution[2 * self.n :]
        left = torque - regressor @ self.model - offset
        self.held_offset = offset.copy()
        spread = float(np.mean((left * scale) ** 2))
        self.covariance = (spread * np.linalg.inv(ridge.T @ ridge))[: 2 * self.n, : 2 * self.n]
        self.level = np.maximum(left.std(axis=0), 1e-5 * self.rated)

    def observer(self, config: ObserverConfig | None = None, *, told: bool = True) -> Observer:
        """With the level that the calibration tells, if it does."""
        config = config or ObserverConfig()
        level = DiscrepancyLevel.expected(self.level, np.full(self.n, 0.5)) if told else None
        sigma = config.noise_share * self.rated
        return Observer.at_rest(self.arm, self.model, self.covariance, sigma, config, level=level)
