"""Compares several models on the same recordings."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armlink.commands.options import Json, reads_recordings
from sim_gap.commands.gap_diagnose import Base, KnownGain, Tip, print_table

if TYPE_CHECKING:
    from armlink.recording.corrections import Corrections


@reads_recordings
def compare(
    sim: Annotated[list[str], typer.Option(help="Model to compare: MJCF, URDF or arm file; two or more.")],
    heldout: Annotated[list[Path], typer.Option(help="Recording that no model was fitted to; may be repeated.")],
    stated: "Corrections",
    base: Base = None,
    tip: Tip = None,
    gains: KnownGain = "",
    json: Json = None,
) -> None:
    """Rank models by the gap that they leave: free-running and in windows, joint by joint, with intervals.

    Example: armlink gap compare --sim mine.xml --sim published.xml --heldout run.csv
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.errors import BadInput
    from armlink.recording.files import load_recordings
    from sim_gap.compare import compare_models
    from sim_gap.model.load import parse_known_gains

    if len(sim) < 2:
        raise BadInput("--sim: give two or more models")
    with PlainConsole().status("moving the models along the recordings"):
        judged = {name: each for path in heldout for name, each in load_recordings(path, stated.of_reading()).items()}
        found = compare_models(
            sim,
            list(judged.values()),
            labels=list(judged),
            stated=stated,
            known_gains=parse_known_gains(gains),
            base=base,
            tip=tip,
        )
    out = results(json)
    scale, unit = (1e3, "mrad") if found.unit == "rad" else (1.0, found.unit)
    title = f"gap in {found.count} windows, RMS in {unit}"
    rows, alone = [], len({Path(name).name for name in sim}) == len(sim)
    for each in found.models:
        value, low, high = (scale * x for x in each.overall)
        cells = (
            f"{scale * x:.3g}" + ("" if each.free is None else f" ({scale * each.free[j]:.3g})")
            for j, x in enumerate(each.windows)
        )
        model = Path(each.model).name if alone else each.model
        rows.append((model, f"{value:.3g}", f"{low:.3g} to {high:.3g}", *cells))
    print_table(out, ("model", "all joints", "95 % interval", *found.names), rows, title)
    for model, finding in found.checks:
        out.print(f"{model}: {finding.sentence()}", style="yellow")
    if found.unit == "rad":
        out.print("in brackets: the gap of a free-running simulation along the commands")
    write_json(json, found.to_json())
    alike = ", ".join(each.model for each in found.models[1:] if each.alike)
    told = f"; these recordings do not show a difference from {alike}" if alike else ""
    out.print(f"{found.models[0].model} leaves the smallest gap{told}", style="bold")
