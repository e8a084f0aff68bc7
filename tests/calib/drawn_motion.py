"""Ordinary work of drawn arms, sample by sample, with pushes and loads: rigid bodies by MuJoCo, all else by the truth.

Motion is prescribed, as by a stiff position controller; torque is what such a motion takes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from drawn_creeps import QUANTUM_SHARE, DrawnCreep
from fast_arm import NOISE_SHARE
from real_arm import RealArm

from armlink.arrays import Array
from armlink.recording.recording import Recording
from sim_bus.physics.joint_torques import Cables, coldness
from sim_bus.physics.sensors import TORQUE_RANGE

RATE = 100.0
SPEEDS, ACCELERATIONS = (0.1, 1.0), (0.5, 4.0)
"""Of ordinary work, drawn evenly [rad/s], [rad/s²]."""
PAUSES = (0.5, 4.0)
"""Between two motions [s]."""
POSITION_NOISE, VELOCITY_NOISE = 1e-5, 1e-3
"""Of encoders of 19 bits and what a drive makes of them [rad], [rad/s]."""
PRESLIDING = (0.002, 0.02)
"""Way over which friction turns round [rad]."""
SETTLING = 0.1
"""Time constant with which a stopped drive's friction becomes whatever its controller leaves [s]."""
BUILD_UP = 0.05
"""Time over which a push grows to its full size [s]."""


@dataclass(frozen=True)
class Push:
    """A force on a link."""

    begin: float
    end: float
    link: int
    point: Array
    """(3,) in the link's frame [m]."""
    force: Array
    """(3,) in the base frame [N]."""

    def strength(self, t: Array) -> Array:
        return np.clip((t - self.begin) / BUILD_UP, 0.0, 1.0) * np.clip((self.end - t) / BUILD_UP, 0.0, 1.0)


@dataclass(frozen=True)
class Load:
    """A mass in the hand from one time to another."""

    begin: float
    end: float
    mass: float
    point: Array


@dataclass(eq=False)
class Motion:
    """What the joints do (K, n)."""

    t: Array
    q: Array
    v: Array
    a: Array
    moving: Array
    """Whether some joint moves, (K,)."""


def ordinary_motion(lower: Array, upper: Array, seconds: float, random: np.random.Generator) -> Motion:
    """From pose to pose with pauses, some or all joints at a time."""
    n = len(lower)
    low, high = 0.9 * lower + 0.1 * upper, 0.1 * lower + 0.9 * upper
    here = random.uniform(low, high)
    parts: list[tuple[Array, Array, Array]] = []
    length = 0
    while length < seconds * RATE:
        goal = here.copy()
        moving = random.choice(n, size=random.integers(1, n + 1), replace=False)
        goal[moving] = random.uniform(low[moving], high[moving])
        way = goal - here
        largest = max(float(np.abs(way).max()), 1e-3)
        speed, push = random.uniform(*SPEEDS), random.uniform(*ACCELERATIONS)
        # a path of fifth order: its peaks are 15/8 of the mean speed and 5.77 of the mean acceleration
        last = max(1.875 * largest / speed, np.sqrt(5.7735 * largest / push))
        x = np.arange(0.0, last, 1.0 / RATE) / last
        shape = 10 * x**3 - 15 * x**4 + 6 * x**5, 30 * x**2 - 60 * x**3 + 30 * x**4, 60 * x - 180 * x**2 + 120 * x**3
        parts.append(
            (here + np.outer(shape[0], way), np.outer(shape[1], way) / last, np.outer(shape[2], way) / last**2)
        )
        rest = np.arange(round(random.uniform(*PAUSES) * RATE))
        parts.append((np.tile(goal, (len(rest), 1)), np.zeros((len(rest), n)), np.zeros((len(rest), n))))
        length += len(x) + len(rest)
        here = goal
    q, v, a = (np.concatenate(each)[: round(seconds * RATE)] for each in zip(*parts, strict=True))
    return Motion(np.arange(len(q)) / RATE, q, v, a, np.abs(v).max(axis=1) > 1e-9)


