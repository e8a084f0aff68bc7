"""A fast arm for long campaigns: gravity torque, dynamics while it moves, friction, noise and quantisation; no frames.

Samples as the daemon hands them to its observer (decimated to 50 Hz), from the same ordinary work as the real thing.
"""

from collections.abc import Callable, Iterator

import numpy as np

from armlink.arm_file import ArmFile, load_arm
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import WorkMotion, trajectory
from calib.observer.config import ObserverConfig
from calib.observer.observer import Observer
from gcomp.arm.mass_moments import base_parameters, payload_columns
from gcomp.gravity.torque import gravity_regressor, gravity_torque

PERIOD = 0.02
DECIMATED = 5
"""Samples of 250 Hz that one of these is the mean of."""
NOISE_SHARE = 2e-3
"""Torque noise of one sample at 250 Hz, of rated torque."""
BITS = 14
MODEL_STD = 1e-3
"""Standard deviation of each gravity parameter, as a share of the largest."""
INERTIA = 0.05
"""Torque per acceleration while moving, as a share of rated torque a rad/s²: what no gravity model explains."""


class FastArm:
    """Works, drifts and carries as told; `samples` yields pieces: t (K,), position (K, n), torque reading (K, n)."""

    def __init__(self, arm: str | ArmFile = "sarcos", seed: int = 0) -> None:
        self.file = load_arm(arm) if isinstance(arm, str) else arm
        self.arm, self.random = gcomp_arm(self.file), np.random.default_rng([seed, 21])
        self.n, joints = self.arm.n, self.file.require_link().joints
        self.rated = self.file.require_link().rated_torques
        self.speed = np.array([joint.max_velocity for joint in joints])
        links = self.file.sim.links
        mass = np.array([link.mass for link in links])
        self.beta = base_parameters(self.arm, mass, mass[:, None] * np.array([link.com for link in links]))
        model_std = MODEL_STD * np.abs(self.beta).max() * np.linspace(1.0, 0.2, self.beta.size)
        scale = 1 + 2e-3 * self.random.normal()  # common to calibration and model: nobody can see it
        self.scale = scale
        self.model = (self.beta + model_std * self.random.normal(size=self.beta.size)) * scale
        self.covariance = np.diag(model_std**2) + 4e-6 * np.outer(self.beta, self.beta)
        self.gain, self.offset = np.ones(self.n), np.zeros(self.n)
        """The sensors: v = gain·τ + offset (n,)."""
        self.held_gain, self.held_offset = np.ones(self.n), np.zeros(self.n)
        """What the controllers hold: they send (v − offset) / gain."""
        self.load = np.zeros(self.beta.size)
        """What is carried, as mass moments [kg·m] (2n,)."""
        self.push: Callable[[np.ndarray], np.ndarray] | None = None
        """Torque (K, n) of a contact at poses (K, n)."""
        self.q = (self.arm.lower + self.arm.upper) / 2
        self.t = 0.0
        self.motion = WorkMotion()
        self.job: Iterator[np.ndarray] | None = None
        """Poses (n,) of a job, one after the other; None: random ones over the whole range."""

    def observer(self, config: ObserverConfig | None = None) -> Observer:
        config = config or ObserverConfig()
        return Observer.at_rest(self.arm, self.model, self.covariance, config.noise_share * self.rated, config)

    def carry(self, mass: float, point: np.ndarray) -> None:
        at_origin, by_point = payload_columns(self.arm)
        self.load = mass * (at_origin + by_point @ point)

    def put_down(self) -> None:
        self.load = np.zeros_like(self.load)

    def rms_torque(self) -> np.ndarray:
        """How much gravity torque varies over the range (n,) [N·m]."""
        q = np.random.default_rng(0).uniform(self.arm.lower, self.arm.upper, (4000, self.n))
        return np.asarray(gravity_torque(self.arm, self.beta, q).std(axis=0))

    def samples(self, seconds: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Ordinary work for so long: one piece a waypoint, the move and the rest behind it."""
        end = self.t + seconds
        motion, middle = self.motion, (self.arm.lower + self.arm.upper) / 2
        half = np.maximum((self.arm.upper - self.arm.lower) / 2 - motion.margin, 0.0)
        while self.t < end:
            nearest = np.maximum(middle - half, self.q - motion.reach)
            farthest = np.minimum(middle + half, self.q + motion.reach)
            goal = self.random.uniform(np.minimum(nearest, farthest), np.maximum(nearest, farthest))
            if self.job is not None:
                goal = next(self.job)
            way = trajectory(
                self.q, goal, motion.speed_share * self.speed, np.full(self.n, motion.acceleration), PERIOD
            )
            rest = np.repeat(goal[None], round(motion.rest / PERIOD), axis=0)
            position = np.vstack([way, rest])
            position[:, :] += 2e-4 * self.random.normal(size=self.n) * (position != goal).any(axis=1)[:, None]
            acceleration = np.gradient(np.gradient(np.vstack([way, rest]), PERIOD, axis=0), PERIOD, axis=0)
            t = self.t + PERIOD * np.arange(1, len(position) + 1)
            self.q, self.t = goal, float(t[-1])
            yield t, position, self.read(position, acceleration)

    def read(self, q: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        torque = gravity_regressor(self.arm, q) @ (self.beta + self.load) + INERTIA * self.rated * acceleration
        if self.push is not None:
            torque = torque + self.push(q)
        noise = NOISE_SHARE / np.sqrt(DECIMATED) * self.rated * self.random.normal(size=q.shape)
        step = 4 * self.rated / 2**BITS
        raw = np.round((self.gain * self.scale * torque + self.offset + noise) / step) * step
        return np.asarray((raw - self.held_offset) / self.held_gain)

    def install(self, joint: int, gain: float, offset: float) -> None:
        """A finding, relative to what is held, written to the controller."""
        self.held_offset[joint] += self.held_gain[joint] * offset
        self.held_gain[joint] *= gain

    def error(self) -> tuple[np.ndarray, np.ndarray]:
        """What is wrong with the readings: gain and offset [N·m] (n,)."""
        return self.gain / self.held_gain - 1, (self.offset - self.held_offset) / self.held_gain

    def run(self, observer: Observer, seconds: float, apply: bool = True) -> list:
        """Feed the observer; with `apply` every proposal is written at once. Returns the events."""
        said = []
        for t, position, torque in self.samples(seconds):
            for k in range(len(t)):
                for event in observer.handle(float(t[k]), position[k], torque[k]):
                    said.append(event)
                    if event.finding is not None and apply:
                        self.install(event.finding.joint, event.finding.gain, event.finding.offset)
                        observer.install(event.finding)
        return said
