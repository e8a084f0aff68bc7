"""Torque of an arm in motion as rows of a linear model, all of it behind one low-pass filter, sample by sample.

The generalised momentum observer of external torque is the filter F of what drives the momentum p,

    F τ = F ṗ − F (∂T/∂q − g) + F friction − F τ_external,

with F ṗ taken as the difference of the filtered momentum, so that no acceleration is needed. Every term is linear in
parameters: those of the links, and those of each joint's friction, sensor and rotor. A row is one joint at one time.
"""

from dataclasses import dataclass
from functools import lru_cache

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
STATES = ("still", "turning", "speed", "push", "held")
"""1 at rest and 0 in motion; 1 while friction turns round and 0 once the joint has moved on; speed [rad/s];
acceleration [rad/s²]; gravity's torque that a joint at rest holds [N·m], with which its friction grows."""
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
COLUMNS = len(JOINT_COLUMNS) + WAVES
AT_ONCE = 32
"""Rows of a filter that are one product of matrices."""


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
    """How a joint moves or moved just before, `STATES`, (K, n, 5)."""
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
        self._state: dict[str, tuple[Array, Array, Array]] = {}
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
            self._begun = True
        motion = rigid_motion(self.arm, q, v)
        momentum, rest, gravity = momentum_terms(motion, self.links)
        direct, state = np.empty((*q.shape, 2 + COLUMNS)), np.empty((*q.shape, len(STATES)))
        direct[..., 0], direct[..., 1] = samples.torque, -rest
        self._columns(samples, gravity, direct[..., 2:], state)
        first = self._count % self.stride
        chosen = slice((self.stride - first) % self.stride, None, self.stride)
        self._count += len(q)
        passed, pushed = self._filtered("torque", direct, np.stack([momentum, v], axis=-1))
        links = passed[..., 1] + pushed[..., 0]
        joints = passed[..., 2:]
        joints[..., JOINT_COLUMNS.index("rotor")] = pushed[..., 1]
        by_link = np.zeros((0, self.arm.n, self.links.size))
        thin = slice((-first) % self._thin, None, self._thin)
        if derivatives and len(q[thin]):
            by_momentum, by_rate = momentum_regressors(motion.part(thin))
            both = np.add(*self._filtered("links", -by_rate, by_momentum, self._thin))
            by_link = both[(np.arange(len(q))[thin] + first) % self.stride == 0]
        np.abs(pushed[..., 1], out=state[..., STATES.index("push")])
        return FilteredRows(
            passed[..., 0], links, joints, by_link, self._remembered(state), chosen, motion.part(chosen)
        )

    def _columns(self, samples: Samples, gravity: Array, out: Array, state: Array) -> None:
        """Columns of the joints' own parameters (K, n, C), and their states but for the acceleration."""
        q, v, warm = samples.position, samples.velocity, samples.warmth
        narrow, wide = self._bristles(q)
        cos, sin = np.cos(q), np.sin(q)
        speed = np.abs(v)
        pace = speed / STRIBECK_SPEED
        side = narrow * np.minimum(1.0, pace) + wide * np.maximum(0.0, 1.0 - pace)
        own = {
            "offset": 1.0,
            "coulomb": narrow,
            "coulomb_wide": wide,
            "breakaway": narrow * np.exp(-pace),
            "load": side * np.abs(gravity),
            "viscous": v,
            "quadratic": v * speed,
            "uneven_cos": narrow * cos,
            "uneven_sin": narrow * sin,
            "warm_coulomb": narrow * warm,
            "warm_viscous": v * warm,
            "warm_offset": warm,
            "warm_gain": gravity * warm,
            "rotor": 0.0,
            "gain": gravity,
        }
        for k, name in enumerate(JOINT_COLUMNS):
            out[..., k] = own[name]
        waves = np.cos(np.concatenate([cos, sin], axis=1) @ self._direction + self._phase)
        out[..., len(JOINT_COLUMNS) :] = np.sqrt(2.0 / WAVES) * waves[:, None]
        state[..., 0] = np.exp(-((pace / 0.2) ** 2))
        state[..., 1], state[..., 2] = 1.0 - wide**2, speed
        state[..., 4] = state[..., 0] * np.abs(gravity)

    def _remembered(self, state: Array) -> Array:
        """States (K, n, 5), each at its largest of the time that counts."""
        keep, out = float(np.exp(-1.0 / (REMEMBERED * self.rate))), np.empty_like(state)
        for begin in range(0, len(state), AT_ONCE):
            part = state[begin : begin + AT_ONCE]
            faded = (keep ** np.arange(1, len(part) + 1))[:, None, None]
            largest = np.maximum.accumulate(part / faded, axis=0)
            out[begin : begin + AT_ONCE] = np.maximum(largest, self._held) * faded
            self._held = out[begin + len(part) - 1].copy()
        return out

    def _bristles(self, q: Array) -> Array:
        """Direction of friction (2, K, n), -1 to 1, by the way since a reversal and not by time: it stays at rest."""
        steps = np.empty_like(q)
        steps[0], steps[1:] = q[0] - self._last, q[1:] - q[:-1]
        out = np.empty((len(q), len(PRESLIDING), q.shape[1]))
        np.divide(steps[:, None], np.array(PRESLIDING)[:, None], out=out)
        value = self._bristle
        for row in out:
            row += value
            np.maximum(row, -1.0, out=row)
            value = np.minimum(row, 1.0, out=row)
        self._bristle, self._last = value.copy(), q[-1].copy()
        return out.swapaxes(0, 1)

    def _filtered(self, name: str, values: Array, moving: Array, thin: int = 1) -> tuple[Array, Array]:
        """`values` (K, …) filtered, straight between two samples, and the filtered rate of change of `moving`."""
        keep, share = _kept(BANDWIDTH * thin / self.rate)
        if name not in self._state:
            self._state[name] = (values[0], values[0], moving[0])
        before, passed, pushed = self._state[name]
        middle = values.copy()
        middle[1:] += values[:-1]
        middle[0] += before
        middle *= 0.5 * share
        out, smooth = faded_sums(middle, keep, passed), faded_sums(share * moving, keep, pushed)
        self._state[name] = values[-1].copy(), out[-1].copy(), smooth[-1].copy()
        rate = np.empty_like(smooth)
        np.subtract(smooth[0], pushed, out=rate[0])
        np.subtract(smooth[1:], smooth[:-1], out=rate[1:])
        rate *= self.rate / thin
        return out, rate


def _kept(decay: float) -> tuple[float, float]:
    keep = float(np.exp(-decay))
    return keep, 1.0 - keep


def faded_sums(values: Array, keep: float, before: Array) -> Array:
    """y_k = keep y_{k-1} + x_k for x (K, …); a few rows at once, as one product."""
    out = np.empty(values.shape)
    flat, into, last = values.reshape(len(values), -1), out.reshape(len(values), -1), before.reshape(-1)
    for begin in range(0, len(values), AT_ONCE):
        rows = slice(begin, begin + AT_ONCE)
        part = flat[rows]
        weights, faded = _weights(keep, len(part))
        np.matmul(weights, part, out=into[rows])
        into[rows] += faded * last
        last = into[begin + len(part) - 1]
    return out


@lru_cache(maxsize=64)
def _weights(keep: float, count: int) -> tuple[Array, Array]:
    """(Of each row in the sums up to each row (count, count), of the sum before them (count, 1))."""
    row = np.arange(count)
    return np.tril(np.power(keep, np.abs(row[:, None] - row))), np.asarray(np.power(keep, 1.0 + row[:, None]))
