"""Explains why simulation and real arm disagree: where the gap is, its causes, and how far they close it."""

import typer

from sim_gap.commands.gap_bench import bench
from sim_gap.commands.gap_diagnose import diagnose
from sim_gap.commands.gap_fleet import diagnose_fleet, trend
from sim_gap.commands.gap_motion import collect, plan

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True)


@app.callback()
def gap() -> None:
    """Explain the gap between a simulation model and recordings of the real arm.

    Example: armlink gap diagnose --sim arm.xml --train slow.csv --heldout other.csv
    """


for command in (diagnose, plan, collect, diagnose_fleet, trend, bench):
    app.command()(command)
