"""The interface of a drive family: orders in SI units become frames, frames become readings.

A family is one folder under `armlink/drives` (or any installed package) with a `Family` object, named in the
entry-point group `armlink.drives`:

    [project.entry-points."armlink.drives"]
    damiao = "armlink.drives.damiao.family:FAMILY"

What stays in the link, the same for all families: time, ages of readings, the gate and its limits, the integral term of
position control for drives that have none, calibration in the host, direction, zero and gear, faults by silence.

**Order of calls.** `Family.build` makes one `Drives` for the joints of this family on one bus; nothing is sent.
`identify` (scan, check) may come at any time before cycles. `set_up` comes once at the start, after which every cycle
is: `frames(orders, now)`, `sent(joint)` for each joint, then the frames leave, `take` for each frame that comes,
`alarm` and `fault`. `take` is also called for frames that come while an `Ask` waits, and before `set_up`: a family that
does not know a scale yet returns None.

Everything runs in one thread. No method may block, but those that get an `Ask`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.bus.port import Frame
from armlink.drives.board import Board
from armlink.drives.findings import FoundDrives, Result, SetupFinding
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup, power_name
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault
from armlink.torque_calibration import Calibration

T = TypeVar("T")

BROADCAST = -1
"""Stands for the joint of a frame to all of them, or of any of them."""
ANY = -1
"""Stands for every identifier in `Drives.routes`."""
ANSWER, TRIES = 0.1, 3
"""Default patience for an answer [s], and how often a request is sent."""


class Ask(Protocol):
    """Requests to drives outside of the cycle. Frames that are no answer still reach `Drives.take`."""

    def __call__(
        self, frame: Frame, answer: Callable[[int, bytes], T | None], timeout: float = ANSWER, tries: int = TRIES
    ) -> T | None:
        """Send `frame`; the first value that `answer(can_id, data)` gives for a frame that comes within `timeout` [s],
        the request being repeated up to `tries` times. None if nothing answers."""
        ...

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame that nothing answers."""
        ...

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Let frames come in until `done()`, at most `timeout` seconds; whether it is done."""
        ...

    def now(self) -> float:
        """The link's clock [s]."""
        ...


class Drives(Protocol):
    """The drives of one family on one bus. `joint` is always an index among these drives: 0 … m−1, in arm order.

    `armlink.drives.base.BasicDrives` implements all that does not depend on the protocol; a family derives from it.
    """

    def traits(self, joint: int) -> Traits:
        """Traits of one drive; they may depend on its keys in the arm file, and after `set_up` on what it has."""
        ...

    def routes(self) -> Mapping[int, int]:
        """Identifiers (with flags) that the drives send → joint or BROADCAST; only these frames reach `take`.

        With the key ANY it also gets frames that no family on this bus has named, for identifiers that carry data.
        """
        ...

    def commands(self) -> Mapping[int, str]:
        """Identifiers that only a host sends, and what they are: heard from another, they are a second host."""
        ...

    def missing(self, ask: Ask) -> list[int]:
        """Drives that do not answer. Sets nothing."""
        ...

    def intrusion(self, can_id: int, data: bytes) -> str:
        """The name of a frame that no drive of ours sends, if only another host that commands sends it; else empty."""
        ...

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """Ask every drive what it is; one that does not answer is there with `present` false. Sets nothing."""
        ...

    def fits(self, limits: Sequence[Limits]) -> None:
        """Raise BadInput where files that the arm file names, or limits, can fit no drive; asks no drive."""
        ...

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """Make the drives ready for cycles, without power in the motors: scales read from the drive, never from a
        table; mode of control, limits and watchdog written to RAM, never to flash, and read back.

        Raises BusFault naming the joint, BadInput where the arm file does not match, Refused for another drive.
        """
        ...

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        """Frames of one cycle at time `now`, one order a joint, in this order on the bus; None: no frame for a joint.

        An order whose `power` is not reached is answered with the step that leads there (see Order.walk). Values beyond
        what a frame can carry are limited to it, and rounding never leads out of `Limits`; zero torque is rounded to
        the nearest step.
        """
        ...

    def sent(self, joint: int) -> Order | None:
        """This drive's order by the bytes of the newest `frames`, decoded from the bytes: the gate checks it before
        they leave. None where they carry no target (they switch it, ask it, stop it)."""
        ...

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """Decode a frame of a drive; None if it tells nothing, or is not as it should be (any bytes may come)."""
        ...

    def power(self, joint: int) -> Power: ...

    def state_request(self, joint: int) -> list[Frame]:
        """Frames by which a drive tells its state although it is not commanded, and that are no command; empty where
        it tells by itself."""
        ...

    def lets_go(self, joint: int) -> bool:
        """Whether a drive, as it is now, leaves its motor without power."""
        ...

    def ready(self, joint: int) -> bool:
        """Whether a drive is ON in the mode it was last ordered in."""
        ...

    def alarm(self) -> BusFault | None:
        """The first event of a fault that a drive has told of itself since `forget`; None if there is none."""
        ...

    def fault(self, modes: Sequence[int], now: float) -> BusFault | None:
        """The first fault by the drives' states, where each joint with a mode was to be ON; None if there is none.

        A `Stall` where the drive stopped by itself because it did not hear its host. Silence is the link's concern.
        """
        ...

    def has_restarted(self, joint: int) -> bool:
        """Whether a drive has restarted since the set-up, so that its settings are lost."""
        ...

    def own_stop(self, joint: int) -> str:
        """Why a drive stopped by itself, where that is because it did not hear its host; else empty."""
        ...

    def stuck(self, joint: int, target: Power, seconds: float) -> str:
        """Why a drive is not in `target` after `seconds`, in words that name the joint."""
        ...

    def forget(self, restarts: bool = False) -> None:
        """Forget alarms of the past: a walk to ON begins, or has succeeded; before a set-up also `restarts`."""
        ...

    def recover(self, ask: Ask) -> None:
        """After a Stall: bring drives back that left the communication; for most there is nothing to do."""
        ...

    def temperature(self, joint: int, ask: Ask) -> float:
        """Temperature of a drive [°C], NaN if it has none."""
        ...

    def cycle_bits(self) -> float:
        """Bit times of the nominal rate that a cycle of these drives takes at most, all stuff bits included."""
        ...

    def cycle_ids(self) -> frozenset[int]:
        """Identifiers of a frame that begins a cycle (SYNC); empty where none does."""
        ...

    def reading_ids(self) -> Mapping[int, int]:
        """Identifiers of the frames that bring a position → joint; for statistics of the cycle."""
        ...

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        """Further state of a drive, by name, for the monitor; `sends`: its readings come."""
        ...

    def poll(self, first: bool) -> list[Frame]:
        """Frames by which a monitor without a host makes the drives send readings, and that command nothing; empty
        where there are none. `first`: what comes before all others."""
        ...

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """Joint (or BROADCAST) and order of a host's frame, for listening beside another host; None if it is none.

        Fields that the frame does not tell are NaN.
        """
        ...


