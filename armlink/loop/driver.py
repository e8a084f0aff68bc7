"""The interface between jobs and the process that makes the cycles: the same in one process and in two."""

from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, Self, TypeVar

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.orders import DriveIdentity
from armlink.link.types import Calibration, Command, Controller, DriveSerial, Sample, Samples, Setpoints, Stats, Tell

R = TypeVar("R")
P = ParamSpec("P")


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


class ArmDriver(Controllers, Protocol):
    """Drives the joints of one arm.

    Implemented by `armlink.link.link.Link`, which makes each cycle when it is asked for the next sample, and by
    `armlink.loop.remote_link.RemoteLink`, whose process keeps the cycle whatever the job is doing: the last command
    stays in force until the next one comes.
    """

    arm: ArmFile
    names: tuple[str, ...]
    n: int
    rate: float
    """Cycles a second [Hz]."""
    period: float
    """[s]."""

    @property
    def position_step(self) -> Array:
        """Smallest change that each position reading can show (n,) [rad]; inf before start()."""

    @property
    def position_sent(self) -> Array:
        """Target position of the newest cycle (n,) [rad]."""

    @property
    def torque_sent(self) -> Array:
        """Target torque of the newest cycle (n,) [N·m]."""

    @property
    def stats(self) -> Stats:
        """Counters since the first cycle."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: Any) -> None: ...

    def scan(self) -> list[DriveIdentity]:
        """Identity and state of each joint's controller."""

    def start(self) -> None:
        """Check and set up the controllers and start them; raises Refused, BusFault, BadInput."""

    def enable(self) -> Sample:
        """Enable every joint under position control where it stands; raises BusFault."""

    def recover(self) -> Sample:
        """Enable again after a Stall; raises BusFault."""

    def disable(self) -> None:
        """Take the power from every joint; raises BusFault."""

    def park(self) -> None:
        """Stow the arm in the pose `link.park` of its file and take the power there; raises BadInput, Refused."""

    def stop(self) -> None: ...

    def cycle(self, command: Command) -> Sample:
        """The sample of a cycle in which this command was in force; raises Refused, Crossed, BusFault."""

    def play(self, setpoints: Setpoints) -> Samples:
        """One row a cycle, sent ahead, and the sample of each; raises as cycle.

        Closing the iterator early stops there.
        """

    def run(self, controller: Controller) -> Samples:
        """A controller in the process that makes the cycles, until the iterator is closed; raises as cycle."""

    def catch_up(self) -> None:
        """Forget samples of cycles that were made while the job did something else."""

    def inside(self, function: Callable[Concatenate[Any, Tell, P], R], tell: Tell, *args: P.args, **kw: P.kwargs) -> R:
        """Call `function(link, tell, ...)` in the process that makes the cycles, which it then makes itself.

        Function, arguments and answer must be picklable. `tell` is called in this process; if this process ends, the
        function's call of it raises.
        """

    @property
    def uncalibrated(self) -> tuple[str, ...]:
        """Joints whose calibration the host is to keep and that have no record in force."""

    def read_temperatures(self) -> Array:
        """Temperatures of the drives (n,) [°C]; NaN for a drive that does not report one. Raises BusFault."""
