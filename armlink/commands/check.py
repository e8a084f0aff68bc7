"""Tests an arm's controllers: what they are, hold, and do when their host falls silent."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, Json, OtherBus

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from armlink.arm_file import ArmFile
    from armlink.drives.findings import Result

SCHEMA = "armlink.check/1"
HOST_SCHEMA = "armlink.check-host/1"
WARNING = (
    "This test enables every joint of {arm} and lets it hold where it stands (at most its max_torque). One after the "
    "other is then quick-stopped, and left without commands for {deadline:.0f} ms; then all are left without the "
    "host's heartbeat for {heartbeat:.0f} ms. Nothing is moved on purpose, but a controller that does something else "
    "than quick stop and hold may let its joint fall: put the arm where none can fall, keep clear, and keep a hand on "
    "the emergency stop. In the end the joints are in quick stop, holding."
)


def check(
    arm: Arm,
    bus: OtherBus = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the joints are enabled.")] = False,
    passive: Annotated[
        bool, typer.Option("--passive", help="Only the checks that need no power: they read and configure.")
    ] = False,
    host: Annotated[
        bool, typer.Option("--host", help="Measure how well this machine keeps the cycle instead; needs no bus.")
    ] = False,
    scales: Annotated[
        str | None,
        typer.Option(
            help="Judge the scales of position, velocity and torque instead: hand (you turn every joint from stop to "
            "stop, without power), move (all joints by 0.35 rad) or listen (another host moves the arm)."
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="How long --host measures, and --scales hand or listen [s].")
    ] = 20.0,
    json: Json = None,
) -> int:
    """Check identity, objects, PDO mapping, limits, calibration; then, with power, quick stop, deadline and heartbeat.

    It shows that each controller stops by itself when its host falls silent, and how long it takes. It says what it
    does to the joints and asks first, unless --yes or on a simulated arm in this process. Exit status 1 where a check
    fails; the joints are left in quick stop, holding.

    With --host nothing is sent anywhere: cycles are made at the arm's rate while a job computes and writes beside them;
    exit status 1 if this machine is too late for the arm's deadline or rate.

    With --scales readings are judged while the arm moves: exit status 1 if a scale of a drive is off by a tenth.

    Example: armlink check sarcos --bus socketcan:vcan0 --yes --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, command_line, confirm, results, suggest
    from armlink.errors import BadInput, BusFault, Refused
    from armlink.link.link import Link
    from armlink.loop.open import open_arm
    from armlink.selftest.self_test import self_test

    console = PlainConsole()
    described = load_arm(arm)
    if host:
        return _check_host(console, described, seconds, json)
    if scales is not None:
        return _check_scales(console, described, bus, scales, seconds, yes, json)
    with early_end(described) as work, open_arm(described, bus) as link:
        simulated = isinstance(link, Link) and link.bus.clock is not None
        if not (passive or yes or simulated):
            deadline = described.require_link().deadline * 1e3
            times = {"deadline": deadline, "heartbeat": 2 * deadline}
            console.print(WARNING.format(arm=described.name, **times))
            if not console.is_terminal:
                raise BadInput("check: nobody to ask: give --yes, or --passive for what needs no power")
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
        raise BusFault(
            f"no answer from {', '.join(each.joint for each in failed if each.check == 'answers')} on {channel}"
        )
    if failed:
        first = failed[0]
        raise Refused(f"check: {len(failed)} of {len(found)} failed, first {first.joint}: {first.check}: {first.found}")
    passed = sum(each.outcome == "passed" for each in found)
    out.print(f"all {passed} checks passed; the joints {'were not enabled' if passive else 'hold, in quick stop'}")
    suggest(command_line("sweep", arm, "--plan", bus=bus))
    return 0


def _check_scales(
    console: "Console", arm: "ArmFile", bus: str | None, how: str, seconds: float, yes: bool, json: Path | None
) -> int:
    """Scales of the drives' readings; asks before this host moves the arm."""
    from armlink.commands.plain_console import confirm
    from armlink.commands.scale_report import check_scales
    from armlink.errors import BadInput
    from armlink.loop.open import is_in_process

    if how not in ("hand", "move", "listen"):
        raise BadInput(f"check --scales {how}: expected hand, move or listen")
    if how == "move" and not yes and not is_in_process(arm, bus):
        if not console.is_terminal:
            raise BadInput("check --scales move: nobody to ask: give --yes, or --scales hand")
        confirm(f"All joints of {arm.name} will turn by 0.35 rad to both sides. Is it clear?")
    return check_scales(console, arm, bus, how, seconds, json)  # type: ignore[arg-type]


def _check_host(console: "Console", arm: "ArmFile", seconds: float, json: Path | None) -> int:
    """Lateness of this machine's cycle at the arm's rate, and the rate that it holds."""
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.errors import Refused
    from armlink.link.lateness import WARN_SHARE
    from armlink.selftest.host import measure_host

    with console.status(f"{arm.name}: cycles at {arm.require_link().rate:g} Hz for {seconds:g} s, with a job beside"):
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
        f"cycles began late by {late['p50']:.2f} ms (median), {late['p99']:.2f} (99 %), {late['p99_9']:.2f} (99.9 %),"
        f" {late['max']:.2f} (longest); {report.busy * 1e3:.2f} ms of processor time each; {report.realtime}",
    )
    out.print(f"this machine holds {report.holds_hz:g} Hz; the arm file asks for {section.rate:g} Hz")
    limit = WARN_SHARE * section.deadline * 1e3
    if late["p99_9"] > limit:
        raise Refused(
            f"check --host: 99.9 % of the cycles are within {late['p99_9']:.1f} ms, expected {limit:g} (half of"
            " link.deadline): lower link.rate, raise link.deadline, or stop what else runs here"
        )
    if report.holds_hz < section.rate:
        raise Refused(f"check --host: this machine holds {report.holds_hz:g} Hz: lower link.rate ({section.rate:g})")
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
        table.add_row(group, _outcomes({name: _outcome(joints.get(name, [])) for name in names}))
    return table


def _outcomes(found: dict[str, str]) -> "Text":
    from rich.text import Text

    told = [*dict.fromkeys(found.values())]
    if all(each.endswith(" ms") for each in told):
        times = sorted(float(each.removesuffix(" ms")) for each in told)
        return Text(f"{times[0]:g} ms" if len(times) == 1 else f"{times[0]:g} to {times[-1]:g} ms", "green")
    rows = [(each, ", ".join(name for name in found if found[name] == each)) for each in told]
    text = rows[0][0] if len(rows) == 1 else "; ".join(f"{each}: {who}" for each, who in rows)
    return Text(text, "red" if "FAILED" in told else "green" if told != ["–"] else "")


def _outcome(results: "list[Result]") -> str:
    outcomes = {each.outcome for each in results}
    if "failed" in outcomes:
        return "FAILED"
    if times := [each.seconds for each in results if each.seconds is not None]:
        return f"{max(times) * 1e3:.0f} ms"
    return "ok" if "passed" in outcomes else "–"
