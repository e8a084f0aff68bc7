"""The drives of a bus in the text of an arm file, which is edited in place: comments, order and the rest stay."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

from armlink.arm_file import SIMULATED, ArmFile, Bus, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.content.yaml_text import EditedYaml, yaml_comment
from armlink.drives.family import family
from armlink.drives.findings import FoundDrive, FoundDrives, SetupFinding
from armlink.errors import BadInput, BusFault
from armlink.link.link import Link
from calib.arm.kinematics import gcomp_arm
from calib.commissioning.doctor import another_drive
from calib.commissioning.draft import NO_BUS
from calib.commissioning.drive_match import (
    Ask,
    Match,
    TurnedJoint,
    drive_notes,
    match_by_hand,
    match_in_order,
    with_gains,
)
from calib.commissioning.model_checks import largest_inertias

PLACES = ("node", "id", "reply", "direction", "zero")
"""Keys of a drive that come with the bus; the others are the arm file's own."""
RATING_FACTOR = 2.5
"""A drive whose rated torque differs from the arm file's by more is doubted; a choice."""


def match_drives(
    arm: ArmFile, drives: FoundDrives, bus: str, ask: Ask | None
) -> tuple[list[Match], list[SetupFinding]]:
    """The drive of every joint: with `ask` each joint is turned by hand, else the order of ids counts.

    Raises BusFault, BadInput.
    """
    if ask is None:
        return match_in_order(arm.joint_names, drives, bus), []
    known = gcomp_arm(arm)
    settings = [joint.settings for joint in arm.require_link().joints]
    gears = [1.0 if each.family == "canopen" else each.gear for each in settings]
    turned = [TurnedJoint(*each) for each in zip(known.names, known.lower, known.upper, gears, strict=True)]
    return match_by_hand(turned, drives, bus, ask)


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
