"""What passes between the bus loop and the service: samples in batches, answers; never a lock, never a wait."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.bus.can_bus import CanBus
from armlink.link.types import Sample, Stats

Array = NDArray[np.float64]
CHANNELS = ("position", "velocity", "torque", "motor_torque", "torque_command", "position_command")


@dataclass
class LoopOptions:
    """What the loop needs to know."""

    arm: ArmFile
    bus: str | None = None
    listen_only: bool = False
    work: bool = False
    pace: bool = True
    """In-process simulated arm: keep to the machine's time. Without, simulated time passes as fast as it can."""
    seed: int = 0
    open_bus: Callable[[], CanBus] | None = field(default=None, repr=False)
    """Gives the bus in tests; by default it is opened by name."""


@dataclass(frozen=True)
class Batch:
    """Samples of a tenth of a second."""

    t: Array
    """(K,) by the loop's monotonic clock [s]."""
    channels: dict[str, Array]
    """Names of CHANNELS → (K, n), NaN where missing."""
    status: NDArray[np.int64]
    """Newest status words (n,)."""
    age: Array
    """Time since position and torque last came (n,) [s]."""
    stats: Stats
    emergencies: tuple[tuple[int, int, int], ...] = ()
    """(Joint, code, error register) of emergencies heard beside another controller."""

    @classmethod
    def of(
        cls,
        rows: list[tuple[float, Sample, Array, Array]],
        stats: Stats,
        emergencies: tuple[tuple[int, int, int], ...] = (),
    ) -> "Batch":
        """From (t, sample, torque command, position command) of K > 0 cycles."""
        samples = [row[1] for row in rows]
        channels = {name: np.array([getattr(sample, name) for sample in samples]) for name in CHANNELS[:4]}
        channels["torque_command"] = np.array([row[2] for row in rows])
        channels["position_command"] = np.array([row[3] for row in rows])
        last = samples[-1]
        return cls(
            np.array([row[0] for row in rows]),
            channels,
            last.status.copy(),
            last.age.copy(),
            replace(stats),
            emergencies,
        )


@dataclass(frozen=True)
class Up:
    """The bus is there and the joints answer."""

    held: tuple[tuple[float, float, int], ...] | None
    """Gain, offset [N·m] and record id that each controller holds; None where only listened to."""


@dataclass(frozen=True)
class Down:
    """The bus or a joint is not there, or has failed; tried again by itself."""

    reason: str


@dataclass(frozen=True)
class Request:
    """Something that the service asks of the loop."""

    id: int
    what: Literal["read", "write", "sweep", "stop"]
    arguments: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Reply:
    """The answer to a request; `error` is one line where it failed."""

    id: int
    value: Any = None
    error: str | None = None
    status: int = 0
    """Exit status of the error: 1 refused, 2 bad input, 3 bus fault."""


@dataclass(frozen=True)
class Progress:
    """How far a sweep is."""

    done: int
    total: int
    """Poses."""


@dataclass(frozen=True)
class Alive:
    """The loop runs and has nothing else to say."""


Message = Alive | Batch | Up | Down | Reply | Progress
