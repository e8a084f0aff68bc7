"""Typical motions: sums of sines, point to point, back and forth at varying pace, a chirp at the end."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array

RATE = 500.0
"""Rate of the commanded trajectories [Hz]."""
RECORDED_HZ = RATE / 2
"""Rate of the recordings with torques [Hz]."""
KINDS = ("sines", "points", "sweeps")
SLOWEST, LONGEST_REST_S, NEAREST = 0.4, 0.9, 0.01
"""Moves from point to point: least share of the limits, longest rest between them [s], least distance [rad]."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a trajectory, (n,) each: rad, rad, rad/s, rad/s²."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array

    @property
    def centre(self) -> Array:
        return 0.5 * (self.lower + self.upper)

    @property
    def reach(self) -> Array:
        """Largest distance from the centre [rad]."""
        return 0.42 * (self.upper - self.lower)


def trajectory(kinds: tuple[str, ...], duration: float, limits: MotionLimits, random: np.random.Generator) -> Array:
    """Positions (K, n) [rad] at `RATE` over `duration` seconds, equal parts of each kind, at rest at both ends.

    A chirp, at the end, takes a fifth of the motion, but 12 s at most.
    """
    makers = {"sines": _sines, "points": _points, "sweeps": _sweeps, "chirp": _chirp}
    rows = round(duration * RATE)
    chirp = round(min(12.0, 0.2 * duration) * RATE) if "chirp" in kinds else 0
    order = sorted(kinds, key="chirp".__eq__)
    ends = np.linspace(0, rows - chirp, len(order) - ("chirp" in kinds) + 1).astype(int)
    lengths = np.diff([*ends, *[rows] * ("chirp" in kinds)]).tolist()
    parts = [makers[kind](np.arange(k) / RATE, limits, random) for kind, k in zip(order, lengths, strict=True)]
    return np.asarray(limits.centre + np.concatenate(parts))


def derivatives(q: Array) -> tuple[Array, Array]:
    """Velocity [rad/s] and acceleration [rad/s²] of positions at `RATE`."""
    v = np.gradient(q, 1.0 / RATE, axis=0)
    return v, np.gradient(v, 1.0 / RATE, axis=0)


def _sines(t: Array, limits: MotionLimits, random: np.random.Generator) -> Array:
    n, waves = len(limits.lower), 7
    frequency = np.exp(random.uniform(np.log(0.03), np.log(0.7), (waves, n)))
    phase = random.uniform(0.0, 2 * np.pi, (waves, n))
    amplitude = random.uniform(0.4, 1.0, (waves, n)) / (0.1 + frequency) ** 1.5
    x = np.einsum("wn,wkn->kn", amplitude, np.sin(2 * np.pi * frequency[:, None] * t[:, None] + phase[:, None]))
    return _scaled(x * _window(t)[:, None], limits)


def _points(t: Array, limits: MotionLimits, random: np.random.Generator) -> Array:
    n = len(limits.lower)
    out = np.empty((len(t), n))
    here, now = np.zeros(n), 0
    out[:] = here
    while now < len(t):
        there = random.uniform(-1.0, 1.0, n) * limits.reach
        if random.random() < 0.25:  # one joint alone
            alone = random.integers(n)
            there = np.where(np.arange(n) == alone, there, here)
        share, left = random.uniform(SLOWEST, 1.0), t[-1] - now / RATE - LONGEST_REST_S
        while now == 0 and left < 2 * _seconds(there, limits, SLOWEST) and np.abs(there).max() > NEAREST:
            there *= 0.8  # less distance in a short motion
        seconds = _seconds(there - here, limits, share)
        if left < seconds + _seconds(there, limits, SLOWEST):  # no time to return
            there, seconds = np.zeros(n), _seconds(here, limits, random.uniform(SLOWEST, 1.0))
        rows = round(seconds * RATE)
        block = here + (there - here) * _quintic(np.arange(rows) / max(rows - 1, 1))[:, None]
        keep = min(rows, len(t) - now)
        out[now : now + keep] = block[:keep]
        rest = now + rows + round(random.uniform(0.2, LONGEST_REST_S) * RATE)
        out[now + keep : rest] = there
        here, now = there, rest
        if not here.any():
            break
    out[min(now, len(t)) :] = here
    return out


def _seconds(way: Array, limits: MotionLimits, share: float) -> float:
    """Duration of a quintic move at a share of the limits; its peaks are 1.875 d/T and 5.7735 d/T²."""
    distance = np.abs(way)
    fast = np.maximum(1.875 * distance / limits.velocity, np.sqrt(5.7735 * distance / limits.acceleration))
    return max(0.5, float(fast.max()) / share)


def _sweeps(t: Array, limits: MotionLimits, random: np.random.Generator) -> Array:
    """Triangles with rounded corners, each joint at its own, slowly varying pace."""
    n = len(limits.lower)
    pace = random.uniform(0.04, 0.14, n) * (1.0 + 0.6 * np.sin(2 * np.pi * t[:, None] / random.uniform(15.0, 40.0, n)))
    phase = 2 * np.pi * np.cumsum(pace, axis=0) / RATE + random.uniform(0.0, 2 * np.pi, n)
    x = np.arcsin(0.985 * np.sin(phase)) / np.arcsin(0.985)
    return _scaled(x * _window(t)[:, None], limits)


def _chirp(t: Array, limits: MotionLimits, random: np.random.Generator) -> Array:
    """0.5 to 9 Hz at a nearly constant acceleration."""
    low, high = 0.5, 9.0
    frequency = low * (high / low) ** (t / t[-1])
    phase = 2 * np.pi * np.cumsum(frequency) / RATE
    shift = random.uniform(0.0, 2 * np.pi, len(limits.lower))
    most = 0.6 * limits.acceleration
    amplitude = most / ((2 * np.pi * frequency[:, None]) ** 2 + most / 0.15)  # at most 0.15 rad
    return np.asarray(amplitude * np.sin(phase[:, None] + shift) * _window(t)[:, None])


def _window(t: Array) -> Array:
    """Rises from 0 to 1 and falls back within 3 s (a quarter of a short motion), C² at both ends."""
    return _quintic(np.clip(np.minimum(t, t[-1] - t) / min(3.0, 0.25 * t[-1]), 0.0, 1.0))


def _quintic(s: Array) -> Array:
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def _scaled(x: Array, limits: MotionLimits) -> Array:
    """Scaled per joint to the limits of reach, velocity and acceleration."""
    v, a = derivatives(x)
    use = [limits.reach / np.abs(x).max(0), limits.velocity / np.abs(v).max(0), limits.acceleration / np.abs(a).max(0)]
    return np.asarray(x * np.minimum.reduce(use))
