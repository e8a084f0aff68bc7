"""Input and output of a cycle of the link, in SI units: commands, samples, counters."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.drives.canopen.cia402 import Mode, State
from armlink.link.guard import Guard
from armlink.link.lateness import Lateness
from armlink.torque_calibration import TorqueCalibration


@dataclass(eq=False)
class Command:
    """One cycle's command for n joints; each joint uses the field that its mode needs, the other may be NaN."""

    mode: NDArray[np.int8]
    """0 off, 8 cyclic synchronous position, 10 cyclic synchronous torque; (n,)."""
    torque: Array
    """Target torque [N·m], (n,)."""
    position: Array
    """Target position by the joint's own sensor [rad], (n,)."""
    t: float | None = None
    """When it was decided, by the link's clock [s]; None: now. The gate refuses a command that is too old."""
    guard: Guard | None = None
    """Bounds within which the command holds; the cycle that finds one crossed raises Crossed."""

    @classmethod
    def hold(cls, position: Array) -> "Command":
        """Every joint under position control at `position` [rad]."""
        n = position.size
        return cls(np.full(n, Mode.POSITION, np.int8), np.zeros(n), position.copy())


@dataclass(eq=False)
class Setpoints:
    """Commands of K cycles to come."""

    mode: NDArray[np.int8]
    """(n,), see Command."""
    torque: Array
    """[N·m], (K, n), or (n,) for all rows."""
    position: Array
    """[rad], (K, n)."""
    guard: Guard | None = None

    @classmethod
    def follow(cls, position: Array, guard: Guard | None = None) -> "Setpoints":
        """Every joint under position control along position (K, n) [rad]."""
        n = position.shape[1]
        return cls(np.full(n, Mode.POSITION, np.int8), np.zeros(n), position, guard)

    def __len__(self) -> int:
        """Rows."""
        return len(self.position)

    def __getitem__(self, rows: slice) -> "Setpoints":
        """Some of the rows."""
        torque = self.torque if self.torque.ndim == 1 else self.torque[rows]
        return Setpoints(self.mode, torque, self.position[rows], self.guard)

    def command(self, row: int) -> Command:
        """The command of one row."""
        torque = self.torque if self.torque.ndim == 1 else self.torque[row]
        return Command(self.mode, torque, self.position[row], guard=self.guard)


class Controller(Protocol):
    """Decides each cycle's command in the process that makes the cycles; must be picklable."""

    def command(self, sample: "Sample") -> Command:
        """The next command, from the newest sample; within a fraction of a period."""
        ...


@dataclass(eq=False)
class Sample:
    """Readings of n joints in one cycle; a value that did not come in this cycle is NaN, never the last one."""

    t: float
    """Time of the SYNC that asked for it, since the link's first [s]."""
    position: Array
    """Position sensor [rad], (n,); each cycle (TPDO1)."""
    velocity: Array
    """[rad/s], (n,); each fourth cycle (TPDO2), NaN in the others."""
    torque: Array
    """Link-side torque sensor as the controller calibrates it [N·m], (n,); each cycle (TPDO1)."""
    motor_torque: Array
    """Torque actual value 6077h [N·m], (n,); each fourth cycle (TPDO2), NaN in the others."""
    status: NDArray[np.int64]
    """Newest status word 6041h, (n,); sent when it changes, so the last one stands."""
    age: Array
    """Time since position and torque last came [s], (n,); 0 where they came in this cycle, inf before the first."""
    timely: NDArray[np.bool_] | None = None
    """(n,) whether the reading came in the cycle that asked for it, of a host on time; None: all. Only such readings
    tell anything about an encoder, a cable or a drive."""
    delay: float = 0.0
    """Time from SYNC to the last reading of the cycle [s]: the readings were taken within it."""
    late: float = 0.0
    """How late the SYNC left [s]."""

    @property
    def all_timely(self) -> bool:
        """Whether the readings of all joints are timely."""
        return self.timely is None or bool(self.timely.all())


@dataclass(frozen=True)
class Identity:
    """One node as `scan` finds it."""

    joint: str
    """Joint name of the arm file; empty for a node that the arm file does not know."""
    node: int
    present: bool
    name: str = ""
    device_type: int = 0
    vendor: int = 0
    product: int = 0
    revision: int = 0
    serial: int = 0
    state: State = State.UNKNOWN
    answers: int = 1
    """How many answered one request at this node id; more than one is a duplicated id."""


@dataclass(frozen=True)
class Calibration(TorqueCalibration[float]):
    """Torque sensor calibration in a joint controller (2100h), and which record it is from."""

    record_id: int = 0
    date: int = 0
    """Date of the record [s since 1970]; 0 if none was written."""
    crc: int = 0
    """CRC-32 as the controller reports it; ignored in a calibration that is to be written."""

    @property
    def is_blank(self) -> bool:
        """Whether no calibration was ever written: gain 1, offset 0, record 0."""
        return (self.gain, self.offset, self.record_id) == (1.0, 0.0, 0)


@dataclass
class Stats:
    """Counters of the link since its first cycle."""

    frames: int = 0
    """Frames sent and received."""
    cycles: int = 0
    missed: int = 0
    """Sensor frames (TPDO1) that did not come in their cycle."""
    late: int = 0
    """Cycles that began more than a tenth of a period late."""
    lateness: Lateness = field(default_factory=Lateness)
    """How late the cycles began."""
    asked: int = 0
    """SYNCs sent while cycling."""
    came: tuple[int, ...] = ()
    """Readings of each joint that came, in their cycle or late."""
    errors: int = 0
    """Error frames and frames of a wrong length."""
    rate_hz: float = 0.0
    """Cycles a second, measured."""
    load: float = 0.0
    """Share of the bus that the frames take at its bit rate, without stuff bits, which are a tenth more."""


Tell = Callable[[str], None]
"""Called with what is being done."""
Samples = Generator[Sample, None, None]
"""Samples as they come; close it to end what brings them."""
