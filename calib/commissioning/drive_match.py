"""Which drive on the bus moves which joint: by the order of ids, or by turning each joint by hand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from armlink.drives.findings import FoundDrive, FoundDrives, SetupFinding
from armlink.errors import BadInput, BusFault

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
    """A joint as the model has it."""

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


def match_in_order(names: Sequence[str], drives: FoundDrives, bus: str) -> list[Match]:
    """Joints base to tip take the drives in the order of their node ids; raises BusFault where they are too few."""
    found = drives.found
    _require(names, found, bus)
    if len(found) > len(names):
        raise BadInput(
            f"{bus}: {len(found)} drives answer ({addresses(found)}), the arm has {len(names)} joints: turn each joint"
            " by hand with --by-hand, or disconnect the others"
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