@runtime_checkable
class FillsBoard(Protocol):
    """Drives whose cyclic frames fill the board without a Reading between, where every microsecond counts."""

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """Identifier → what puts such a frame's data on the board; `places` of these joints on it."""
        ...


@runtime_checkable
class KeepsCalibration(Protocol):
    """Drives that keep gain and offset of their torque reading, and apply them."""

    def read_calibration(self, joint: int, ask: Ask) -> Calibration:
        """The calibration that is active; raises BusFault."""
        ...

    def write_calibration(self, joint: int, ask: Ask, calibration: Calibration, store: bool = False) -> Calibration:
        """Make a calibration active (`store`: in flash too), read it back; raises BadInput, BusFault."""
        ...


@runtime_checkable
class TellsSerialNumber(Protocol):
    """Drives that can be asked for their serial number at any time, within cycles too."""

    def serial_number(self, joint: int, ask: Ask) -> str:
        """Vendor, product and serial number, which no other drive has; empty if this one has none. Raises BusFault."""
        ...


@runtime_checkable
class TellsCurrent(Protocol):
    """Drives whose current can be asked for, where the arm file has its torque constant."""

    def torque_by_current(self, joint: int, ask: Ask) -> tuple[float, float] | None:
        """Torque as the drive reports it, and current times torque constant, at one time [N·m]; None where the arm
        file has no constant, or the drive does not answer."""
        ...


@runtime_checkable
class TellsPosition(Protocol):
    """Drives that tell where they stand without being set up."""

    def positions(self, ask: Ask) -> list[float]:
        """Position of every drive [rad], NaN of one that does not answer or whose scale is not known. Sets nothing."""
        ...


@runtime_checkable
class Guarded(Protocol):
    """Drives whose command frames a guard of the bus can check by their bytes alone."""

    def guard_rules(self, ask: Ask, limits: Sequence[Limits]) -> dict[str, Any]:
        """`frames`, `stop` and `restarts` of a policy (armlink.guard.bus_guard); drives are read, and nothing is set.

        Raises BusFault, BadInput.
        """
        ...


@runtime_checkable
class Replays(Protocol):
    """Drives whose frames can be made again from a recording."""

    def replayed(self, first: bool, readings: Sequence[Reading]) -> list[Frame]:
        """Frames by which host and drives would have brought these readings in a cycle; `first`: of the recording."""
        ...


@dataclass(frozen=True)
class Family:
    """A drive family."""

    name: str
    traits: Traits
    """Of a drive with the default keys; for `armlink drives`."""
    settings: type[DriveSettings]
    """Keys of `link.joints[].drive`."""
    build: Callable[[ArmFile, Sequence[LinkJoint]], Drives]
    """`build(arm, joints)`: the drives of these joints of an arm, all on one bus; sends nothing. Raises BadInput."""
    self_test: Callable[..., list[Result]] | None = None
    """`self_test(link, drives, limits, power, progress)` of an arm with these drives alone, open and not started, where
    it goes further than the one for all families."""
    search: Callable[..., int] | None = None
    """`search(arm or None, bus or None, json, write)`: `armlink scan` of a whole bus; None: each drive is asked."""
    find: Callable[[CanBus], FoundDrives] | None = None
    """`find(bus)`: the drives on an open bus, asked without an arm file; None: they are found by their ids alone."""
    examine: Callable[[ArmFile, CanBus, str], Iterator[SetupFinding]] | None = None
    """`examine(arm, bus, name)`: what the drives of an arm with this family alone say against its file, on an open bus
    of this name; they are only read. None: each drive is asked who it is."""
    state_name: Callable[[int], str] = power_name
    """State of a drive in words, from its code in `Sample.status`; by default an index of Power."""
    summary: str = ""
    """Which devices these are, in a line."""
