"""Which drive on the bus moves which joint, and the arm file of an arm of which only the bus is known.

Drives are matched by the order of ids, or by turning each joint by hand. Of the bus alone there are drives, ratings and
stops, and no geometry yet.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import Any

from armlink.arm_file import STANDARD_GRAVITY
from armlink.content.yaml_text import yaml_comment, yaml_entry, yaml_item
from armlink.drives.findings import FoundDrive, FoundDrives, SetupFinding
from armlink.errors import BadInput, BusFault
from calib.commissioning.draft import GUESSES, LEAST_TORQUE
from calib.commissioning.model_checks import LEAST_DAMPING

LEAST_TURN = 0.1
"""A joint counts as turned by hand from here on [rad]; a choice, far above the play of a gear."""
LEAST_MOTION_RATIO = 3.0
"""The turned joint's drive must read so many times the motion of any other; a choice."""
SCALE_TOLERANCE = 0.1
"""Share by which the angle between the stops may read differently: calibration corrects a few per cent; a choice."""
POLARITY_REMEDY = "reverse the direction in the drive (its polarity), or the axis in the model"

Ask = Callable[[str], None]
"""Shows a person what to do and returns when it is done."""


@dataclass(frozen=True)
class TurnedJoint:
    name: str
    lower: float
    """[rad]"""
    upper: float
    """[rad]"""
    gear: float = 1.0
    """Turns of the drive's output for one of the joint, as an arm file has it."""


@dataclass(frozen=True)
class Match:
    """The drive of a joint, and how that is known."""

    joint: str
    drive: FoundDrive
    by_hand: bool

    @property
    def note(self) -> str:
        """Comment for the arm file."""
        how = "found by turning the joint by hand" if self.by_hand else "assumed: taken in the order of the node ids"
        return f"node {how}"


def match_in_order(names: Sequence[str], drives: FoundDrives, bus: str) -> list[Match]:
    """Joints base to tip take the drives in the order of their node ids; raises BusFault where they are too few."""
    found = drives.found
    _require(names, found, bus)
    if len(found) > len(names):
        raise BadInput(
            f"{bus}: {len(found)} drives answer ({addresses(found)}), the arm has {len(names)} joints: turn each joint"
            " by hand with --by-hand, or disconnect the other drives"
        )
    return [Match(name, drive, by_hand=False) for name, drive in zip(names, found, strict=True)]


def match_by_hand(
    joints: Sequence[TurnedJoint], drives: FoundDrives, bus: str, ask: Ask
) -> tuple[list[Match], list[SetupFinding]]:
    """Ask for each joint to be turned from stop to stop; the drive that reads the motion is its drive.

    The drives have no power meanwhile. Direction and angle are compared with the model's: another gear is a finding,
    and so is a turned sign of a CANopen drive, where it is set in the drive. Of other families direction and zero
    become keys of the arm file. Raises BusFault where no drive, or more than one, reads the motion.
    """
    _require([joint.name for joint in joints], drives.found, bus)
    free = {each.address: each for each in drives.found}
    matches, findings = [], []
    for joint in joints:
        ask(f"{joint.name}: turn this joint by hand to its lower stop ({joint.lower:+.2f} rad)")
        before = drives.positions()
        ask(f"{joint.name}: now turn it to its upper stop ({joint.upper:+.2f} rad)")
        after = drives.positions()
        turned = {each: after[each] - before[each] for each in free}
        moved = moved_drive(joint.name, turned, bus)
        drive, ratio = free.pop(moved), turned[moved] / (joint.upper - joint.lower)
        if drive.family != "canopen":
            zero = round(float(before[moved] - ratio * joint.lower), 4)
            drive = replace(drive, drive={**(drive.drive or {}), "direction": 1 if ratio > 0 else -1, "zero": zero})
        matches.append(Match(joint.name, drive, by_hand=True))
        findings += _judge(joint, drive, turned[moved])
    return matches, findings


def addresses(found: Sequence[FoundDrive]) -> str:
    return ", ".join(each.address for each in found)


def _require(names: Sequence[str], found: Sequence[FoundDrive], bus: str) -> None:
    if len(found) < len(names):
        raise BusFault(
            f"{bus}: {len(found)} drives answer ({addresses(found) or 'none'}), the arm has {len(names)} joints: check"
            " power, wiring, bit rate and that every id is different"
        )


