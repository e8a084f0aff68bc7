"""`armlink check --scales`: are position, velocity and torque of the drives scaled as they are decoded?"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from rich.console import Console

    from armlink.arm_file import ArmFile
    from armlink.selftest.scale_motion import JointScales

SCHEMA = "armlink.check-scales/1"
How = Literal["hand", "move", "listen"]


def check_scales(
    console: "Console", arm: "ArmFile", bus: str | None, how: How, seconds: float, json: Path | None
) -> int:
    """Judge the scales, print and write what was found; raises Refused where one is off."""
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.errors import Refused

    with early_end(arm) as work:
        work.enabled = how == "move"
        found, channel = _judge(console, arm, bus, how, seconds)
    out = results(json)
    for each in found:
        judged = ", ".join(each.judged) or "nothing: it hardly moved"
        out.print(f"{each.joint}: judged: {judged}")
        for finding in each.findings:
            out.print(f"{each.joint}: {finding.text}", style="red")
    write_json(
        json, {"schema": SCHEMA, "arm": arm.name, "bus": channel, "how": how, "joints": [_json(e) for e in found]}
    )
    wrong = [(each.joint, finding.text) for each in found for finding in each.findings]
    if wrong:
        raise Refused(f"check --scales: {wrong[0][0]}: {wrong[0][1]}")
    if not any(each.evidence for each in found):
        raise Refused("check --scales: no joint moved enough to judge a scale: move every joint by a third of a radian")
    out.print("every scale that could be judged is right")
    return 0


def _judge(
    console: "Console", arm: "ArmFile", bus: str | None, how: How, seconds: float
) -> "tuple[list[JointScales], str]":
    from armlink.bus.open import open_link_bus
    from armlink.link.listener import Listener
    from armlink.loop.open import open_arm
    from armlink.selftest.scale_motion import by_hand, by_listening, by_moving

    with console.status("scales") as status:
        if how == "listen":
            with Listener(arm, open_link_bus(bus, arm.require_link())) as listener:
                return by_listening(listener, status.update, seconds), str(listener.bus.channel_info)
        with open_arm(arm, bus) as link:
            if how == "hand":
                return link.inside(by_hand, status.update, seconds), arm.name
            return link.inside(by_moving, status.update), arm.name


def _json(each: "JointScales") -> dict[str, Any]:
    return {
        "joint": each.joint,
        "judged": list(each.judged),
        "evidence": [{"what": one.text, "ratio": one.ratio if one.ratio > 0 else None} for one in each.evidence],
        "findings": [
            {
                "scale": list(one.quantities),
                "reads": None if one.factor != one.factor else 1 / one.factor,
                "text": one.text,
            }
            for one in each.findings
        ],
    }
