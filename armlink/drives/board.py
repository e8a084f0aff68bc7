"""Newest readings of an arm's joints, as the frames of its drives bring them; the fast way from a frame to a sample."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

NO_STATUS = 0xFFFF
"""Stands for the state code of a joint that has told none."""
EVENTS_KEPT = 64
"""So many events are kept; a storm of them costs no memory."""


class DriveEvent(NamedTuple):
    """A drive's message about itself, such as an emergency."""

    joint: int
    code: str
    """As people write it; empty where the family has none."""
    meaning: str
    evidence: Mapping[str, int] = {}
    """Numbers behind it."""

    @property
    def text(self) -> str:
        return f"emergency {self.code}, {self.meaning}" if self.code else self.meaning


class Board:
    """Buffers of n joints; NaN where nothing has come since the last sample. Values as `Reading` has them."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.position = [math.nan] * n
        self.sensor = [math.nan] * n
        self.motor = [math.nan] * n
        self.velocity = [math.nan] * n
        self.status = [NO_STATUS] * n
        """Newest state code of each joint, by its family."""
        self.awaited = 0
        """Readings of this cycle that have not come yet."""
        self.asked = [1] * n
        """1 for a joint whose readings are replies to the cycle, 0 for one that sends by its own clock."""
        self.came = [0] * n
        """Readings of each joint that came, in their cycle or late."""
        self.unanswered = [0] * n
        """Commands of each joint whose replies are still to come, or lost; replies come in the order of commands."""
        self.answered = [0] * n
        """To which command the newest reading of each joint is the reply: 1 for the newest, 2 for the one before."""
        self.slow_came = False
        """Whether motor torque or velocity of some joint came."""
        self.errors = 0
        """Frames of a wrong length."""
        self.events: deque[DriveEvent] = deque(maxlen=EVENTS_KEPT)
        """In the order of arrival, the newest."""
        self.readings = [0] * n
        """Readings of each joint; the watch of the bus takes stock of them."""
        self.on_again: Callable[[int], None] = lambda joint: None
        """Called where a reading of a joint comes for which there is no command."""
        self.on_slow: Callable[[int], None] = lambda joint: None
        """Called where motor torque and velocity of a joint come apart from its position."""

    def reading(self, joint: int, position: float, sensor: float) -> None:
        """A position, and the torque of a sensor where there is one (else NaN)."""
        self.came[joint] += 1
        self.readings[joint] += 1
        if self.asked[joint]:
            if self.position[joint] != self.position[joint]:  # NaN: the first since the last sample
                self.awaited -= 1
            left = self.answered[joint] = self.unanswered[joint]
            if left:
                self.unanswered[joint] = left - 1
            else:
                self.on_again(joint)
        self.position[joint], self.sensor[joint] = position, sensor

    def slow(self, joint: int, motor: float, velocity: float) -> None:
        self.motor[joint], self.velocity[joint] = motor, velocity
        self.slow_came = True
        self.on_slow(joint)

    def ask(self) -> None:
        """A command to each joint leaves."""
        self.unanswered = [left + asked for left, asked in zip(self.unanswered, self.asked, strict=True)]

    def drop(self) -> None:
        """Forget positions and sensor torques: what comes from now on belongs to the next sample."""
        self.position, self.sensor = [math.nan] * self.n, [math.nan] * self.n
