"""Explains why simulation and real arm disagree: where the gap is, its causes, and how far they close it."""

from collections.abc import Callable

import typer

from armlink.commands.options import GroupedCommand
from sim_gap.commands.gap_bench import bench
from sim_gap.commands.gap_compare import compare
from sim_gap.commands.gap_diagnose import diagnose
from sim_gap.commands.gap_fleet import diagnose_fleet, trend
from sim_gap.commands.gap_motion import collect, plan

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None, no_args_is_help=True)


@app.callback()
def gap() -> None:
    """Explain the gap between a simulation model and recordings of the real arm.

    Example: armlink gap diagnose --sim arm.xml --train slow.csv --heldout other.csv
    """


SUMMARIES: dict[Callable[..., object], str] = {
    diagnose: "Find the causes of the gap, and how much of the gap they explain.",
    compare: "Rank several models on the same recordings.",
    plan: "Plan a motion that separates effects; nothing moves.",
    collect: "Move the arm along a plan and record it.",
    diagnose_fleet: "Diagnose the recordings of many arms.",
    trend: "Find what changes over the recordings of one arm.",
    bench: "Test the diagnosis on simulated arms with hidden faults.",
}
for command, summary in SUMMARIES.items():
    app.command(cls=GroupedCommand, short_help=summary)(command)
