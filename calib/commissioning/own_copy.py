"""One's own copy of an arm file whose drives are known by their ids: on a bus, without a simulated arm."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlink.arm_file import ArmFile, Bus, parse_arm, read_yaml
from armlink.bus.can_bus import CanBus
from armlink.content.yaml_text import yaml_comment, yaml_document, yaml_entry
from armlink.drives.family import family
from armlink.drives.findings import SetupFinding
from armlink.errors import BusFault
from armlink.link.link import Link
from calib.commissioning.doctor import another_drive


@dataclass(frozen=True)
class OwnCopy:
    text: str
    drives: list[tuple[str, str, str]]
    """Name, address and serial number of each joint's drive."""
    findings: list[SetupFinding]


def drives_have_ids(arm: ArmFile) -> bool:
    """Whether the drives of an arm are found by the ids of its arm file alone."""
    joints = arm.require_link().joints
    return all(family(joint.settings.family).search is None for joint in joints)


def own_copy(arm: ArmFile, out: Path, bus: dict[str, str | int], opened: CanBus, *, new_serial: bool) -> OwnCopy:
    """The copy, to stand at `out`; each drive is asked who it is. Nothing is written.

    `new_serial`: the arm takes its first drive's serial number. Raises BusFault where a drive does not answer.
    """
    section = arm.require_link()
    link = section.model_copy(update={"bus": Bus.model_validate(bus), "buses": {}})
    there = Link(arm.model_copy(update={"link": link}), opened)
    found = there.scan()
    missing = [f"{there.names[each.joint]} ({each.address})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {opened.channel_info}: check power, wiring and ids")
    wrong = [
        another_drive(each.mismatch, f"{there.names[each.joint]} ({each.address})") for each in found if each.mismatch
    ]
    content: dict[str, Any] = read_yaml(arm.path)
    content = {key: value for key, value in content.items() if key != "sim"}
    content["link"] = {**content["link"], "bus": bus}
    if new_serial:
        content["serial"] = found[0].serial or "FILL-IN"
    if arm.model_path is not None:
        content["kinematics"]["model"] = os.path.relpath(arm.model_path, out.resolve().parent)
    parse_arm(dict(content), out)
    title = f"{arm.name} with the drives on {opened.channel_info}: made from {arm.path.name} by `armlink new`."
    text = yaml_comment(title) + "\n"
    for key, value in content.items():
        if key == "serial" and new_serial:
            text += yaml_entry(key, value, note="assumed: the serial of the first drive") + "\n"
        else:
            text += yaml_document({key: value})
    drives = [(there.names[each.joint], each.address, each.serial) for each in found]
    return OwnCopy(text, drives, wrong)
