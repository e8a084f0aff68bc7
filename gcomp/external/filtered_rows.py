"""Torque of an arm in motion as rows of a linear model, all of it behind one low-pass filter, sample by sample.

The generalised momentum observer of external torque is the filter F of what drives the momentum p,

    F τ = F ṗ − F (∂T/∂q − g) + F friction − F τ_external,

with F ṗ taken as the difference of the filtered momentum, so that no acceleration is needed. Every term is linear in
parameters: those of the links, and those of each joint's friction, sensor and rotor. A row is one joint at one time.
"""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.external.rigid_motion import RigidMotion, momentum_regressors, momentum_terms, rigid_motion

BANDWIDTH = 25.0
"""Of the observer [rad/s]: half of a step of torque is there after 28 ms."""
PRESLIDING = (0.003, 0.03)
"""Ways over which friction turns round with the direction [rad]: of gears of little, and of much wind-up."""
STRIBECK_SPEED = 0.1
"""Speed over which friction falls from its value at breakaway [rad/s]."""
STATES = ("still", "turning", "speed", "push")
"""1 at rest and 0 in motion; 1 while friction turns round and 0 once the joint has moved on; speed [rad/s];
acceleration [rad/s²]."""
REMEMBERED = 0.15
"""Time constant with which a state is forgotten [s]: what the filter, and what gives way, still show of it."""
THINNED = 50.0
"""Rate at which derivatives pass the filter, or more [Hz]: twelve times the observer's bandwidth."""
WAVES = 24
"""Functions of the pose that stand for what model and friction lack; a choice."""
WAVE_LENGTH = 1.0
"""Distance over which that is alike [rad], as in the observer's discrepancy."""
JOINT_COLUMNS = (
    "offset", "coulomb", "coulomb_wide", "breakaway", "load", "viscous", "quadratic", "uneven_cos", "uneven_sin",
    "warm_coulomb", "warm_viscous", "warm_offset", "warm_gain", "rotor", "gain",
)  # fmt: skip
"""Columns of a joint's own parameters, before the waves."""


@dataclass(frozen=True, eq=False)
class Samples:
    """K samples of n joints, evenly spaced."""

    position: Array
    """(K, n) [rad]."""
    velocity: Array
    """(K, n) [rad/s]."""
    torque: Array
    """(K, n) [N·m]."""
    warmth: Array
    """Temperature above that at which the model holds (K, n) [K]; 0 where none is known."""

    def __len__(self) -> int:
        return len(self.position)

    def part(self, rows: slice) -> "Samples":
        return Samples(self.position[rows], self.velocity[rows], self.torque[rows], self.warmth[rows])


@dataclass(frozen=True, eq=False)
class FilteredRows:
    """The filtered model of K samples, and its derivatives at each `stride`-th."""

    torque: Array
    """Filtered measured torque (K, n) [N·m]."""
    links: Array
    """Filtered torque of the links (K, n) [N·m]."""
    joints: Array
    """Filtered columns of each joint's own parameters (K, n, C)."""
    by_link: Array
    """Derivatives of `links` by the links' parameters (S, n, 10 n), at every `stride`-th sample."""
    state: Array
    """How a joint moves or moved just before, `STATES`, (K, n, 4)."""
    chosen: slice
    """Those samples."""
    motion: RigidMotion
    """Of those samples."""


