"""Which drive on the bus moves which joint, and the drives in the text of an arm file.

Drives are matched by the order of ids, or by turning each joint by hand. An arm file is edited in place: comments,
order and the rest stay. Of the bus alone there are drives, ratings and stops, and no geometry yet.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

from armlink.arm_file import SIMULATED, STANDARD_GRAVITY, ArmFile, Bus, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.content.yaml_text import EditedYaml, yaml_comment, yaml_entry, yaml_item
from armlink.drives.family import family
from armlink.drives.findings import FoundDrive, FoundDrives, SetupFinding
from armlink.errors import BadInput, BusFault
from armlink.link.link import Link
from calib.arm.kinematics import gcomp_arm
from calib.commissioning.doctor import another_drive
from calib.commissioning.draft import GUESSES, LEAST_TORQUE, NO_BUS
from calib.commissioning.model_checks import LEAST_DAMPING, largest_inertias

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


def _turn_by_hand(
    joint: str, questions: tuple[str, str], free: dict[str, FoundDrive], drives: FoundDrives, bus: str, ask: Ask
) -> tuple[FoundDrive, float, float]:
    """The drive that moves between two questions, taken from `free`, and its readings after each [rad].

    The drives have no power meanwhile. Raises BusFault where no drive, or more than one, reads the motion.
    """
    readings = []
    for question in questions:
        ask(f"{joint}{question}")
        readings.append(drives.positions())
    before, after = readings
    moved = moved_drive(joint, {each: after[each] - before[each] for each in free}, bus)
    return free.pop(moved), before[moved], after[moved]


def _judge(joint: str, drive: FoundDrive, gear: float, way: float, turned: float) -> list[SetupFinding]:
    """Findings where a drive reads `turned` [rad] from stop to stop, and the model has the `way` [rad] of the joint."""
    expected = way * gear
    ratio, where = turned / expected, f"{joint} ({drive.address})"
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
            remedy = f"give the drive gear: {abs(ratio) * gear:.3g} in the arm file, or correct the stops there"
        findings.append(SetupFinding("error", what, where, remedy))
    return findings


DEFAULT_VELOCITY = 0.5
"""`max_velocity` where nothing says how fast the joint may be [rad/s]; a choice."""


def arm_of_bus(
    drives: FoundDrives, channel: str, bus: Mapping[str, str | int], name: str, ask: Ask | None
) -> tuple[str, list[Match]]:
    """(Text of an arm file with joints joint_1 … joint_n, one for each drive that answers; which drive moves which).

    `bus` are the keys of link.bus. Raises BusFault.

    With `ask` each joint, base to tip, is turned by hand from stop to stop, without power: its drive is the one that
    reads the motion, and its stops are what that reads [rad]. Else the drives are taken in the order of their ids.
    """
    if not drives.found:
        raise BusFault(f"{channel}: no drive answers: check power, wiring and bit rate")
    if ask is None:
        matches = [Match(f"joint_{i}", drive, by_hand=False) for i, drive in enumerate(drives.found, start=1)]
        stops = _turns(drives)
    else:
        matches, stops = _by_hand(drives, channel, ask)
    return _text(matches, stops, channel, bus, name), matches


def _turns(drives: FoundDrives) -> list[tuple[float, float]]:
    """A turn about zero, or about where a drive stands beyond it, as one before a further gear does [rad].

    A drive that does not tell counts as at zero.
    """
    try:
        positions = drives.positions()
    except BusFault:
        positions = {}
    standing = [positions.get(each.address, 0.0) for each in drives.found]
    middles = [0.0 if abs(position) < math.pi else position for position in standing]
    return [(middle - math.pi, middle + math.pi) for middle in middles]


def _by_hand(drives: FoundDrives, channel: str, ask: Ask) -> tuple[list[Match], list[tuple[float, float]]]:
    free = {each.address: each for each in drives.found}
    matches, stops = [], []
    questions = (
        ", counted from the base: turn this joint by hand to one of its stops",
        ": now turn it to its other stop",
    )
    for number in range(1, len(free) + 1):
        joint = f"joint_{number}"
        drive, *ends = _turn_by_hand(joint, questions, free, drives, channel, ask)
        matches.append(Match(joint, drive, by_hand=True))
        stops.append((min(ends), max(ends)))
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


PLACES = ("node", "id", "reply", "direction", "zero")
"""Keys of a drive that come with the bus; the others are the arm file's own."""
RATING_FACTOR = 2.5
"""A drive whose rated torque differs from the arm file's by more is doubted; a choice."""


