"""Compares model torque with sensor torque at poses that were not used for the fit (the paper's Figure 6)."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, OtherBus
from calib.commands.options import JsonFile, KeepGoing, Store, Tool, WithoutAsking

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.sweep.verify import Verification


def verify(
    arm: Arm,
    bus: OtherBus = None,
    record: Annotated[
        list[str] | None, typer.Option(help="Id of a gravity or calibration record; by default the current records.")
    ] = None,
    tool: Tool = None,
    store: Store = None,
    poses: Annotated[int, typer.Option(min=1, help="Number of poses to drive to.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random poses.")] = 0,
    keep_going: KeepGoing = 0,
    yes: WithoutAsking = False,
    report: Annotated[
        Path | None, typer.Option(help="Also write a report to this file: one self-contained HTML page.")
    ] = None,
    json_file: JsonFile = None,
) -> int:
    """Drive to random poses and compare model and sensor; exit status 1 if the RMS of a joint is too large.

    Example: armlink verify sarcos --bus socketcan:vcan0 --poses 40 --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.extras import require_extra
    from armlink.loop.open import open_arm
    from calib.arm.kinematics import with_tool
    from calib.arm.sweep_section import sweep_motion
    from calib.commands.screen import SPACE_CLEAR, SweepScreen, confirm, print_lines
    from calib.records.store import RecordStore, no_record
    from calib.sweep.verify import run_verify

    if report is not None:
        require_extra("--report", "reports")
    arm_file = with_tool(load_arm(arm), tool)
    unasked = confirm(f"{arm_file.name} will drive to {poses} poses all over its range", SPACE_CLEAR, yes)
    with (
        early_end(arm_file, command_line("verify", arm, bus=bus, tool=tool, store=store)) as work,
        open_arm(arm_file, bus) as link,
    ):
        gravity, calibration = _records(RecordStore(store), arm_file, record or [])
        if calibration is None and sweep_motion(arm_file) == "creep":
            raise no_record(arm_file, "calibration")
        link.start()
        print_lines(unasked)
        work.enabled = True
        with SweepScreen(f"{arm_file.name}: verify") as screen:
            link.enable()
            watch, bridge = screen.count, screen.on_stall(keep_going)
            result = run_verify(
                link, arm_file, gravity, calibration, poses=poses, seed=seed, progress=watch, on_stall=bridge
            )
    _show(result, results(json_file))
    if result.passed:
        suggest(command_line("daemon", arm, bus=bus, store=store))
    if report is not None:
        from calib.report.calibration import write_verification

        write_verification(result, arm_file, gravity, calibration, report)
    write_json(json_file, _answer(result, gravity, calibration))
    return 0 if result.passed else 1


def _records(store: Any, arm_file: Any, ids: list[str]) -> "tuple[GravityRecord, CalibrationRecord | None]":
    """The records named, else the current ones; raises Refused where there is no gravity record."""
    from calib.records.records import CalibrationRecord, GravityRecord

    named = [store.usable(record, arm_file) for record in ids]
    gravity = next((each for each in named if isinstance(each, GravityRecord)), None)
    calibration = next((each for each in named if isinstance(each, CalibrationRecord)), None)
    gravity = gravity or store.required(GravityRecord, arm_file)
    return gravity, calibration or store.current(CalibrationRecord, arm_file)


def _answer(
    result: "Verification", gravity: "GravityRecord", calibration: "CalibrationRecord | None"
) -> dict[str, Any]:
    return {
        "schema": "armlink.verify/1",
        "gravity_record": gravity.id,
        "calibration_record": None if calibration is None else calibration.id,
        "joints": list(result.names),
        "position": result.position.tolist(),
        "sensor": result.sensor.tolist(),
        "model": result.model.tolist(),
        "model_std": result.model_std.tolist(),
        "rms": result.rms.tolist(),
        "max_error": result.max_error.tolist(),
        "tolerance": result.tolerance.tolist(),
        "skipped": result.skipped,
        "passed": result.passed,
    }


def _show(result: "Verification", console: "PlainConsole") -> None:
    from rich.table import Table

    title = f"Model against sensor at {len(result.sensor)} poses [N·m]"
    table = Table("joint", "RMS", "largest", "allowed RMS", title=title)
    for name, *torques in zip(result.names, result.rms, result.max_error, result.tolerance, strict=True):
        table.add_row(name, *(f"{torque:.3g}" for torque in torques))
    console.print(table)
    beyond = [name for name, off in zip(result.names, result.rms > result.tolerance, strict=True) if off]
    agree = "passed: at every joint the RMS difference between model and sensor is within the limit"
    console.print(f"failed: the RMS difference is beyond the limit at {', '.join(beyond)}" if beyond else agree)
    light = abs(result.model).max(axis=0) < result.tolerance
    if untold := ", ".join(name for name, is_light in zip(result.names, light, strict=True) if is_light):
        console.print(f"the torque gain of {untold} was not verified: gravity torque is below the limit there")