class RowFilter:
    """Turns samples into rows; each call goes on where the last one ended."""

    def __init__(self, arm: Arm, links: Array, rate: float, stride: int = 1) -> None:
        """`links` (n, 10) are the inertial parameters about which derivatives are taken; `rate` is in Hz."""
        self.arm, self.links, self.rate, self.stride = arm, links, rate, stride
        self._thin = max(
            step for step in range(1, stride + 1) if stride % step == 0 and step * THINNED <= max(rate, THINNED)
        )
        self._begun = False
        self._count = 0
        random = np.random.default_rng(1)
        n = arm.n
        self._direction = random.normal(size=(2 * n, WAVES)) / WAVE_LENGTH
        self._phase = random.uniform(0.0, 2.0 * np.pi, WAVES)

    def rows(self, samples: Samples, derivatives: bool = True) -> FilteredRows:
        q, v = samples.position, samples.velocity
        if not self._begun:
            self._bristle = np.zeros((len(PRESLIDING), self.arm.n))
            self._last = q[0].copy()
            self._held = np.zeros((self.arm.n, len(STATES)))
        motion = rigid_motion(self.arm, q, v)
        momentum, rest = momentum_terms(motion, self.links)
        gravity = -rest if not v.any() else -momentum_terms(rigid_motion(self.arm, q, 0.0 * v), self.links)[1]
        columns, state = self._columns(samples, gravity)
        first = self._count % self.stride
        chosen = slice((self.stride - first) % self.stride, None, self.stride)
        self._count += len(q)
        direct = np.concatenate([samples.torque[..., None], -rest[..., None], columns], axis=-1)
        moving = np.concatenate([momentum[..., None], v[..., None]], axis=-1)
        if not self._begun:
            self._state = {"direct": (direct[0].copy(), direct[0].copy()), "moving": (moving[0].copy(),) * 2}
        passed = self._low_pass("direct", direct)
        pushed = self._pushed("moving", moving)
        links = passed[..., 1] + pushed[..., 0]
        joints = passed[..., 2:]
        joints[..., JOINT_COLUMNS.index("rotor")] = pushed[..., 1]
        by_link = np.zeros((0, self.arm.n, self.links.size))
        thin = slice((-first) % self._thin, None, self._thin)
        if derivatives and len(q[thin]):
            by_momentum, by_rate = momentum_regressors(motion.part(thin))
            if "by_rate" not in self._state:
                self._state["by_rate"] = (-by_rate[0], -by_rate[0])
                self._state["by_momentum"] = (by_momentum[0].copy(),) * 2
            both = self._low_pass("by_rate", -by_rate, self._thin) + self._pushed(
                "by_momentum", by_momentum, self._thin
            )
            by_link = both[(np.arange(len(q))[thin] + first) % self.stride == 0]
        self._begun = True
        return FilteredRows(
            passed[..., 0], links, joints, by_link, self._remembered(state, pushed[..., 1]), chosen, motion.part(chosen)
        )

    def _columns(self, samples: Samples, gravity: Array) -> tuple[Array, Array]:
        """Columns of the joints' own parameters, and their states but for the acceleration."""
        q, v, warm = samples.position, samples.velocity, samples.warmth
        narrow, wide = self._bristles(q)
        speed = np.abs(v)
        side = narrow * np.minimum(1.0, speed / STRIBECK_SPEED) + wide * np.maximum(0.0, 1.0 - speed / STRIBECK_SPEED)
        waves = self._waves(q)
        own = {
            "offset": np.ones_like(q),
            "coulomb": narrow,
            "coulomb_wide": wide,
            "breakaway": narrow * np.exp(-speed / STRIBECK_SPEED),
            "load": side * np.abs(gravity),
            "viscous": v,
            "quadratic": v * speed,
            "uneven_cos": narrow * np.cos(q),
            "uneven_sin": narrow * np.sin(q),
            "warm_coulomb": narrow * warm,
            "warm_viscous": v * warm,
            "warm_offset": warm,
            "warm_gain": gravity * warm,
            "rotor": np.zeros_like(q),
            "gain": gravity,
        }
        columns = np.stack([own[name] for name in JOINT_COLUMNS], axis=-1)
        shared = np.broadcast_to(waves[:, None], (*q.shape, WAVES))
        still = np.exp(-((v / (0.2 * STRIBECK_SPEED)) ** 2))
        return np.concatenate([columns, shared], axis=-1), np.stack([still, 1.0 - wide**2, speed], axis=-1)

    def _remembered(self, state: Array, acceleration: Array) -> Array:
        """States, each at its largest of the time that counts."""
        out = np.concatenate([state, np.abs(acceleration)[..., None]], axis=-1)
        keep = float(np.exp(-1.0 / (REMEMBERED * self.rate)))
        for row in out:
            np.maximum(row, keep * self._held, out=row)
            self._held = row
        self._held = self._held.copy()
        return out

    def _bristles(self, q: Array) -> Array:
        """Direction of friction (2, K, n), -1 to 1, by the way since a reversal and not by time: it stays at rest."""
        steps = np.diff(q, axis=0, prepend=self._last[None])
        out = np.empty((len(PRESLIDING), *q.shape))
        for k, way in enumerate(PRESLIDING):
            value = self._bristle[k]
            scaled = steps / way
            for row, step in enumerate(scaled):
                value = np.minimum(np.maximum(value + step, -1.0), 1.0)
                out[k, row] = value
            self._bristle[k] = value
        self._last = q[-1].copy()
        return out

    def _waves(self, q: Array) -> Array:
        around = np.concatenate([np.cos(q), np.sin(q)], axis=1)
        return np.asarray(np.sqrt(2.0 / WAVES) * np.cos(around @ self._direction + self._phase))

    def _low_pass(self, name: str, values: Array, thin: int = 1) -> Array:
        """Filtered, (K, …); between two samples values go straight."""
        from scipy.signal import lfilter

        before, state = self._state[name]
        middle = values.copy()
        middle[1:] += values[:-1]
        middle[0] += before
        keep = float(np.exp(-BANDWIDTH * thin / self.rate))
        out, _ = lfilter([0.5 * (1.0 - keep)], [1.0, -keep], middle, axis=0, zi=keep * state[None])
        self._state[name] = values[-1].copy(), out[-1].copy()
        return np.asarray(out)

    def _pushed(self, name: str, values: Array, thin: int = 1) -> Array:
        """Filtered rate of change, (K, …)."""
        from scipy.signal import lfilter

        _, state = self._state[name]
        keep = float(np.exp(-BANDWIDTH * thin / self.rate))
        out, _ = lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * state[None])
        rate = np.diff(out, axis=0, prepend=state[None]) * self.rate / thin
        self._state[name] = values[-1].copy(), out[-1].copy()
        return np.asarray(rate)
