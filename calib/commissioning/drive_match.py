"""Which drive on the bus moves which joint: by the order of node ids, or by turning each joint by hand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from armlink.drives.findings import FoundDrive, FoundDrives, SetupFinding
from armlink.drives.registry import not_looked_for
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
        ids = ", ".join(str(each.node) for each in found)
        raise BadInput(
            f"{bus}: {len(found)} drives answer (nodes {ids}), but the arm has {len(names)} joints: turn "
            "each joint by hand with `--by-hand`, or disconnect the other drives"
        )
    return [Match(name, drive, by_hand=False) for name, drive in zip(names, found, strict=True)]


def match_by_hand(
    joints: Sequence[TurnedJoint], drives: FoundDrives, bus: str, ask: Ask
) -> tuple[list[Match], list[SetupFinding]]:
    """Ask for each joint to be turned from stop to stop; the drive that reads the motion is its drive.

    The drives have no power meanwhile. Direction and angle are compared with the model's: a turned sign and another
    gear are findings. Raises BusFault where no drive, or more than one, reads the motion.
    """
    _require([joint.name for joint in joints], drives.found, bus)
    free = {each.node: each for each in drives.found}
    matches, findings = [], []
    for joint in joints:
        ask(f"{joint.name}: turn this joint by hand to its lower stop ({joint.lower:+.2f} rad)")
        before = drives.positions()
        ask(f"{joint.name}: now turn it to its upper stop ({joint.upper:+.2f} rad)")
        after = drives.positions()
        turned = {node: after[node] - before[node] for node in free}
        node = moved_node(joint.name, turned, bus)
        matches.append(Match(joint.name, free.pop(node), by_hand=True))
        findings += _judge(joint, node, turned[node])
    return matches, findings


def _require(names: Sequence[str], found: Sequence[FoundDrive], bus: str) -> None:
    if len(found) < len(names):
        ids = ", ".join(str(each.node) for each in found) or "none"
        raise BusFault(
            f"{bus}: {len(found)} drives answer (nodes {ids}), but the arm has {len(names)} joints: check "
            f"power, wiring, bit rate, and that every drive has its own node id ({not_looked_for()})"
        )


def moved_node(joint: str, turned: dict[int, float], bus: str) -> int:
    """The node that moved; raises BusFault where that is not clear."""
    order = sorted(turned, key=lambda node: -abs(turned[node]))
    if abs(turned[order[0]]) < LEAST_TURN:
        raise BusFault(
            f"{bus}: no drive read the motion of {joint}: release the brake of this joint and turn it "
            "further, or look for its drive on another bus"
        )
    if len(order) > 1 and abs(turned[order[0]]) < LEAST_MOTION_RATIO * abs(turned[order[1]]):
        raise BusFault(
            f"{bus}: nodes {order[0]} and {order[1]} both moved with {joint}: turn one joint at a time and hold the"
            " others"
        )
    return order[0]


def _judge(joint: TurnedJoint, node: int, turned: float) -> list[SetupFinding]:
    expected = joint.upper - joint.lower
    ratio, where = turned / expected, f"{joint.name} (node {node})"
    findings = []
    if ratio < 0:
        what = f"its position counts in the wrong direction: from the lower to the upper stop it read {turned:+.2f} rad"
        findings.append(SetupFinding("error", what, where, POLARITY_REMEDY))
    if abs(abs(ratio) - 1) > SCALE_TOLERANCE:
        what = (
            f"from stop to stop it read {abs(turned):.2f} rad, but the model has {expected:.2f} rad (factor "
            f"{abs(ratio):.3g})"
        )
        remedy = f"correct the drive's gear ratio by the factor {abs(ratio):.3g}, or the stops in the arm file"
        findings.append(SetupFinding("error", what, where, remedy))
    return findings
