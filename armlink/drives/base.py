"""The interface of a drive family: orders in SI units become frames, frames become readings.

What stays in the link, the same for all families: time, ages of readings, the gate and its limits, the integral term of
position control for drives that have none, calibration in the host, direction, zero and gear, faults by silence.

**Order of calls.** `Family.build` makes one `BasicDrives` for the joints of this family on one bus; nothing is sent.
`identify` (scan, check) may come at any time before cycles. `set_up` comes once at the start, after which every cycle
is: `frames(orders, now)`, `sent(joint)` for each joint, then the frames leave, `take` for each frame that comes,
`alarm` and `fault`. `take` is also called for frames that come while an `Ask` waits, and before `set_up`: a family that
does not know a scale yet returns None.

Everything runs in one thread. No method may block, but those that get an `Ask`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from armlink.arm_file import LinkJoint
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.board import Board
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup
from armlink.drives.traits import Traits
from armlink.errors import BadInput, BusFault, Stall
from armlink.torque_calibration import Calibration

T = TypeVar("T")

BROADCAST = -1
"""Stands for the joint of a frame to all of them, or of any of them."""
ANY = -1
"""Stands for every identifier in `routes`."""
ANSWER_TIME, TRIES = 0.1, 3
"""Default patience for an answer [s], and how often a request is sent."""
LONG_IDENTIFIER = 25
"""Bits that an identifier of 29 bits takes more than one of 11, stuff bits included."""


class Ask(Protocol):
    """Requests to drives outside of the cycle. Frames that are no answer still reach `take`."""

    def __call__(
        self, frame: Frame, answer: Callable[[int, bytes], T | None], timeout: float = ANSWER_TIME, tries: int = TRIES
    ) -> T | None:
        """Send `frame`; the first value that `answer(can_id, data)` gives for a frame that comes within `timeout` [s],
        the request being repeated up to `tries` times. None if nothing answers."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame that nothing answers."""

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Let frames come in until `done()`, at most `timeout` seconds; whether it is done."""

    def now(self) -> float:
        """The link's clock [s]."""


@dataclass
class DriveMemory:
    """Knowledge of one drive, which a family extends by what its frames tell."""

    limits: Limits | None = None
    """None before the set-up."""
    sent: Order | None = None
    """By the bytes of the newest frames."""
    position: float = math.nan
    """[rad]."""
    velocity: float = math.nan
    """[rad/s]."""


M = TypeVar("M", bound=DriveMemory)


