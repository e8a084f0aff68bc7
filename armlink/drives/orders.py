"""Values between the link and a drive family, in SI units: orders, readings, limits, results of the set-up.

All values are at the drive's own output, in the drive's own sense: the link applies direction, zero and gear of the arm
file, and the host's torque calibration, before an order reaches a family and after a reading has left it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum, IntFlag
from typing import NamedTuple


class Mode(IntEnum):
    """Modes of a command. The numbers are those of CiA 402, for every family."""

    OFF = 0
    PROFILE_POSITION = 1
    PROFILE_TORQUE = 4
    POSITION = 8
    TORQUE = 10


MODE_NAMES = {
    Mode.OFF: "no mode",
    Mode.PROFILE_POSITION: "profile position",
    Mode.PROFILE_TORQUE: "profile torque",
    Mode.POSITION: "cyclic synchronous position",
    Mode.TORQUE: "cyclic synchronous torque",
}


class Power(Enum):
    """Power of a drive, as its frames tell it, and as an order wants it (ON, STOPPED or OFF)."""

    UNKNOWN = "unknown"
    """Nothing has been heard yet."""
    OFF = "off"
    """No power in the motor: without a brake the joint is free."""
    READY = "ready"
    """On the way to ON; no power in the motor yet."""
    ON = "on"
    """Follows its orders."""
    STOPPED = "stopped"
    """Power is on and the drive ignores targets: it holds or damps, or has lost its host."""
    FAULT = "fault"


POWERS = tuple(Power)


def power_code(power: Power) -> int:
    """Code of a power state in `Sample.status`."""
    return POWERS.index(power)


def power_name(code: int) -> str:
    return POWERS[code].value if 0 <= code < len(POWERS) else Power.UNKNOWN.value


class Order(NamedTuple):
    """Target of one drive for one cycle."""

    power: Power
    """ON, STOPPED (the safest state that the drive has: hold, else damp, else off) or OFF."""
    walk: bool
    """The drive may be taken towards ON, a fault being cleared on the way, one step a cycle; targets are then where it
    stands. Without it `frames` never switches a drive on: ON means to go on, for a drive that is on."""
    mode: int
    """See Mode; POSITION or TORQUE while power is ON."""
    position: float
    """Target [rad]; where the joint stands under torque control."""
    velocity: float
    """Rate of the position target [rad/s], 0 where it rests."""
    torque: float
    """Target under torque control, feed-forward under position control of a drive with kp and kd [N·m]."""
    kp: float
    """[N·m/rad]; 0 for a drive with a position controller of its own, and under torque control."""
    kd: float
    """[N·m·s/rad]; likewise."""
    refused: str = ""
    """Why the gate refused the command, so that `power` is STOPPED; for the link alone."""


def law_torque(order: Order, position: float, velocity: float) -> float:
    """Torque that an order stands for where its drive stands and moves [N·m]: kp (q* − q) + kd (v* − v) + τ.

    Gains that are 0 or NaN are those of a drive with a controller of its own: τ alone.
    """
    _, _, _, target, rate, torque, kp, kd, _ = order
    if kp > 0:
        torque += kp * (target - position)
    if kd > 0:
        torque += kd * (rate - velocity)
    return torque


def real32_within(value: float, most: float) -> float:
    """A value within ±most that stays within after rounding to a 32-bit float."""
    shrunk = most * (1 - 2.0**-23)
    return max(-shrunk, min(shrunk, value))


def real32_step(value: float) -> float:
    """Step from a 32-bit float to the next, at the most; of values below 1 as of 1."""
    return 2.0**-23 * max(1.0, abs(value))


class Reading(NamedTuple):
    """Values of one frame of a drive; NaN or None where it has none."""

    joint: int
    """Index among the joints of this `Drives`."""
    position: float = math.nan
    """[rad]; unwrapped by the family where its encoding wraps."""
    velocity: float = math.nan
    """[rad/s]."""
    motor_torque: float = math.nan
    """From current [N·m]."""
    sensor_torque: float = math.nan
    """From a torque sensor at the joint [N·m]."""
    temperature: float = math.nan
    """[°C]."""
    power: Power | None = None
    fault: str | None = None
    """Fault that the drive reports, in words with its code; empty: it reports that there is none."""


def name_flags(flags: type[IntFlag], bits: int) -> str:
    """The flags that are set in `bits`, for Reading.fault; empty where none of them is."""
    return ", ".join(str(each.name).lower().replace("_", " ") for each in flags if bits & each)


@dataclass(frozen=True)
class Limits:
    """Limits of one drive, at its output: what no frame may exceed, and what `set_up` sets in the drive if it can."""

    max_torque: float
    """[N·m]."""
    torque_rate: float
    """[N·m/s]."""
    max_velocity: float
    """[rad/s]."""
    lower: float
    """Lower end of the window for position targets [rad]."""
    upper: float
    """Upper end of it [rad]."""
    deadline: float
    """A drive that hears no command for this long must act by itself, as its traits say [s]."""
    period: float
    """Period of the cycle [s]."""


@dataclass(frozen=True)
class Gains:
    """Impedance gains of a drive whose position control is kp (q* − q) + kd (v* − v) + τ, without an integral term."""

    kp: float
    """Used under position control [N·m/rad]."""
    kd: float
    """[N·m·s/rad]."""
    max_kp: float
    """Most that a frame can carry [N·m/rad]."""
    max_kd: float
    """[N·m·s/rad]."""


class ReadingRange(NamedTuple):
    """Values of one quantity that a drive can tell, at its output: beyond them a reading stays at the end."""

    quantity: str
    """`position` [rad], `velocity` [rad/s] or `torque` [N·m]."""
    largest: float
    """It tells from minus this to this."""
    where: str
    """Where the range is set, as people write it: `register 22 (VMAX)`."""
    remedy: str = "set a range of this size or more in the drive"
    """How it is made larger."""


@dataclass(frozen=True)
class Setup:
    """Result of the set-up of one drive; the first cycle starts from it."""

    position: float
    """[rad]."""
    torque: float
    """Torque that the drive produces now [N·m], NaN if it does not tell."""
    position_step: float
    """Smallest change that a position reading can show [rad]."""
    modes: frozenset[int]
    """Modes that the drive can be ordered in."""
    gains: Gains | None = None
    """None: the drive has a position controller of its own, with an integral term."""
    lost: tuple[str, ...] = ()
    """Lacks of the device, each with the function that it costs; for `scan` and `check`."""
    notes: tuple[str, ...] = ()
    """Settings that were read or written, for `check`."""
    scales: Mapping[str, float] = field(default_factory=dict)
    """Scales that were read from the device, by name with unit, for `check`."""
    ranges: tuple[ReadingRange, ...] = ()
    """Ends of its readings, where it has any."""


@dataclass(frozen=True)
class DriveIdentity:
    joint: int
    """Index among the joints of this `Drives`."""
    address: str
    """Id on its bus, as people write it: `node 5`, `id 02h`."""
    present: bool
    name: str = ""
    """Type, as the device tells it."""
    serial: str = ""
    firmware: str = ""
    power: Power = Power.UNKNOWN
    mismatch: str = ""
    """Why it is not the drive that the arm file states, in words; empty if it is."""
