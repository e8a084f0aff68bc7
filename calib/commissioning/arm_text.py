"""Text of an arm file, with a comment for every value that was assumed."""

import json
import os
from pathlib import Path

from calib.commissioning.draft import FRICTION, Draft, JointDraft


def arm_text(draft: Draft, out: Path) -> str:
    """The YAML text of the draft, to stand at `out`: the model's path is relative to it."""
    lines = [
        f"# {draft.name}, from {draft.model.name}, by the command new.",
        "# Comments mark what was guessed: check it before a real arm moves, then remove the comment.",
        f"name: {_scalar(draft.name)}",
        f"serial: {_scalar(draft.serial)}",
        "kinematics:",
        f"  model: {_scalar(os.path.relpath(draft.model.resolve(), out.resolve().parent))}",
    ]
    if draft.base is not None:
        lines.append(f"  base: {_scalar(draft.base)}")
    if draft.tip is not None:
        lines.append(f"  tip: {_scalar(draft.tip)}")
    lines.append(f"  gravity: {json.dumps(list(draft.gravity))}  # m/s² in the model's frame")
    lines += [f"  # {name} {why}: set aside, it keeps the model's position" for name, why in draft.aside]
    given = [joint for joint in draft.joints if joint.stops is not None]
    if given:
        meaning = "working range" if draft.servo else "mechanical stops"
        lines.append(f"  stops:  # {meaning} [rad]")
        lines += [f"    {_scalar(joint.name)}: {json.dumps(joint.stops)}" for joint in given]
    lines += ["link:", *_bus(draft, out), "  rate: 250  # Hz, assumed", "  joints:"]
    for joint in draft.joints:
        lines += [f"    - {_joint(joint)}", *(f"      # {note}" for note in joint.notes)]
    if draft.servo is not None:
        lines += ["sweep:", "  hold: servo", f"  # assumed: {draft.servo}"]
    lines += [
        "sim:  # the simulated arm, for the command demo: masses are the model's",
        f"  effects:  # assumed: friction of {FRICTION:.0%} of rated torque",
    ]
    lines += [
        f"    - {{effect: friction.coulomb, joint: {_scalar(joint.name)}, torque: {FRICTION * joint.rated_torque:.4g}}}"
        for joint in draft.joints
    ]
    lines += [f"# {note}" for note in draft.notes]
    return "\n".join(lines) + "\n"


def _bus(draft: Draft, out: Path) -> list[str]:
    if draft.bus is None:
        bus = f"  bus: {{interface: armlink_sim, channel: {_scalar(out.name)}, bitrate: 1000000}}"
        real = "{interface: socketcan, channel: can0}"
        return [bus, f"  # assumed: no bus yet, this is the simulated arm; a real one: {real}"]
    return ["  bus: {" + ", ".join(f"{key}: {_scalar(value)}" for key, value in draft.bus.items()) + "}"]


def _joint(joint: JointDraft) -> str:
    known = "" if joint.identity is None else f", identity: {json.dumps(joint.identity).replace(chr(34), '')}"
    return (
        f"{{name: {_scalar(joint.name)}, node: {joint.node}, rated_torque: {joint.rated_torque}, "
        f"max_torque: {joint.max_torque}, max_torque_rate: {joint.max_torque_rate}, "
        f"max_velocity: {joint.max_velocity}{known}}}"
    )


def _scalar(value: str | int) -> str:
    """A YAML scalar; text in quotes where YAML could read it as something else."""
    import yaml

    if isinstance(value, int):
        return str(value)
    plain = value.replace("_", "").replace("-", "").replace(".", "").replace("/", "")
    if plain.isalnum() and yaml.safe_load(value) == value:
        return value
    return json.dumps(value, ensure_ascii=False)
