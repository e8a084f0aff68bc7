"""Input and output of a cycle of the link, in SI units: commands, samples, counters."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.drives.orders import Mode
from armlink.link.lateness import Lateness
from armlink.link.reading_bounds import ReadingBounds
from armlink.torque_calibration import Calibration as Calibration


@dataclass(frozen=True)
class DriveSerial:
    """A drive's own serial number, whatever the arm file says."""

    number: str = ""
    """Vendor, product and serial number; empty for a drive that tells none, or keeps no calibration."""
    simulated: bool = False
    """It is simulated in this process, and ends with it."""


class Controllers(Protocol):
    """Access to the calibration of every joint, in its controller or in the host."""

    def read_calibration(self, joint: int) -> Calibration:
        """The torque sensor record that joint 0 … n−1 works with; raises BusFault."""

    def drive_serial(self, joint: int) -> DriveSerial:
        """Serial number of the drive of joint 0 … n−1; raises BusFault."""

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Stage, read back and make active in joint 0 … n−1 (`store`: in flash too); returns what is active.

        Raises BadInput, BusFault.
        """


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
    guard: ReadingBounds | None = None
    """Bounds within which the command holds; the cycle that finds one crossed raises Crossed."""

    @classmethod
    def hold(cls, position: Array) -> "Command":
        """Every joint under position control at `position` [rad]."""
        n = position.size
        return cls(np.full(n, Mode.POSITION, np.int8), np.zeros(n), position.copy())


@dataclass(eq=False)
class Setpoints:
    mode: NDArray[np.int8]
    """(n,), see Command."""
    torque: Array
    """[N·m], (K, n), or (n,) for all rows."""
    position: Array
    """[rad], (K, n)."""
    guard: ReadingBounds | None = None

    @classmethod
    def follow(cls, position: Array, guard: ReadingBounds | None = None) -> "Setpoints":
        """Every joint under position control along position (K, n) [rad]."""
        n = position.shape[1]
        return cls(np.full(n, Mode.POSITION, np.int8), np.zeros(n), position, guard)

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: slice) -> "Setpoints":
        torque = self.torque if self.torque.ndim == 1 else self.torque[rows]
        return Setpoints(self.mode, torque, self.position[rows], self.guard)

    def command(self, row: int) -> Command:
        torque = self.torque if self.torque.ndim == 1 else self.torque[row]
        return Command(self.mode, torque, self.position[row], guard=self.guard)


class Controller(Protocol):
    """Decides each cycle's command in the process that makes the cycles; must be picklable."""

    def command(self, sample: "Sample") -> Command:
        """The next command, from the newest sample; within a fraction of a period."""


@dataclass(eq=False)
class Sample:
    """Readings of n joints in one cycle; a value that did not come in this cycle is NaN, never the last one."""

    t: float
    """Time of the SYNC that asked for it, since the link's first [s]."""
    position: Array
    """Position sensor [rad], (n,); in every cycle."""
    velocity: Array
    """[rad/s], (n,); as often as the drives send it, NaN in other cycles."""
    torque: Array
    """Link-side torque sensor as the controller calibrates it [N·m], (n,); in every cycle."""
    motor_torque: Array
    """Motor torque by the drive's own estimate [N·m], (n,); as often as the drives send it, NaN in other cycles."""
    status: NDArray[np.int64]
    """Newest state code of each drive, (n,), by its family (`armlink.link.joints.groups.state_name` has the words)."""
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
        return self.timely is None or bool(self.timely.all())


@dataclass
class Stats:
    """Counters of the link since its first cycle."""

    frames: int = 0
    cycles: int = 0
    missed: int = 0
    """Readings that did not come in their cycle."""
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