@dataclass(eq=False)
class DrawnMotion:
    """An arm of which recordings are made; its time goes on from one to the next."""

    source: RealArm | DrawnCreep
    random: np.random.Generator
    rated: Array
    lower: Array
    upper: Array
    time: float = 0.0
    way: Array = field(init=False)

    def __post_init__(self) -> None:
        self.way = self.random.uniform(*PRESLIDING, len(self.rated))

    @property
    def plant(self):
        return self.source.plant if isinstance(self.source, RealArm) else self.source.simulated.plant

    def record(self, motion: Motion, pushes: Sequence[Push] = (), loads: Sequence[Load] = ()) -> Recording:
        """A recording; positions and torques as the calibrated controllers send them, true calibration."""
        made = self._link_sensors if isinstance(self.source, RealArm) else self._motors
        carried = self._rigid(motion, loads) - self.pushed(motion, pushes)
        torque, position, warm = made(motion, carried)
        self.time += float(motion.t[-1])
        noise = self.random.standard_normal
        shape = motion.q.shape
        kind = "torque" if isinstance(self.source, RealArm) else "motor_torque"
        return Recording(
            t=motion.t,
            position=position + POSITION_NOISE * noise(shape),
            velocity=motion.v + VELOCITY_NOISE * noise(shape),
            temperature=warm,
            **{kind: torque},
        )

    def pushed(self, motion: Motion, pushes: Sequence[Push]) -> Array:
        """Torque on the joints (K, n) [N·m]."""
        out = np.zeros(motion.q.shape)
        model, data = self.plant.model, mujoco.MjData(self.plant.model)
        n, bodies = motion.q.shape[1], self.plant._bodies
        for push in pushes:
            strength = push.strength(motion.t)
            body = bodies._bodies[push.link]
            for k in np.flatnonzero(strength > 0.0):
                data.qpos[:n] = motion.q[k]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                data.qfrc_applied[:] = 0.0
                at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ push.point
                mujoco.mj_applyFT(model, data, strength[k] * push.force, np.zeros(3), at, body, data.qfrc_applied)
                out[k] += data.qfrc_applied[:n]
        return out

    def _rigid(self, motion: Motion, loads: Sequence[Load]) -> Array:
        out = np.empty(motion.q.shape)
        held = np.full(len(motion.t), -1)
        for k, load in enumerate(loads):
            held[(motion.t >= load.begin) & (motion.t < load.end)] = k
        for k in np.unique(held):
            self._carry(None if k < 0 else loads[k])
            model, data, rows = self.plant.model, mujoco.MjData(self.plant.model), np.flatnonzero(held == k)
            n = motion.q.shape[1]
            for row in rows:
                data.qpos[:n], data.qvel[:n], data.qacc[:n] = motion.q[row], motion.v[row], motion.a[row]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_crb(model, data)
                mujoco.mj_comVel(model, data)
                mujoco.mj_rne(model, data, 1, data.qfrc_bias)
                out[row] = data.qfrc_bias[:n]
        self._carry(None)
        return out

    def _carry(self, load: Load | None) -> None:
        if load is None:
            self.plant.detach_mass()
        else:
            self.plant.attach_mass(load.mass, load.point)

    def _link_sensors(self, motion: Motion, carried: Array) -> tuple[Array, Array, None]:
        """As `RealArm.sensed`, in motion."""
        state, arm = self.source.state, self.source
        amplitude, phase = state.eccentricity.T
        reading = motion.q + state.compliance * carried
        reading = reading - amplitude * np.sin(reading + phase)
        cables = Cables(state, (self.lower + self.upper) / 2, motion.q[0])
        out, play = np.empty_like(carried), None
        for k, (q, load) in enumerate(zip(motion.q, carried, strict=True)):
            torque = load - cables.torque(q)
            torque = torque + state.crosstalk @ torque
            torque = torque * (1 + state.cubic * (torque / (TORQUE_RANGE * arm.rated)) ** 2)
            play = torque if play is None else np.clip(play, torque - state.hysteresis, torque + state.hysteresis)
            cold = state.warm_up[:, 0] * coldness(state, self.time + motion.t[k] - arm.cold_at)
            out[k] = np.where(state.hysteresis > 0, play, torque) - cold
        noise = NOISE_SHARE * self.rated * self.random.standard_normal(out.shape)
        raw = arm.gain * out + arm.offset + noise
        return (raw - arm.held_offset) / arm.held_gain, reading, None

    def _motors(self, motion: Motion, carried: Array) -> tuple[Array, Array, Array]:
        """As `drawn_work`, with friction that turns round over a way and becomes anything at rest."""
        state, truth, sensors = self.source.state, self.source.truth, self.source.simulated.sensors
        side = self._bristle(motion)
        amplitude, phase, by_load, _ = state.uneven.T
        level = state.coulomb * (1 + amplitude * np.sin(motion.q + phase)) + by_load * np.abs(carried)
        friction = side * level * (1 + state.leaning * side)
        ripple, cycles, at = state.cogging.T
        rotor = self.plant._rotor_inertia * motion.a
        motor = carried + rotor + friction + state.viscous * motion.v + 0.1 * ripple * np.sin(cycles * motion.q + at)
        times = self.time + motion.t
        slow = slice(None, None, 100)
        gain = np.stack([sensors.gain_at(each) for each in times[slow]])
        warm = np.stack([np.floor(sensors.heating(each)) for each in times[slow]])
        index = np.minimum(np.arange(len(times)) // 100, len(gain) - 1)
        noise = 0.02 * state.coulomb * self.random.standard_normal(motor.shape)
        raw = gain[index] * motor + sensors.offset + noise
        quantum = QUANTUM_SHARE * self.rated
        return np.round(raw / quantum) * quantum, (motion.q - truth.position_offset) / truth.position_gain, warm[index]

    def _bristle(self, motion: Motion) -> Array:
        out, value, goal = np.empty_like(motion.q), np.zeros(motion.q.shape[1]), np.zeros(motion.q.shape[1])
        before, keep = False, np.exp(-1.0 / (SETTLING * RATE))
        for k, (v, moving) in enumerate(zip(motion.v, motion.moving, strict=True)):
            if before and not moving:
                goal = self.random.uniform(-1.0, 1.0, len(v))
            still = np.abs(v) < 1e-9
            pushed = np.clip(value + v / RATE / self.way, -1.0, 1.0)
            value = (
                np.where(still, goal + keep * (value - goal), pushed) if not moving else np.where(still, value, pushed)
            )
            out[k] = value
            before = moving
        return out
