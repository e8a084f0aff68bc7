"""Messages between a job and the process that makes the cycles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.board import DriveEvent
from armlink.errors import ArmlinkError
from armlink.link.ends import EndCause
from armlink.link.types import Calibration, Sample, Setpoints, Stats

BATCH_SECONDS = 0.1
"""Time between two batches of samples of a kept arm [s]: the stream's 10 Hz (docs/daemon-api.md)."""
READINGS, COMMANDS = ("position", "velocity", "torque", "motor_torque"), ("torque_command", "position_command")
CHANNELS = (*READINGS, *COMMANDS)
ROWS = (*READINGS, "status", "age", "timely", *COMMANDS)
"""Values (n,) of a packed sample, in their order, after its time, delay and lateness."""


@dataclass(frozen=True)
class Open:
    """The first message to the loop: which arm, on which bus."""

    arm: ArmFile
    bus: str | None
    kept: bool = False
    """Opened again after each fault (`armlink.loop.kept_arm`); else once."""
    listen_only: bool = False
    """Another controller commands the arm; only where it is kept."""
    log: Callable[[], None] | None = None
    """Called first, to have logs written as the job writes its own."""


@dataclass(frozen=True)
class Call:
    """Call a method of the link, or a function with the link; answered by a LoopAnswer."""

    id: int
    what: str | Callable[..., Any]
    """A function is called with the link, and with what tells the job what is being done."""
    args: tuple[Any, ...] = ()
    kwargs: Mapping[str, Any] = field(default_factory=dict)


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
class End:
    """Bring the arm to its end, and end."""

    cause: EndCause


class JobSignal(Enum):
    ALIVE = "alive"
    """The job is there."""
    CUT = "cut"
    """Stop where the playing is; the last command stays in force. A function that is being called is interrupted."""
    DROP = "drop"
    """Let the arm go at once, whatever is done to end it."""


@dataclass(frozen=True)
class LoopAnswer:
    """To an Open (id 0) or a Call."""

    id: int
    value: Any = None
    error: ArmlinkError | None = None

    def result(self) -> Any:
        if self.error is not None:
            raise self.error
        return self.value


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
    rows = values[3:].reshape(len(ROWS), -1)
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


# ---- of a kept arm


@dataclass(frozen=True)
class Health:
    """How bus and drives are, after the samples of a tenth of a second."""

    stats: Stats
    emergencies: tuple[DriveEvent, ...] = ()
    """Events that drives told of themselves while only listening."""
    temperature: Array | None = None
    """Of the drives (n,) [°C]; NaN for one that does not tell it."""


@dataclass(frozen=True)
class Batch:
    """The samples of a tenth of a second."""

    t: Array
    """(K,) by the loop's monotonic clock [s]."""
    channels: dict[str, Array]
    """Name of CHANNELS → (K, n), SI units, NaN if missing."""
    status: NDArray[np.int64]
    """Newest state codes (n,)."""
    age: Array
    """Time since position and torque last arrived (n,) [s]."""
    stats: Stats
    emergencies: tuple[DriveEvent, ...] = ()
    temperature: Array | None = None

    @classmethod
    def of(cls, packed: Sequence[bytes], begun: float, health: Health) -> "Batch":
        """From K > 0 packed samples, whose times count from `begun` [s]."""
        values = np.frombuffer(b"".join(packed)).reshape(len(packed), -1)
        rows = dict(zip(ROWS, values[:, 3:].reshape(len(packed), len(ROWS), -1).transpose(1, 0, 2), strict=True))
        channels = {name: rows[name].copy() for name in CHANNELS}
        status, age = rows["status"][-1].astype(np.int64), rows["age"][-1].copy()
        return cls(values[:, 0] + begun, channels, status, age, **vars(health))


@dataclass(frozen=True)
class Up:
    """The bus is open and the joints answer."""

    held: tuple[Calibration, ...] | None
    """In each controller; None if the loop only listens."""
    uncalibrated: tuple[str, ...] = ()
    """Joints whose calibration the host is to keep and that have no record in force."""
    begun: float = 0.0
    """When the samples' times begin, by the loop's monotonic clock [s]."""


@dataclass(frozen=True)
class Down:
    """The bus or a joint is missing or has failed; the loop retries on its own."""

    reason: str


@dataclass(frozen=True)
class Progress:
    """Of a controller that has an end and tells how far it is (`progress`)."""

    done: int
    total: int
