"""Runs the whole job on a simulated arm: sweep, calibrate, identify, verify, drift and recalibration, gap diagnosis."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    target: Annotated[str | None, typer.Argument(metavar="[ARM]", help="Same as --arm.", show_default=False)] = None,
    arm: Annotated[
        str | None,
        typer.Option(help="Bundled arm, arm file with the key sim, or URDF or MJCF model; by default sarcos."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the hidden true values.")] = 0,
    realism: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Size of the small imperfections of a real arm: 0 none, 1 a good arm, 3 a bad arm; by default the "
            "value of the arm file.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for report.html, summary.json and the data.")] = Path(
        "armlink-demo"
    ),
    json: Annotated[
        Path | None, typer.Option(help="Also write the summary as JSON to this file; for standard output give `-`.")
    ] = None,
) -> None:
    """Run the whole procedure on a simulated arm on an in-process CAN bus and write report.html and summary.json.

    If --arm is a URDF or MJCF model, the command first makes an arm file in the folder, as armlink new does.

    Example: armlink demo --arm sarcos --seed 1 --out armlink-demo
    """
    from armlink.errors import BadInput
    from armlink.extras import require_extra

    require_extra("armlink demo", "reports")
    from sim_gap.demo.run import run_demo

    if target is not None and arm is not None and target != arm:
        raise BadInput(f"demo: two arms are given, {target} and --arm {arm}: give one arm")
    run_demo(target or arm or "sarcos", seed=seed, realism=realism, out=out, json_path=json)
