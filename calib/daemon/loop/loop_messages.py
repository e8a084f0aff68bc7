"""Messages of the bus loop to the service, beside the answers to its calls: samples in batches, state of the bus."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.bus.can_bus import CanBus
from armlink.drives.board import DriveEvent
from armlink.link.types import Sample, Stats
from armlink.loop.messages import Alive, LoopAnswer, Told
from armlink.loop.realtime import Realtime
from gcomp.arrays import Array

CHANNELS = ("position", "velocity", "torque", "motor_torque", "torque_command", "position_command")


@dataclass
class LoopOptions:
    """Settings of the bus loop."""

    arm: ArmFile
    bus: str | None = None
    listen_only: bool = False
    work: bool = False
    pace: bool = True
    """In-process simulated arm: run in real time; without, simulated time passes as fast as it can."""
    seed: int = 0
    open_bus: Callable[[], CanBus] | None = field(default=None, repr=False)
    """Returns the bus, in tests; by default it is opened by name."""


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
    """What drives told of themselves while only listening."""
    temperature: Array | None = None
    """Of the drives (n,) [°C]; NaN for one that does not tell it."""

    @classmethod
    def of(
        cls,
        rows: list[tuple[float, Sample, Array, Array]],
        stats: Stats,
        emergencies: tuple[DriveEvent, ...] = (),
        temperature: Array | None = None,
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
            temperature,
        )


@dataclass(frozen=True)
class Started:
    """The first message of a loop in a process of its own that drives or hears a bus in real time."""

    realtime: Realtime


@dataclass(frozen=True)
class Up:
    """The bus is open and the joints answer."""

    held: tuple[tuple[float, float, int], ...] | None
    """Gain, offset [N·m] and record id in each controller; None if the loop only listens."""
    uncalibrated: tuple[str, ...] = ()
    """Joints whose calibration the host is to keep and that have no record in force."""


@dataclass(frozen=True)
class Down:
    """The bus or a joint is missing or has failed; the loop retries on its own."""

    reason: str


@dataclass(frozen=True)
class Progress:
    """Progress of a tour of poses."""

    done: int
    total: int
    """Poses."""


Message = Alive | Told | Started | Batch | Up | Down | LoopAnswer | Progress
