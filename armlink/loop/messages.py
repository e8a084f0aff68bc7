"""Messages between a job and the process that makes the cycles."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.errors import ArmlinkError
from armlink.link.ends import EndCause
from armlink.link.types import Sample, Setpoints


@dataclass(frozen=True)
class Open:
    """The first message to the loop: which arm, on which bus."""

    arm: ArmFile
    bus: str | None


@dataclass(frozen=True)
class Call:
    """Call a method of the link, or a function with the link; answered by an Answer."""

    id: int
    what: str | Callable[..., Any]
    """A function is called with the link, and with what tells the job what is being done."""
    args: tuple[Any, ...] = ()
    kwargs: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Play:
    """Rows to play after those of the same id; a new id replaces what is being played."""

    id: int
    setpoints: Setpoints


@dataclass(frozen=True)
class RunController:
    id: int
    controller: bytes
    """A pickled Controller: what it imports may take longer than a cycle, so that the loop unpickles it beside them."""


@dataclass(frozen=True)
class Cut:
    """Stop where the playing is; the last command stays in force. A function that is being called is interrupted."""


@dataclass(frozen=True)
class End:
    """Bring the arm to its end, and end."""

    cause: EndCause


@dataclass(frozen=True)
class Drop:
    """Let the arm go at once, whatever is done to end it."""


@dataclass(frozen=True)
class Alive:
    """The job is there."""


@dataclass(frozen=True)
class LoopAnswer:
    """To an Open (id 0) or a Call."""

    id: int
    value: Any = None
    error: ArmlinkError | None = None


@dataclass(frozen=True)
class Told:
    """Progress of a call; id 0: of the end of the arm."""

    id: int
    text: str


@dataclass(frozen=True)
class Stopped:
    """Playing has ended by an error: joints stopped, or held where a bound was crossed."""

    error: ArmlinkError


Cycle = tuple[int, int, bytes]
"""A cycle: id of what is being played or was last, row (−1: none of its), and the packed sample."""


def pack(sample: Sample, torque_sent: Array, position_sent: Array) -> bytes:
    """A sample and what was sent in its cycle."""
    n = len(sample.position)
    timely = np.ones(n) if sample.timely is None else sample.timely
    parts = (sample.position, sample.velocity, sample.torque, sample.motor_torque, sample.status, sample.age, timely)
    head = (sample.t, sample.delay, sample.late)
    return np.concatenate((head, *parts, torque_sent, position_sent)).tobytes()


def unpack(content: bytes) -> tuple[Sample, Array, Array]:
    """The sample, target torque (n,) [N·m] and target position (n,) [rad] of a cycle."""
    values = np.frombuffer(content).copy()
    rows = values[3:].reshape(9, -1)
    timely = rows[6] > 0
    sample = Sample(
        t=float(values[0]),
        position=rows[0],
        velocity=rows[1],
        torque=rows[2],
        motor_torque=rows[3],
        status=rows[4].astype(np.int64),
        age=rows[5],
        timely=None if timely.all() else timely,
        delay=float(values[1]),
        late=float(values[2]),
    )
    return sample, rows[7], rows[8]