def moved_drive(joint: str, turned: dict[str, float], bus: str) -> str:
    """Address of the drive that moved; raises BusFault where that is not clear."""
    order = sorted(turned, key=lambda each: -abs(turned[each]))
    if abs(turned[order[0]]) < LEAST_TURN:
        raise BusFault(
            f"{bus}: no drive read the motion of {joint}: release the brake of this joint and turn it "
            "further, or look for its drive on another bus"
        )
    if len(order) > 1 and abs(turned[order[0]]) < LEAST_MOTION_RATIO * abs(turned[order[1]]):
        raise BusFault(
            f"{bus}: {order[0]} and {order[1]} both moved with {joint}: turn one joint at a time and hold the others"
        )
    return order[0]


def _judge(joint: TurnedJoint, drive: FoundDrive, turned: float) -> list[SetupFinding]:
    expected = (joint.upper - joint.lower) * joint.gear
    ratio, where = turned / expected, f"{joint.name} ({drive.address})"
    findings = []
    if ratio < 0 and drive.family == "canopen":
        what = f"its position counts in the wrong direction: from the lower to the upper stop it read {turned:+.2f} rad"
        findings.append(SetupFinding("error", what, where, POLARITY_REMEDY))
    if abs(abs(ratio) - 1) > SCALE_TOLERANCE:
        what = (
            f"from stop to stop it read {abs(turned):.2f} rad, but the model has {expected:.2f} rad (factor "
            f"{abs(ratio):.3g})"
        )
        remedy = f"correct the drive's gear ratio by the factor {abs(ratio):.3g}, or the stops in the arm file"
        if drive.family != "canopen":
            remedy = f"give the drive gear: {abs(ratio) * joint.gear:.3g} in the arm file, or correct the stops there"
        findings.append(SetupFinding("error", what, where, remedy))
    return findings


DEFAULT_VELOCITY = 0.5
"""`max_velocity` where nothing says how fast the joint may be [rad/s]; a choice."""


@dataclass(frozen=True)
class BusArm:
    """An arm file about to be written, and which drive moves which joint."""

    text: str
    matches: list[Match]


def arm_of_bus(drives: FoundDrives, channel: str, bus: Mapping[str, str | int], name: str, ask: Ask | None) -> BusArm:
    """Joints joint_1 … joint_n, one for each drive that answers; `bus` are the keys of link.bus. Raises BusFault.

    With `ask` each joint, base to tip, is turned by hand from stop to stop, without power: its drive is the one that
    reads the motion, and its stops are what that reads [rad]. Else the drives are taken in the order of their ids.
    """
    if not drives.found:
        raise BusFault(f"{channel}: no drive answers: check power, wiring and bit rate")
    if ask is None:
        matches = [Match(f"joint_{i}", drive, by_hand=False) for i, drive in enumerate(drives.found, start=1)]
        stops = [_turn_about(each) for each in _standing(drives)]
    else:
        matches, stops = _by_hand(drives, channel, ask)
    return BusArm(_text(matches, stops, channel, bus, name), matches)


def _standing(drives: FoundDrives) -> list[float]:
    """Where each drive stands [rad]; 0 where one does not tell."""
    try:
        positions = drives.positions()
    except BusFault:
        positions = {}
    return [positions.get(each.address, 0.0) for each in drives.found]


def _turn_about(position: float) -> tuple[float, float]:
    """A turn about zero, or about a position beyond it: that of a drive before a further gear [rad]."""
    middle = 0.0 if abs(position) < pi else position
    return middle - pi, middle + pi


def _by_hand(drives: FoundDrives, channel: str, ask: Ask) -> tuple[list[Match], list[tuple[float, float]]]:
    free = {each.address: each for each in drives.found}
    matches, stops = [], []
    for number in range(1, len(free) + 1):
        joint = f"joint_{number}"
        ask(f"{joint}, counted from the base: turn this joint by hand to one of its stops")
        before = drives.positions()
        ask(f"{joint}: now turn it to its other stop")
        after = drives.positions()
        moved = moved_drive(joint, {each: after[each] - before[each] for each in free}, channel)
        matches.append(Match(joint, free.pop(moved), by_hand=True))
        stops.append((min(before[moved], after[moved]), max(before[moved], after[moved])))
    return matches, stops


