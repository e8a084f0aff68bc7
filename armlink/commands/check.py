"""Tests an arm's controllers: what they are, hold, and do when their host falls silent."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, Json, OtherBus
from armlink.commands.output import write_json
from armlink.errors import BadInput, BusFault, Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from armlink.arm_file import ArmFile
    from armlink.drives.findings import Result
    from armlink.selftest.scale_motion import JointScales

SCHEMA = "armlink.check/1"
HOST_SCHEMA = "armlink.check-host/1"
SCALES_SCHEMA = "armlink.check-scales/1"
NOT_MADE = "not made"


def check(
    arm: Arm,
    bus: OtherBus = None,
    yes: Annotated[bool, typer.Option("--yes", help="Enable the joints without asking first.")] = False,
    passive: Annotated[
        bool,
        typer.Option(
            "--passive", help="Do only the checks that need no power; these checks read and configure the drives."
        ),
    ] = False,
    host: Annotated[
        bool, typer.Option("--host", help="Only measure how well this machine keeps the cycle; no bus is needed.")
    ] = False,
    scales: Annotated[
        str | None,
        typer.Option(
            help="Check only the scales of position, velocity and torque: hand (you turn every joint from "
            "stop to stop, without power), move (this program moves all joints by 0.35 rad) or listen "
            "(another host moves the arm)."
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Duration of --host, --scales hand and --scales listen [s].")
    ] = 20.0,
    json: Json = None,
) -> int:
    """Check identity, set-up and calibration of the drives; then, with power, what they do without their host.

    The command tests whether each drive stops by itself when its host falls silent, and how long that takes. It first
    says what it will do to the joints and asks, except with --yes or on a simulated arm in this process. At the end the
    joints hold, in quick stop, or the arm is parked or lowered. Exit status 1 if a check fails.

    With --host nothing is sent: this machine makes cycles at the rate of the arm while another process computes. Exit
    status 1 if the machine is too slow for the deadline or the rate of the arm.

    With --scales the readings are judged while the arm moves. Exit status 1 if a scale is wrong by 10 % or more.

    Example: armlink check sarcos --bus socketcan:vcan0 --yes --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end, joints_left
    from armlink.commands.plain_console import PlainConsole, command_line, confirm, results, suggest
    from armlink.link.link import Link
    from armlink.loop.open import open_arm
    from armlink.selftest.self_test import announcement, self_test

    console = PlainConsole()
    described = load_arm(arm)
    if host:
        return _check_host(console, described, seconds, json)
    if scales is not None:
        return _check_scales(console, described, bus, scales, seconds, yes, json)
    with early_end(described) as work, open_arm(described, bus) as link:
        simulated = isinstance(link, Link) and link.bus.clock is not None
        if not (passive or yes or simulated):
            console.print(announcement(described))
            if not console.is_terminal:
                raise BadInput(
                    "check: there is no terminal to ask for confirmation: give `--yes`, or `--passive` for the "
                    "checks without power"
                )
            confirm("Go on?")
        work.enabled = not passive
        with console.status("check") as status:
            found, channel = link.inside(self_test, status.update, not passive)
    out = results(json)
    out.print(_table(f"{described.name} on {channel}", link.names, found))
    for each in found:
        if each.outcome in ("failed", "absent"):
            out.print(f"{each.joint}: {each.check}: {each.found}")
    failed = [each for each in found if each.outcome == "failed"]
    write_json(json, _answer(described.name, described.serial, channel, found))
    if any(each.check == "answers" for each in failed):
        silent = ", ".join(each.joint for each in failed if each.check == "answers")
        raise BusFault(f"no answer from {silent} on {channel}: check power, wiring and ids")
    if failed:
        first = failed[0]
        raise Refused(
            f"check: {len(failed)} of {len(found)} checks failed, the first is {first.joint}: {first.check}: "
            f"{first.found}"
        )
    passed = sum(each.outcome == "passed" for each in found)
    left = "checks that enable the joints were not made" if passive else joints_left(described)
    out.print(f"all {passed} checks passed (a row of the table may stand for several checks of each joint); {left}")
    step = ["check", arm] if passive else ["sweep", arm, "--plan"] if described.has_geometry else ["doctor", arm]
    suggest(command_line(*step, bus=bus))
    return 0


def _check_scales(
    console: "Console", arm: "ArmFile", bus: str | None, how: str, seconds: float, yes: bool, json: Path | None
) -> int:
    """Judge the scales of readings; asks before this host moves the arm. Raises Refused where one is off."""
    from armlink.commands.early_end import early_end
    from armlink.commands.plain_console import confirm, results
    from armlink.loop.open import is_in_process

    if how not in ("hand", "move", "listen"):
        raise BadInput(f"check --scales {how}: expected hand, move or listen")
    if how == "move" and not yes and not is_in_process(arm, bus):
        if not console.is_terminal:
            raise BadInput(
                "check --scales move: there is no terminal to ask for confirmation: give `--yes`, or use "
                "`--scales hand`"
            )
        confirm(f"All joints of {arm.name} will turn by 0.35 rad to both sides. Is their space clear?")
    with early_end(arm) as work:
        work.enabled = how == "move"
        found, channel = _judge_scales(console, arm, bus, how, seconds)
    out = results(json)
    for each in found:
        out.print(f"{each.joint}: judged: {', '.join(each.judged) or 'nothing: it hardly moved'}")
        for finding in each.findings:
            out.print(f"{each.joint}: {finding.text}", style="red")
    joints = [_scales_answer(each) for each in found]
    write_json(json, {"schema": SCALES_SCHEMA, "arm": arm.name, "bus": channel, "how": how, "joints": joints})
    wrong = [(each.joint, finding.text) for each in found for finding in each.findings]
    if wrong:
        raise Refused(f"check --scales: {wrong[0][0]}: {wrong[0][1]}")
    if not any(each.evidence for each in found):
        raise Refused(
            "check --scales: no joint moved enough to judge its scales: move every joint by at least a third of "
            "a radian"
        )
    out.print("every scale that could be judged is right")
    return 0


