"""Why the simulation disagrees with the real arm: where, which effect, how far adding it closes the gap."""

from pathlib import Path
from typing import Annotated

import typer

from sim_gap.commands.gap_bench import bench
from sim_gap.commands.gap_collect import collect
from sim_gap.commands.gap_fleet import diagnose_fleet
from sim_gap.commands.gap_plan import plan

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True, help=__doc__)


@app.callback()
def gap() -> None:
    """Explain the gap between a simulation model and recordings of the real arm."""


app.command()(bench)
app.command()(plan)
app.command()(collect)
app.command()(diagnose_fleet)


@app.command()
def diagnose(
    sim: Annotated[str, typer.Option(help="Nominal model: MJCF, URDF or arm file.")],
    train: Annotated[list[Path], typer.Option(help="Recording to fit; may be given several times.")],
    heldout: Annotated[
        list[Path] | None, typer.Option(help="Recording of other motion to judge on; may repeat.")
    ] = None,
    json: Annotated[str | None, typer.Option(help="Write the answer here; - is standard output.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a self-contained HTML report here.")] = None,
    out_model: Annotated[
        Path | None,
        typer.Option(help="Write the model with the effects added here (MJCF), and beside it a module for the rest."),
    ] = None,
) -> None:
    """Say where the gap lies, which effects cause it, and how far it shrinks on motion not fitted.

    Example: armlink gap diagnose --sim arm.xml --train slow.csv --train fast.csv --heldout other.csv --json -
    """
    from rich.console import Console

    from sim_gap.commands.diagnose import run_diagnose

    run_diagnose(sim, train, heldout or [], json, report, out_model, Console(stderr=True))
