"""Trajectories between two poses: synchronous, within speed and acceleration limits, with rounded acceleration."""

import numpy as np

from gcomp.arrays import Array

ROUNDING = 0.06
"""Time over which steps in acceleration are spread [s]."""
GOAL_TOLERANCE = 1e-12
"""A joint so near its goal is there [rad]."""


def trajectory(start: Array, goal: Array, speed: Array, acceleration: Array, period: float) -> Array:
    """Targets (K, n) [rad], one a cycle, from start to goal (n,), all joints arriving together.

    speed (n,) [rad/s] and acceleration (n,) [rad/s²] bound each joint; the last row is the goal itself. The profile
    is a trapezoid in speed, averaged over `ROUNDING`.
    """
    distance = np.abs(goal - start)
    moving = distance > GOAL_TOLERANCE
    if not moving.any():
        return np.empty((0, len(start)))
    top = float(np.min(speed[moving] / distance[moving]))  # of the path parameter s from 0 to 1 [1/s]
    gain = float(np.min(acceleration[moving] / distance[moving]))
    ramp = min(top / gain, float(np.sqrt(1 / gain)))
    total = ramp + 1 / (gain * ramp)
    count = max(int(np.ceil(total / period)), 2)
    t: Array = np.arange(1, count + 1, dtype=np.float64) * (total / count)
    s = _trapezoid(t, total, ramp)
    width = max(round(ROUNDING / period), 1)
    padded = np.concatenate([np.zeros(width - 1), s, np.ones(width - 1)])
    smooth = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    smooth[-1] = 1.0
    return start + smooth[:, None] * (goal - start)


def _trapezoid(t: Array, total: float, ramp: float) -> Array:
    """Path parameter at times t: speeds up during `ramp`, slows down during the last `ramp` of `total`."""
    top = 1 / (total - ramp)
    up = 0.5 * top / ramp * t**2
    level = top * (t - 0.5 * ramp)
    down = 1 - 0.5 * top / ramp * (total - t) ** 2
    return np.where(t < ramp, up, np.where(t <= total - ramp, level, down))
