"""Floats the arm: gravity is compensated, and it stays where a hand leaves it."""

from typing import TYPE_CHECKING, Annotated

import typer

from armlink.commands.options import Arm, OtherBus
from calib.commands.options import JsonFile, Store, Tool, WithoutAsking

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.records.records import CalibrationRecord
    from gcomp.arrays import Array


def hold_afloat(
    arm: Arm,
    bus: OtherBus = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="Duration [s]; 0: until Ctrl-C.")] = 0.0,
    record: Annotated[
        str | None,
        typer.Option(help="Id of a gravity record; default: the current record or, if none, the model's inertials."),
    ] = None,
    tool: Tool = None,
    store: Store = None,
    yes: WithoutAsking = False,
    json_file: JsonFile = None,
) -> None:
    """Carry the arm's weight by torque, so that a hand can move it, until Ctrl-C; then every joint holds where it is.

    Stops have soft ends; no frame exceeds the arm file's limits. Keep a hand on the arm the first time.

    Example: armlink float sarcos --bus socketcan:can0
    """
    from contextlib import suppress

    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, command_line, results
    from armlink.errors import ArmlinkError
    from armlink.loop.open import open_arm
    from calib.arm.kinematics import with_tool
    from calib.commands.screen import confirm, print_lines, warn_late
    from calib.floating.run import run_float

    arm_file = with_tool(load_arm(arm), tool)
    beta, calibration, source = _model(arm_file, record, store)
    screen = PlainConsole()
    unasked = confirm(f"Only the gravity model will hold {arm_file.name}", "Do you hold the arm with your hand?", yes)
    resume = command_line("float", arm, bus=bus, record=record, tool=tool, store=store)
    with early_end(arm_file, resume) as work, open_arm(arm_file, bus) as link:
        link.start()
        print_lines(unasked)
        work.enabled = True
        link.enable()
        screen.print(f"{arm_file.name} floats by {source}; end with Ctrl-C")
        try:
            result = run_float(link, arm_file, beta, calibration, seconds=seconds or float("inf"))
        finally:  # Ctrl-C is its usual end
            with suppress(ArmlinkError):
                lateness = link.stats.lateness
                warn_late(arm_file, lateness)
    results(json_file).print(f"floated {result.seconds:.1f} s")
    write_json(
        json_file,
        {
            "schema": "armlink.float/1",
            "joints": list(arm_file.joint_names),
            "model": source,
            "seconds": result.seconds,
            "largest_torque": result.largest_torque.tolist(),
            "largest_speed": result.largest_speed.tolist(),
            "moved": result.moved.tolist(),
            "late_ms": lateness.in_ms(),
        },
    )


def _model(arm_file: "ArmFile", record: str | None, store: str | None) -> "tuple[Array, CalibrationRecord | None, str]":
    """Mass moments (2n,) [kg·m], the calibration record if any, and where the moments come from; raises Refused."""
    from calib.arm.kinematics import model_arm
    from calib.commands.options import gravity_model
    from calib.commissioning.model_checks import refuse_impossible_model
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore, no_record

    records = RecordStore(store)
    calibration, found = records.current(CalibrationRecord, arm_file), gravity_model(arm_file, record, records)
    if found is not None:
        return found[0], calibration, found[1]
    if arm_file.model_path is None:
        raise no_record(arm_file, "gravity")
    refuse_impossible_model(arm_file)
    return model_arm(arm_file).beta, calibration, f"the inertials of {arm_file.model_path.name}"
