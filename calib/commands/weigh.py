"""Weighs what the arm carries: mass and centre of mass, from torques at rest in a few poses."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, OtherBus
from calib.commands.options import JsonFile, KeepGoing, Store, WithoutAsking

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.fit.field_fit import Payload


def weigh(
    arm: Arm,
    bus: OtherBus = None,
    poses: Annotated[int, typer.Option(min=4, max=200, help="Number of poses to drive to.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random choice of poses.")] = 0,
    store: Store = None,
    keep_going: KeepGoing = 0,
    yes: WithoutAsking = False,
    json_file: JsonFile = None,
) -> None:
    """Drive to poses and weigh the tool or payload that the arm carries in addition to its gravity record.

    The arm must have been calibrated and identified. A declared `tool` is weighed, too.

    Example: armlink weigh sarcos --bus socketcan:vcan0 --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results
    from armlink.loop.open import open_arm
    from calib.commands.screen import SPACE_CLEAR, SweepScreen, confirm, print_lines
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.records.store import RecordStore
    from calib.sweep.verify import run_weigh

    arm_file, records = load_arm(arm).model_copy(update={"tool": None}), RecordStore(store)
    gravity, calibration = records.required(GravityRecord, arm_file), records.required(CalibrationRecord, arm_file)
    motion = f"{arm_file.name} will drive to {poses} poses all over its range, with its load"
    unasked = confirm(motion, SPACE_CLEAR, yes)
    with (
        early_end(arm_file, command_line("weigh", arm, bus=bus, store=store)) as work,
        open_arm(arm_file, bus) as link,
    ):
        link.start()
        print_lines(unasked)
        work.enabled = True
        with SweepScreen(f"{arm_file.name}: weigh") as screen:
            link.enable()
            watch, bridge = screen.count, screen.on_stall(keep_going)
            payload, reached = run_weigh(
                link, arm_file, gravity, calibration, poses=poses, seed=seed, progress=watch, on_stall=bridge
            )
    _show(payload, reached, results(json_file))
    write_json(json_file, _answer(payload, reached, arm_file.joint_names, (gravity.id, calibration.id)))


def _answer(payload: "Payload", reached: int, names: tuple[str, ...], records: tuple[str, str]) -> dict[str, Any]:
    import numpy as np

    half = 1.96 * payload.centre_std
    return {
        "schema": "armlink.weigh/1",
        "gravity_record": records[0],
        "calibration_record": records[1],
        "joints": list(names),
        "poses": reached,
        "mass": payload.mass,
        "mass_ci95": [payload.mass - 1.96 * payload.mass_std, payload.mass + 1.96 * payload.mass_std],
        "centre": payload.centre.tolist(),
        "centre_ci95": np.stack([payload.centre - half, payload.centre + half], axis=1).tolist(),
        "residual_rms": payload.residual_rms.tolist(),
    }


def _show(payload: "Payload", reached: int, console: "PlainConsole") -> None:
    import numpy as np

    console.print(f"mass {payload.mass:.3f} ± {1.96 * payload.mass_std:.3f} kg (95 %), from {reached} poses")
    for axis, value, std in zip("xyz", payload.centre, payload.centre_std, strict=True):
        told = f"{value:+.4f} ± {1.96 * std:.4f} m" if np.isfinite(value) else "not determined by these poses"
        console.print(f"centre {axis}: {told}")
    if np.isfinite(payload.centre).all():
        centre = ", ".join(f"{value:.4f}" for value in payload.centre)
        spread = f"mass_std: {payload.mass_std:.4f}, centre_std: {payload.centre_std.max():.4f}"
        console.print(f"for the arm file: tool: {{mass: {payload.mass:.4f}, centre: [{centre}], {spread}}}")
