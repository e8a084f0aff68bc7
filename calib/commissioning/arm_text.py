"""Text of an arm file, with a comment for every value that was assumed."""

import os
from pathlib import Path
from typing import Any

from armlink.arm_file import SIMULATED
from armlink.content.yaml_text import yaml_comment, yaml_entry, yaml_item
from calib.commissioning.draft import FRICTION, Draft, JointDraft

NO_BUS = "assumed: there is no bus yet"


def assumed_lines(text: str) -> list[int]:
    """Numbers of the lines of an arm file whose comment says that a value is assumed."""
    return [place for place, line in enumerate(text.splitlines(), start=1) if "assumed" in line.partition("#")[2]]


def arm_text(draft: Draft, out: Path) -> str:
    """The YAML text of the draft, to stand at `out`: the model's path is relative to it."""
    lines = [
        yaml_comment(f"{draft.name}: made from {draft.model.name} by `armlink new`."),
        yaml_comment(
            "Comments mark guessed values: check each value before a real arm moves, then remove its comment."
        ),
        yaml_entry("name", draft.name),
        yaml_entry("serial", draft.serial),
        "kinematics:",
        yaml_entry("model", os.path.relpath(draft.model.resolve(), out.resolve().parent), 2),
    ]
    if draft.base is not None:
        lines.append(yaml_entry("base", draft.base, 2))
    if draft.tip is not None:
        lines.append(yaml_entry("tip", draft.tip, 2))
    if draft.locked:
        lines.append("  locked:  # joints that these drives do not move [rad, m]")
        lines += [yaml_entry(name, position, 4) for name, position in draft.locked.items()]
    lines.append(
        yaml_entry(
            "gravity", list(draft.gravity), 2, "m/s² in the model's frame; assumed: the arm stands as in the model"
        )
    )
    lines += [
        yaml_comment(f"joint {name} {why}: not part of the arm, it stays at its position in the model", 2)
        for name, why in draft.aside
        if name not in draft.locked
    ]
    given = {joint.name: list(joint.stops) for joint in draft.joints if joint.stops is not None}
    if given:
        lines.append(f"  stops:  # {'working range' if draft.servo else 'mechanical stops'} [rad]")
        lines += [yaml_entry(name, stops, 4) for name, stops in given.items()]
    simulated = {"interface": SIMULATED, "channel": out.name, "bitrate": 1000000}
    real = "{interface: socketcan, channel: can0}"
    note = f"{NO_BUS}, this is the simulated arm; for a real arm write {real}"
    lines += ["link:", yaml_entry("bus", simulated, 2), yaml_comment(note, 2)]
    lines += [yaml_entry("rate", 250, 2, "Hz, assumed"), "  joints:"]
    for joint in draft.joints:
        lines += [yaml_item(_joint(joint), 4), *(yaml_comment(note, 6) for note in joint.notes)]
    if draft.servo is not None:
        lines += ["sweep:", yaml_entry("hold", "servo", 2), yaml_comment(f"assumed: {draft.servo}", 2)]
    lines += [
        "sim:  # the simulated arm, for example for `armlink demo`; its masses are the masses of the model",
        f"  effects:  # assumed: friction of {FRICTION:.0%} of the torque that the drives need, and rotor inertias",
    ]
    effects = [("friction.coulomb", joint.name, "torque", joint.friction) for joint in draft.joints]
    effects += [("actuator.rotor_inertia", joint.name, "inertia", joint.rotor) for joint in draft.joints if joint.rotor]
    lines += [yaml_item({"effect": effect, "joint": joint, key: value}, 4) for effect, joint, key, value in effects]
    lines += [yaml_comment(note) for note in draft.notes]
    return "\n".join(lines) + "\n"


def _joint(joint: JointDraft) -> dict[str, Any]:
    return {
        "name": joint.name,
        "node": joint.node,
        "rated_torque": joint.rated_torque,
        "max_torque": joint.max_torque,
        "max_torque_rate": joint.max_torque_rate,
        "max_velocity": joint.max_velocity,
    }