class BasicDrives(Generic[M]):
    """The drives of one family on one bus. `joint` is always an index among these drives: 0 … m−1, in arm order.

    A family implements routes, commands, identity, prepare, joint_frames, take and command_of, puts the order that its
    bytes carry into `memory[joint].sent`, and returns readings through `note`. Everything else is for what only some
    drives have.
    """

    def __init__(self, joints: Sequence[LinkJoint], traits: Traits, memory: type[M] = DriveMemory) -> None:  # type: ignore[assignment]
        """The drives of these joints; `traits` of all of them, but for who calibrates. Nothing is sent."""
        self.rows = tuple(joints)
        self.names = tuple(joint.name for joint in joints)
        self.settings = [joint.settings for joint in joints]
        self.m = len(self.rows)
        self.memory = [memory() for _ in joints]
        self.powers = [Power.UNKNOWN] * self.m
        self.faults = [""] * self.m
        """Newest faults, in words; empty: none."""
        self.temperatures = [math.nan] * self.m
        """[°C]."""
        self._traits = [
            traits if each.calibration is None else replace(traits, calibration=each.calibration)
            for each in self.settings
        ]

    def where(self, joint: int) -> str:
        """Joint's name and its id on the bus, to begin a message with."""
        return f"{self.names[joint]} ({self.settings[joint].address})"

    def traits(self, joint: int) -> Traits:
        """Traits of one drive; they may depend on its keys in the arm file, and after `set_up` on what it has."""
        return self._traits[joint]

    # ---- identifiers

    def routes(self) -> Mapping[int, int]:
        """Identifiers (with flags) that the drives send → joint or BROADCAST; only these frames reach `take`.

        With the key ANY it also gets frames that no family on this bus has named, for identifiers that carry data.
        """
        raise NotImplementedError

    def commands(self) -> Mapping[int, str]:
        """Identifiers that only a host sends, and what they are: heard from another, they are a second host."""
        raise NotImplementedError

    def intrusion(self, can_id: int, data: bytes) -> str:
        """The name of a frame that no drive of ours sends, if only another host that commands sends it; else empty."""
        return self.commands().get(can_id, "")

    def cycle_ids(self) -> frozenset[int]:
        """Identifiers of a frame that begins a cycle (SYNC); empty where none does."""
        return frozenset()

    def reading_ids(self) -> Mapping[int, int]:
        """Identifiers of the frames that bring a position → joint; for statistics of the cycle."""
        return {can_id: joint for can_id, joint in self.routes().items() if joint >= 0}

    def cycle_bits(self) -> float:
        """Bit times of the nominal rate that a cycle of these drives takes at most, all stuff bits included.

        Here a command and a reply of eight bytes each.
        """
        longer = sum(LONG_IDENTIFIER for traits in self._traits if traits.frame == "29")
        return 2 * (self.m * longest_frame_bits(8) + longer)

    # ---- before the cycle

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """Ask every drive what it is; one that does not answer is there with `present` false. Sets nothing."""
        return [self.identity(joint, ask) for joint in range(self.m)]

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        raise NotImplementedError

    def absent(self, joint: int) -> DriveIdentity:
        return DriveIdentity(joint, self.settings[joint].address, present=False)

    def present(self, joint: int, name: str, serial: str = "", firmware: str = "", mismatch: str = "") -> DriveIdentity:
        address = self.settings[joint].address
        return DriveIdentity(joint, address, True, name, serial, firmware, self.power(joint), mismatch)

    def silent(self, joint: int, hint: str) -> BusFault:
        """The fault of a drive that does not answer its set-up; `hint` is what else to check."""
        return BusFault(
            f"{self.names[joint]}: no answer from {self.settings[joint].address}: check that the drive is powered{hint}"
        )

    def missing(self, ask: Ask) -> list[int]:
        """Drives that do not answer. Sets nothing."""
        return [each.joint for each in self.identify(ask) if not each.present]

    def positions(self, ask: Ask) -> list[float]:
        """Where every drive stands without being set up [rad]; NaN of one that does not answer, whose scale is not
        known, or that does not tell. Sets nothing."""
        return [self.position(joint, ask) for joint in range(self.m)]

    def position(self, joint: int, ask: Ask) -> float:
        return math.nan

    def fits(self, limits: Sequence[Limits]) -> None:
        """Raise BadInput where files that the arm file names, or limits, can fit no drive; asks no drive."""

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """Make the drives ready for cycles, without power in the motors: scales read from the drive, never from a
        table; mode of control, limits and watchdog written to RAM, never to flash, and read back.

        Raises BusFault naming the joint, BadInput where the arm file does not match, Refused for another drive.
        """
        return [self.prepare(ask, joint, limit) for joint, limit in enumerate(limits)]

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        raise NotImplementedError

    def limits_of(self, joint: int) -> Limits:
        """The limits that a drive was set up with; raises BusFault before that."""
        limits = self.memory[joint].limits
        if limits is None:
            raise BusFault(f"{self.names[joint]}: a command came before the set-up")
        return limits

    # ---- the cycle

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        """Frames of one cycle at time `now`, one order a joint, in this order on the bus; None: no frame for a joint.

        An order whose `power` is not reached is answered with the step that leads there (see Order.walk). Values beyond
        what a frame can carry are limited to it, and rounding never leads out of `Limits`; zero torque is rounded to
        the nearest step.
        """
        found: list[Frame] = []
        for joint, order in enumerate(orders):
            if order is not None:
                found += self.joint_frames(joint, order, now)
        return found

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        raise NotImplementedError

    def sent(self, joint: int) -> Order | None:
        """This drive's order by the bytes of the newest `frames`, decoded from the bytes: the gate checks it before
        they leave. None where they carry no target (they switch it, ask it, stop it)."""
        return self.memory[joint].sent

    def safe_frames(self, joint: int) -> Sequence[Frame]:
        """Frames after which a drive stays as its trait `kept` says, whatever its host did last and although none comes
        any more; by the newest readings and order, within `Limits`. Empty for a drive without power."""
        return ()

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """Decode a frame of a drive; None if it tells nothing, or is not as it should be (any bytes may come)."""
        raise NotImplementedError

    def note(self, reading: Reading) -> Reading:
        """Keep what a reading tells of power, fault and temperature; returns it."""
        joint = reading.joint
        if reading.power is not None:
            self.powers[joint] = reading.power
        if reading.fault is not None:
            self.faults[joint] = reading.fault
        if reading.temperature == reading.temperature:  # not NaN
            self.temperatures[joint] = reading.temperature
        return reading

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """Identifier → what puts such a frame's data on the board at once, where every microsecond counts; `places` of
        these joints on it. Frames that are not here go to `take`."""
        return {}

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """Joint (or BROADCAST) and order of a host's frame, for listening beside another host; None if it is none.

        Fields that the frame does not tell are NaN.
        """
        raise NotImplementedError

    def commands_of(self, can_id: int, data: bytes) -> list[tuple[int, Order]]:
        """`command_of`, for frames that may order several joints."""
        found = self.command_of(can_id, data)
        return [] if found is None else [found]

    # ---- states

    def power(self, joint: int) -> Power:
        return self.powers[joint]

    def state_request(self, joint: int) -> list[Frame]:
        """Frames by which a drive tells its state although it is not commanded, and that are no command; empty where
        it tells by itself."""
        return []

    def lets_go(self, joint: int) -> bool:
        """Whether a drive, as it is now, leaves its motor without power; here by its power state, which does not tell
        of a drive that falls where it stops by itself."""
        return self.power(joint) in (Power.OFF, Power.READY, Power.FAULT)

    def ready(self, joint: int) -> bool:
        """Whether a drive is ON in the mode it was last ordered in."""
        return self.power(joint) is Power.ON

    def alarm(self) -> BusFault | None:
        """The first event of a fault that a drive has told of itself since `forget`; None if there is none, or faults
        are states, which `fault` tells."""
        return None

    def fault(self, modes: Sequence[int], now: float) -> BusFault | None:
        """The first fault by the drives' states, where each joint with a mode was to be ON; None if there is none.

        A `Stall` where the drive stopped by itself because it did not hear its host. Silence is the link's concern.
        """
        if self.powers.count(Power.ON) == self.m and not any(self.faults):  # as in most cycles
            return None
        for joint, mode in enumerate(modes):
            if mode and (stopped := self.own_stop(joint)):
                return Stall(stopped)
        for joint, mode in enumerate(modes):
            power = self.powers[joint]
            if self.faults[joint]:
                return BusFault(f"{self.where(joint)}: {self.faults[joint]}")
            if power is Power.FAULT:
                return BusFault(f"{self.where(joint)}: the drive has a fault")
            if mode and power not in (Power.ON, Power.UNKNOWN):
                return BusFault(f"{self.where(joint)}: power is {power.value}, expected on")
        return None

    def has_restarted(self, joint: int) -> bool:
        """Whether a drive has told that it has restarted since the set-up, so that its settings are lost."""
        return False

    def own_stop(self, joint: int) -> str:
        """Why a drive stopped by itself, where that is because it did not hear its host; else empty."""
        if self.powers[joint] is not Power.STOPPED:
            return ""
        return f"{self.where(joint)} stopped itself: it did not hear its host"

    def stuck(self, joint: int, target: Power, seconds: float) -> str:
        """Why a drive is not in `target` after `seconds`, in words that name the joint."""
        if self.faults[joint]:
            return f"{self.where(joint)}: {self.faults[joint]}"
        found = self.powers[joint].value
        return f"{self.where(joint)}: its power stays {found}; within {seconds:g} s it should be {target.value}"

    def forget(self, restarts: bool = False) -> None:
        """Forget alarms of the past: a walk to ON begins, or has succeeded; before a set-up also `restarts`."""
        self.faults = [""] * self.m

    def recover(self, ask: Ask) -> None:
        """After a Stall: bring drives back that left the communication."""

    def temperature(self, joint: int, ask: Ask) -> float:
        """Temperature of a drive [°C], NaN if it has none; here the newest that a reading told."""
        return self.temperatures[joint]

    # ---- what only some drives have

    def serial_number(self, joint: int, ask: Ask) -> str:
        """Vendor, product and serial number, which no other drive has, within cycles too; empty for a drive without.
        Raises BusFault."""
        return ""

    def read_calibration(self, joint: int, ask: Ask) -> Calibration:
        """The calibration that is active in a drive that keeps one; raises BusFault."""
        raise NotImplementedError

    def write_calibration(self, joint: int, ask: Ask, calibration: Calibration, store: bool = False) -> Calibration:
        """Make a calibration active (`store`: in flash too), read it back; raises BadInput, BusFault."""
        raise NotImplementedError

    def torque_by_current(self, joint: int, ask: Ask) -> tuple[float, float] | None:
        """Torque as the drive reports it, and current times torque constant, at one time [N·m]; None where the arm
        file has no constant, or the drive does not tell its current."""
        return None

    def guard_rules(self, ask: Ask, limits: Sequence[Limits]) -> dict[str, Any]:
        """`frames`, `stop` and `restarts` of a policy (armlink.guard.bus_guard); drives are read, and nothing is set.

        Raises BusFault, BadInput.
        """
        raise BadInput(
            f"{self.names[0]}: a guard cannot check frames to {self.settings[0].family} drives: the bytes "
            "alone do not show what a frame commands"
        )

    def replayed(self, first: bool, readings: Sequence[Reading]) -> list[Frame]:
        """Frames by which host and drives would have brought these readings in a cycle; `first`: of the recording.
        Raises BadInput."""
        raise BadInput(f"replay: drives of the family {self.settings[0].family} cannot be replayed onto a bus")

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        """Further state of a drive, by name, for the monitor; `sends`: its readings come."""
        return {"id": self.settings[joint].address}

    def poll(self, first: bool) -> list[Frame]:
        """Frames by which a monitor without a host makes the drives send readings, and that command nothing; empty
        where there are none. `first`: what comes before all others."""
        return []


def no_order() -> Order:
    """An order whose every target is NaN, to be filled by `_replace`: for decoding another host's frames."""
    nan = math.nan
    return Order(Power.ON, False, 0, nan, nan, nan, nan, nan)
