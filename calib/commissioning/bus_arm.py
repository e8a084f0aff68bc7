"""The arm file of an arm of which only the bus is known: drives, ratings and stops, and no geometry yet."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Any

from armlink.arm_file import STANDARD_GRAVITY
from armlink.content.yaml_text import yaml_comment, yaml_entry, yaml_item
from armlink.drives.findings import FoundDrives
from armlink.drives.registry import not_looked_for
from armlink.errors import BusFault
from calib.commissioning.drive_match import Ask, Match, moved_node

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
        raise BusFault(f"{channel}: no drive answers: check power, wiring and bit rate ({not_looked_for()})")
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
        ask(f"{joint}, counted from the base: turn this joint by hand to one of its stops")
        before = drives.positions()
        ask(f"{joint}: now turn it to its other stop")
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
        yaml_comment(f"{name}: made from the drives on {channel} by `armlink new`, without a model."),
        yaml_comment(
            "Comments mark guessed values: check each value before a real arm moves, then remove its comment."
        ),
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
        place = "found by turning the joint by hand" if known else "assumed: taken in the order of the node ids"
        lines += [yaml_item(_joint(match), 4), yaml_comment(f"node {place}; max_velocity assumed", 6)]
    if not known:
        lines += ["sweep:", yaml_entry("hold", "servo", 2, "assumed: the stops are not known")]
    return "\n".join(lines) + "\n"


def _joint(match: Match) -> dict[str, Any]:
    drive = match.drive
    return {
        "name": match.joint,
        **drive.keys,
        "rated_torque": float(f"{drive.rated_torque:g}"),
        "max_torque": float(f"{drive.max_torque:g}"),
        "max_torque_rate": float(f"{2.5 * drive.max_torque:.3g}"),
        "max_velocity": DEFAULT_VELOCITY,
        "identity": {"vendor": drive.vendor, "product": drive.product},
    }