def _text(
    matches: list[Match],
    stops: list[tuple[float, float]],
    channel: str,
    bus: Mapping[str, str | int],
    name: str,
) -> str:
    known = matches[0].by_hand
    lines = [
        yaml_comment(f"{name}: made from the drives on {channel} by `armlink new`, without a model."),
        GUESSES,
        yaml_entry("name", name),
        yaml_entry("serial", "unknown", note="assumed"),
        "kinematics:",
        yaml_entry("gravity", list(STANDARD_GRAVITY), 2, "m/s² in the base frame; assumed: the arm stands upright"),
        "  joints:  # a, alpha, d are not known (assumed 0): give them, or make the arm file from the arm's URDF or "
        "MJCF",
    ]
    for match, (lower, upper) in zip(matches, stops, strict=True):
        stop = "stops found by hand" if known else "stops assumed: one full turn"
        row = {"name": match.joint, "a": 0.0, "alpha": 0.0, "d": 0.0}
        lines.append(yaml_item({**row, "lower": round(lower, 4), "upper": round(upper, 4)}, 4, stop))
    lines += ["link:", yaml_entry("bus", dict(bus), 2), yaml_entry("rate", 250, 2, "Hz, assumed"), "  joints:"]
    for match in matches:
        lines += [yaml_item(_joint(match), 4), yaml_comment(f"{match.note}; max_velocity assumed", 6)]
        lines += [yaml_comment(note, 6) for note in drive_notes(match.drive)]
    if not known:
        lines += ["sweep:", yaml_entry("hold", "servo", 2, "assumed: the stops are not known")]
    return "\n".join(lines) + "\n"


def _joint(match: Match) -> dict[str, Any]:
    drive = assumed_ratings(with_gains(match.drive))
    row = {
        "name": match.joint,
        **drive.keys,
        "rated_torque": float(f"{drive.rated_torque:g}"),
        "max_torque": float(f"{drive.max_torque:g}"),
        "max_torque_rate": float(f"{2.5 * drive.max_torque:.3g}"),
        "max_velocity": DEFAULT_VELOCITY,
    }
    return row if drive.family != "canopen" else {**row, "identity": {"vendor": drive.vendor, "product": drive.product}}


def with_gains(drive: FoundDrive, inertia: float = 0.0) -> FoundDrive:
    """The drive with kp and kd, where it takes them: the torque range over one radian, and a tenth of that, or the
    damping that `armlink doctor` asks for at this inertia [kg·m²]; kp is lowered where no kd that it takes suffices."""
    if drive.largest_gains is None or drive.drive is None:
        return drive
    most_kp, most_kd = drive.largest_gains
    kp = min(drive.max_torque, most_kp) if math.isfinite(drive.max_torque) else LEAST_TORQUE
    needed = 2 * LEAST_DAMPING * math.sqrt(kp * inertia)
    kd = min(max(kp / 10, needed), most_kd)
    if kd < needed:
        kp = (kd / (2 * LEAST_DAMPING)) ** 2 / inertia
    gains = {"kp": _rounded(kp, math.floor), "kd": min(_rounded(kd, math.ceil), most_kd)}
    return replace(drive, drive={**drive.drive, **gains})


def _rounded(value: float, to_whole: Callable[[float], int]) -> float:
    """Two digits, in the direction of `to_whole`."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{to_whole(value / step) * step:.2g}")


def assumed_ratings(drive: FoundDrive) -> FoundDrive:
    """The drive with a rated torque, and no larger one allowed, where it tells none: a third of its range, from where
    on `armlink doctor` warns."""
    if math.isfinite(drive.rated_torque):
        return drive
    rated = drive.max_torque / 3 if math.isfinite(drive.max_torque) else LEAST_TORQUE
    return replace(drive, rated_torque=float(f"{rated:.2g}"), max_torque=float(f"{rated:.2g}"))


def drive_notes(drive: FoundDrive, rating: bool = True) -> list[str]:
    """Comments for the arm file; `rating`: its ratings are assumed as well."""
    notes = [drive.note, drive.wrong]
    if drive.largest_gains is not None:
        notes.append("kp, kd assumed: the torque range per radian, with the damping that armlink doctor requires")
    if rating and not math.isfinite(drive.rated_torque):
        notes.append("rated_torque, max_torque assumed: the drive does not report them; take them from its data sheet")
    return [note for note in notes if note]
