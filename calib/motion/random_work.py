"""Ordinary work for a simulated arm: endless random waypoints inside the joint range, short moves, short rests."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from armlink.link.types import Command, Sample
from calib.motion.trajectory import trajectory
from gcomp.arrays import Array

SLOW_SETTLING = 0.5
"""A joint under MIT gains settles so much later [s]: its host's integral term has to forget the torque of braking."""


@dataclass(frozen=True)
class WorkMotion:
    """How the arm moves."""

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

    @classmethod
    def of_drives(cls, with_integral: bool) -> "WorkMotion":
        """Work of an arm whose drives have an integral term, or of one whose host adds it: that one settles later."""
        return cls() if with_integral else cls(rest=cls.rest + SLOW_SETTLING)


TOUR = WorkMotion(reach=10.0)
"""A tour's moves may span the whole range of a joint [rad]."""


@dataclass(eq=False)
class RandomMotion:
    """A `Controller`: a tour of poses over the whole range, then ordinary work or rest."""

    start: Array
    """Where the arm is held (n,) [rad]."""
    lower: Array
    upper: Array
    max_velocity: Array
    period: float
    seed: int
    poses: int
    """Of the tour; 0: none."""
    work: bool
    done: int = 0
    _targets: Iterator[Array] | None = None

    @property
    def progress(self) -> tuple[int, int] | None:
        """Poses done and in all; None where there is no tour."""
        return (self.done, self.poses) if self.poses else None

    def command(self, sample: Sample) -> Command:
        if self._targets is None:
            self._targets = self._motion()
        return Command.hold(next(self._targets))

    def _motion(self) -> Iterator[Array]:
        here = self.start
        if self.poses:
            for piece in islice(self._pieces(here, TOUR), self.poses):
                yield from piece
                self.done, here = self.done + 1, piece[-1]
        if self.work:
            for piece in self._pieces(here, WorkMotion()):
                yield from piece
        while True:
            yield here

    def _pieces(self, here: Array, motion: WorkMotion) -> Iterator[Array]:
        random = np.random.default_rng([self.seed, 8])
        return work_pieces(here, self.lower, self.upper, self.max_velocity, self.period, random, motion)


def work_targets(
    start: Array,
    lower: Array,
    upper: Array,
    max_velocity: Array,
    period: float,
    random: np.random.Generator,
    motion: WorkMotion | None = None,
) -> Iterator[Array]:
    """Position targets (n,) [rad], one a cycle of `period` [s], without end; as work_pieces has them."""
    for piece in work_pieces(start, lower, upper, max_velocity, period, random, motion or WorkMotion()):
        yield from piece


def work_pieces(
    start: Array,
    lower: Array,
    upper: Array,
    max_velocity: Array,
    period: float,
    random: np.random.Generator,
    motion: WorkMotion,
) -> Iterator[Array]:
    """Pieces (K, n) of position targets [rad] without end: the way to another pose and the rest there.

    `start` is where the arm is; lower and upper (n,) [rad] are its stops, max_velocity (n,) [rad/s].
    """
    middle, half = (lower + upper) / 2, np.maximum((upper - lower) / 2 - motion.margin, 0.0)
    here = np.array(start, dtype=float)
    while True:
        nearest, farthest = (
            np.maximum(middle - half, here - motion.reach),
            np.minimum(middle + half, here + motion.reach),
        )
        goal = random.uniform(np.minimum(nearest, farthest), np.maximum(nearest, farthest))
        speed, acceleration = motion.speed_share * max_velocity, np.full_like(here, motion.acceleration)
        way = trajectory(here, goal, speed, acceleration, period)
        yield np.vstack([way, np.repeat(goal[None], round(motion.rest / period), axis=0)])
        here = goal
