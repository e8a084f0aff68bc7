"""The arm file of an arm of which only the bus is known: drives, ratings and stops, and no geometry yet."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

from armlink.drives.found import FoundDrives
from armlink.errors import BusFault
from calib.commissioning.drive_match import Ask, Match, moved_node

SLOW = 0.5
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
        stops = [(-pi, pi)] * len(matches)
    else:
        matches, stops = _by_hand(drives, channel, ask)
    return BusArm(_text(matches, stops, channel, bus, name), matches)


def _by_hand(drives: FoundDrives, channel: str, ask: Ask) -> tuple[list[Match], list[tuple[float, float]]]:
    free = {each.node: each for each in drives.found}
    matches, stops = [], []
    for number in range(1, len(free) + 1):
        joint = f"joint_{number}"
        ask(f"{joint}, counted from the base: turn it by hand to one stop")
        before = drives.positions()
        ask(f"{joint}: now to its other stop")
        after = drives.positions()
        node = moved_node(joint, {each: after[each] - before[each] for each in free}, channel)
        matches.append(Match(joint, free.pop(node), by_hand=True))
        stops.append((min(before[node], after[node]), max(before[node], after[node])))
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
        f"# {name}: the drives on {channel}, by the command new, without a model.",
        "# Comments mark what was guessed: check it before a real arm moves, then remove the comment.",
        f"name: {json.dumps(name)}",
        "serial: unknown  # assumed",
        "kinematics:",
        "  gravity: [0.0, 0.0, -9.80665]  # m/s² in the base frame, assumed: the arm stands upright",
        "  joints:  # a, alpha, d assumed: unknown; give them, or make the file of the arm's URDF or MJCF",
    ]
    for match, (lower, upper) in zip(matches, stops, strict=True):
        stop = "stops found by hand" if known else "stops assumed: a full turn"
        row = f"name: {match.joint}, a: 0.0, alpha: 0.0, d: 0.0, lower: {lower:.4f}, upper: {upper:.4f}"
        lines.append(f"    - {{{row}}}  # {stop}")
    lines += [
        "link:",
        "  bus: {" + ", ".join(f"{key}: {json.dumps(value)}" for key, value in bus.items()) + "}",
        "  rate: 250  # Hz, assumed",
        "  joints:",
    ]
    for match in matches:
        drive, place = match.drive, "by turning the joint by hand" if known else "assumed: in the order of node ids"
        row = f"name: {match.joint}, node: {drive.node}, rated_torque: {drive.rated_torque:g}"
        row += f", max_torque: {drive.max_torque:g}, max_torque_rate: {2.5 * drive.max_torque:.3g}"
        row += f", max_velocity: {SLOW}, identity: {{vendor: {drive.vendor}, product: {drive.product}}}"
        lines += [f"    - {{{row}}}", f"      # node {place}; max_velocity assumed"]
    if not known:
        lines += ["sweep:", "  hold: servo  # assumed: the stops are not known"]
    return "\n".join(lines) + "\n"