def match_drives(
    arm: ArmFile, drives: FoundDrives, bus: str, ask: Ask | None
) -> tuple[list[Match], list[SetupFinding]]:
    """The drive of every joint: by the order of ids or, with `ask`, by turning each joint by hand from stop to stop.

    Direction and angle are then compared with the model's: another gear is a finding, and so is a turned sign of a
    CANopen drive, where it is set in the drive. Of other families direction and zero become keys of the arm file.
    Raises BusFault, BadInput.
    """
    if ask is None:
        return match_in_order(arm.joint_names, drives, bus), []
    _require(arm.joint_names, drives.found, bus)
    known, free = gcomp_arm(arm), {each.address: each for each in drives.found}
    matches, findings = [], []
    for joint, lower, upper in zip(arm.require_link().joints, known.lower, known.upper, strict=True):
        to_lower = f": turn this joint by hand to its lower stop ({lower:+.2f} rad)"
        questions = to_lower, f": now turn it to its upper stop ({upper:+.2f} rad)"
        drive, low, high = _turn_by_hand(joint.name, questions, free, drives, bus, ask)
        if drive.family != "canopen":
            ratio = (high - low) / (upper - lower)
            zero = round(float(low - ratio * lower), 4)
            drive = replace(drive, drive={**(drive.drive or {}), "direction": 1 if ratio > 0 else -1, "zero": zero})
        matches.append(Match(joint.name, drive, by_hand=True))
        gear = 1.0 if joint.settings.family == "canopen" else joint.settings.gear
        findings += _judge(joint.name, drive, gear, upper - lower, high - low)
    return matches, findings


def drives_have_ids(arm: ArmFile) -> bool:
    """Whether the drives of an arm are found by the ids of its arm file alone."""
    return all(family(joint.settings.family).search is None for joint in arm.require_link().joints)


def drive_id(joint: LinkJoint) -> int:
    """Id of a joint's drive on its bus: the key `node` or `id` of its family."""
    keys = joint.settings.model_dump()
    return int(keys.get("node", keys.get("id", 0)))


def match_by_ids(arm: ArmFile, opened: CanBus, bus: Bus) -> tuple[list[Match], list[SetupFinding]]:
    """The drive of every joint by the id in the arm file; each is asked who it is. Raises BusFault if one is silent."""
    section = arm.require_link()
    there = Link(arm.model_copy(update={"link": section.model_copy(update={"bus": bus, "buses": {}})}), opened)
    found = there.scan()
    missing = [f"{there.names[each.joint]} ({each.address})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {opened.channel_info}: check power, wiring and ids")
    matches = []
    for joint, each in zip(section.joints, found, strict=True):
        drive = FoundDrive(joint.settings.family, drive_id(joint), each.address, {})
        matches.append(Match(joint.name, replace(drive, serial=each.serial), by_hand=False))
    wrong = [
        another_drive(each.mismatch, f"{there.names[each.joint]} ({each.address})") for each in found if each.mismatch
    ]
    return matches, wrong


def wired_text(
    text: str, arm: ArmFile, matches: Sequence[Match], out: Path, bus: dict[str, Any] | None, serial: str = ""
) -> tuple[str, list[SetupFinding]]:
    """Text of an arm file, to stand at `out`, with these drives; findings where their torques differ much from its own.

    Of each joint it changes the drive, torques and identity; `bus` and `serial`, if given, replace those of the file.
    Raises BadInput.
    """
    edited = EditedYaml(text)
    link: Any = edited.content["link"]
    new = [match.drive.largest_gains for row, match in zip(link["joints"], matches, strict=True) if "drive" not in row]
    inertias = largest_inertias(arm) if any(new) else {}
    findings, notes = [], []
    for row, match, known in zip(link["joints"], matches, _row_comments(text), strict=True):
        drive = with_gains(match.drive, inertias.get(match.joint, 0.0))
        if drive.drive == {}:  # found where the file has it
            notes.append(known)
            continue
        notes.append([each for each in known if not each.startswith("node ")])
        if _place(edited, row, drive, arm):
            notes[-1] += drive_notes(drive, rating=False)
        findings += _rate(row, match, notes[-1])
        if drive.family == "canopen":
            row["identity"] = edited.in_line({"vendor": drive.vendor, "product": drive.product})
        notes[-1].append(match.note)
    if bus is not None:
        link["bus"] = edited.in_line(bus)
    if serial:
        edited.content["serial"] = edited.scalar(serial)
        edited.content.yaml_add_eol_comment("assumed: the serial of the first drive", "serial")
    if arm.model_path is not None:
        model = os.path.relpath(arm.model_path, out.resolve().parent)
        edited.content["kinematics"]["model"] = edited.scalar(model)
    return _annotated(edited.text, notes, "" if bus is None else NO_BUS), findings