def _judge_scales(
    console: "Console", arm: "ArmFile", bus: str | None, how: str, seconds: float
) -> "tuple[list[JointScales], str]":
    from armlink.bus.open import open_link_bus
    from armlink.link.listener import Listener
    from armlink.loop.open import open_arm
    from armlink.selftest.scale_motion import judge_by_hand, judge_by_listening, judge_by_motion

    with console.status("scales") as status:
        if how == "listen":
            with Listener(arm, open_link_bus(bus, arm.require_link())) as listener:
                return judge_by_listening(listener, status.update, seconds), str(listener.bus.channel_info)
        with open_arm(arm, bus) as link:
            if how == "hand":
                return link.inside(judge_by_hand, status.update, seconds), arm.name
            return link.inside(judge_by_motion, status.update), arm.name


def _scales_answer(each: "JointScales") -> dict[str, Any]:
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


def _check_host(console: "Console", arm: "ArmFile", seconds: float, json: Path | None) -> int:
    """Lateness of this machine's cycle at the arm's rate, and the rate that it holds."""
    from armlink.commands.plain_console import results
    from armlink.link.lateness import WARN_SHARE
    from armlink.selftest.host import measure_host

    with console.status(
        f"{arm.name}: making cycles at {arm.require_link().rate:g} Hz for {seconds:g} s, while another process computes"
    ):
        report = measure_host(arm, seconds)
    late, section = report.lateness.in_ms(), arm.require_link()
    answer = {
        "schema": HOST_SCHEMA,
        "arm": arm.name,
        "rate_hz": report.rate,
        "seconds": seconds,
        "late_ms": late,
        "holds_hz": report.holds_hz,
        "realtime": str(report.realtime),
    }
    write_json(json, answer)
    out = results(json)
    out.print(
        f"cycles began late by {late['p50']:.2f} ms (median), {late['p99']:.2f} (99 %), {late['p99_9']:.2f} (99.9 %), "
        f"{late['max']:.2f} (longest); each cycle took {report.busy * 1e3:.2f} ms of CPU time; {report.realtime}",
    )
    out.print(f"this machine can keep {report.holds_hz:g} Hz; the arm file asks for {section.rate:g} Hz")
    limit = WARN_SHARE * section.deadline * 1e3
    if late["p99_9"] > limit:
        raise Refused(
            f"check --host: 99.9 % of the cycles begin at most {late['p99_9']:.1f} ms late, but the limit is {limit:g} "
            "ms (half of link.deadline): lower link.rate, raise link.deadline, or stop other programs on this machine"
        )
    if report.holds_hz < section.rate:
        raise Refused(
            f"check --host: this machine can only keep {report.holds_hz:g} Hz: lower link.rate (now {section.rate:g})"
        )
    return 0


def _answer(arm: str, serial: str, bus: str, results: "list[Result]") -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "arm": arm,
        "serial": serial,
        "bus": bus,
        "passed": all(each.outcome != "failed" for each in results),
        "checks": [vars(each) for each in results],
        "does_not": [f"{each.joint}: {each.found}" for each in results if each.outcome in ("absent", "failed")],
    }


def _table(title: str, names: tuple[str, ...], results: "list[Result]") -> "Table":
    """A row for each group of checks: what came of it, with names where joints differ; times where any were taken."""
    from rich.box import SIMPLE
    from rich.table import Table

    groups: dict[str, dict[str, list[Result]]] = {}
    for each in results:
        groups.setdefault(each.check.partition(":")[0], {}).setdefault(each.joint, []).append(each)
    table = Table("check", "every joint" if len(names) > 1 else names[0], box=SIMPLE, title=title)
    for group, joints in groups.items():
        table.add_row(group, _outcomes({name: joints.get(name, []) for name in names}))
    return table


def _outcomes(joints: "dict[str, list[Result]]") -> "Text":
    from rich.text import Text

    found = {name: _outcome(results) for name, results in joints.items()}
    times = [each for each in found.values() if isinstance(each, float)]
    if len(times) == len(found):
        least, most = f"{min(times) * 1e3:.0f}", f"{max(times) * 1e3:.0f}"
        return Text(f"{least} ms" if least == most else f"{least} to {most} ms", "green")
    words = {name: f"{each * 1e3:.0f} ms" if isinstance(each, float) else each for name, each in found.items()}
    told = [*dict.fromkeys(words.values())]
    rows = [(each, ", ".join(name for name in words if words[name] == each)) for each in told]
    text = rows[0][0] if len(rows) == 1 else "; ".join(f"{each}: {who}" for each, who in rows)
    return Text(text, "red" if "FAILED" in told else "green" if told != [NOT_MADE] else "")


def _outcome(results: "list[Result]") -> float | str:
    """How long the device took [s], or a word."""
    outcomes = {each.outcome for each in results}
    if "failed" in outcomes:
        return "FAILED"
    if times := [each.seconds for each in results if each.seconds is not None]:
        return max(times)
    return "ok" if "passed" in outcomes else NOT_MADE
