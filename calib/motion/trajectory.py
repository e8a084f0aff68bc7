"""Trajectories between two poses: synchronous, within speed and acceleration limits, with rounded acceleration.

And ordinary work for a simulated arm: endless random waypoints inside the joint range, short moves, short rests.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle

import numpy as np

from armlink.link.types import Command, Sample
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


@dataclass(frozen=True)
class WorkMotion:
    reach: float = 0.8
    """Longest move of a joint from one waypoint to the next [rad]."""
    margin: float = 0.1
    """Distance kept from the stops [rad]."""
    speed_share: float = 0.8
    """Of each joint's largest velocity."""
    acceleration: float = 3.0
    """[rad/s²]"""
    rest: float = 0.5
    """Rest at each waypoint [s]: settling and average of the rest detection, and a little more."""


@dataclass(eq=False)
class PoseWalk:
    """A `Controller`: a tour of poses, then work, to and fro along its poses without end, or rest."""

    start: Array
    """Where the arm is held (n,) [rad]."""
    tour: Array
    """(P, n) [rad]; may be empty."""
    work: Array
    """(W, n) [rad]; may be empty."""
    max_velocity: Array
    period: float
    done: int = 0
    _targets: Iterator[Array] | None = None

    @property
    def progress(self) -> tuple[int, int] | None:
        """Poses done and in all; None where there is no tour."""
        return (self.done, len(self.tour)) if len(self.tour) else None

    def command(self, sample: Sample) -> Command:
        if self._targets is None:
            self._targets = self._motion()
        return Command.hold(next(self._targets))

    def _motion(self) -> Iterator[Array]:
        here, motion = self.start, WorkMotion()
        for pose in self.tour:
            yield from way_and_rest(here, pose, self.max_velocity, self.period, motion)
            self.done, here = self.done + 1, pose
        for pose in cycle([*self.work, *self.work[-2:0:-1]]):
            yield from way_and_rest(here, pose, self.max_velocity, self.period, motion)
            here = pose
        while True:
            yield here


def work_targets(
    start: Array,
    lower: Array,
    upper: Array,
    max_velocity: Array,
    period: float,
    random: np.random.Generator,
    motion: WorkMotion | None = None,
) -> Iterator[Array]:
    """Position targets (n,) [rad], one a cycle of `period` [s], without end: the way to another pose, the rest there, …

    `start` is where the arm is; lower and upper (n,) [rad] are its stops, max_velocity (n,) [rad/s].
    """
    motion = motion or WorkMotion()
    middle, half = (lower + upper) / 2, np.maximum((upper - lower) / 2 - motion.margin, 0.0)
    here = np.array(start, dtype=float)
    while True:
        nearest, farthest = (
            np.maximum(middle - half, here - motion.reach),
            np.minimum(middle + half, here + motion.reach),
        )
        goal = random.uniform(np.minimum(nearest, farthest), np.maximum(nearest, farthest))
        yield from way_and_rest(here, goal, max_velocity, period, motion)
        here = goal


def way_and_rest(here: Array, goal: Array, max_velocity: Array, period: float, motion: WorkMotion) -> Array:
    """Position targets (K, n) [rad] of the way to a pose (n,) and the rest there."""
    speed, acceleration = motion.speed_share * max_velocity, np.full_like(here, motion.acceleration)
    way = trajectory(here, goal, speed, acceleration, period)
    return np.vstack([way, np.repeat(goal[None], round(motion.rest / period), axis=0)])