def _place(edited: EditedYaml, row: Any, drive: FoundDrive, arm: ArmFile) -> bool:
    """Write which drive a joint has; returns whether the file knew no more of it than a node. Raises BadInput."""
    kind = row["drive"]["family"] if "drive" in row else "canopen"
    unwired = "drive" not in row and arm.require_link().bus.interface == SIMULATED
    if drive.family != kind and not unwired:
        what = f"{row['name']} has a drive of family {kind}, {drive.address} is one of family {drive.family}"
        raise BadInput(f"{arm.path}: {what}: disconnect the others, or correct link.joints")
    if "drive" in row:
        keys = {"node": drive.node} if kind == "canopen" else drive.drive or {}
        row["drive"].update({key: value for key, value in keys.items() if key in PLACES})
        return False
    place = list(row).index("node")
    del row["node"]
    for key, value in drive.keys.items():
        row.insert(place, key, edited.in_line(value) if key == "drive" else value)
    return True


def _rate(row: Any, match: Match, notes: list[str]) -> list[SetupFinding]:
    """Write the torques that a drive tells: its rating, or as the most that a rating can be the end of its torque
    field; in its `notes` what the file said of a rating that changes is taken back."""
    drive, before, most = match.drive, float(row["rated_torque"]), float(row["max_torque"])
    rated = drive.rated_torque if math.isfinite(drive.rated_torque) else min(before, drive.max_torque)
    if not math.isfinite(drive.max_torque):
        return []
    of_load = any(each.startswith("rated_torque assumed: ") for each in notes)
    told = math.isfinite(drive.rated_torque)
    if told or rated < before:
        notes[:] = [each for each in notes if not each.startswith("rated_torque")]
    row["rated_torque"] = rated
    row["max_torque"] = drive.max_torque if told and of_load else min(most, drive.max_torque)
    if row["max_torque"] != most and "max_torque_rate" in row:
        row["max_torque_rate"] = float(f"{row['max_torque_rate'] * row['max_torque'] / most:.3g}")
    if told:
        what, doubtful = f"is rated {rated:g} N·m", not of_load and max(rated / before, before / rated) > RATING_FACTOR
    else:
        what, doubtful = f"has a torque field that ends at {rated:g} N·m", rated < before
        notes += ["rated_torque assumed: the end of the drive's torque field"] * doubtful
    by_hand = "" if match.by_hand else " (--by-hand finds the drive of each joint)"
    what = f"the drive {what}, but by the model the joint needs a rated torque of {before:g} N·m"
    where, remedy = f"{match.joint} ({drive.address})", f"check that this drive moves this joint{by_hand}"
    return [SetupFinding("warning", what, where, remedy)] if doubtful else []


def _row_comments(text: str) -> list[list[str]]:
    """The comments between each joint's row of `link.joints` and the next line that is none."""
    lines = text.splitlines()
    comments = []
    for row in EditedYaml(text).content["link"]["joints"]:
        below = takewhile(lambda line: line.lstrip().startswith("#"), lines[row.lc.line + 1 :])
        comments.append([line.strip().removeprefix("#").strip() for line in below])
    return comments


def _annotated(text: str, notes: Sequence[Sequence[str]], outdated: str) -> str:
    """The text with these comments below the joints' rows, in place of those there, and without a comment that is
    `outdated`."""
    lines = text.splitlines(keepends=True)
    rows = EditedYaml(text).content["link"]["joints"]
    for row, known, new in reversed(list(zip(rows, _row_comments(text), notes, strict=True))):
        start = row.lc.line + 1
        lines[start : start + len(known)] = [f"{yaml_comment(note, row.lc.col + 2)}\n" for note in new]
    return "".join(line for line in lines if not (outdated and line.lstrip().startswith(f"# {outdated}")))
