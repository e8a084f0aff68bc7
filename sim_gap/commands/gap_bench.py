"""Tests the diagnosis on sealed cases of simulated arms."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Json

if TYPE_CHECKING:
    from rich.console import Console


def _other(help_text: str, **more: Any) -> Any:
    return typer.Option(help=help_text, rich_help_panel="Other cases", **more)


def bench(
    seed: Annotated[int, typer.Option(help="Seed of arms, effects and motions.")] = 1,
    cases: Annotated[int, typer.Option(help="Number of cases.")] = 150,
    effects: Annotated[
        str, _other("Number of effects in every case; by default none, one or two.", metavar="LOW-HIGH")
    ] = "",
    channels: Annotated[
        str, _other("q,q_cmd: cases with position servos and without torques; by default cases with torques.")
    ] = "",
    real: Annotated[
        Path | None,
        _other("Diagnose instead the recordings of real arms in this folder; see --known.", metavar="DIR"),
    ] = None,
    known: Annotated[
        Path | None, _other("YAML file with the known effects of these arms; by default the published arms.")
    ] = None,
    json: Json = None,
    out: Annotated[Path | None, typer.Option(help="Store cases, answers and labels in this new folder.")] = None,
    workers: Annotated[int, typer.Option(help="Number of processes.")] = 2,
) -> None:
    """Make sealed cases, diagnose them with and without the true effect in the library, open the labels and score.

    Example: armlink gap bench --seed 3 --cases 60 --out bench-3 --json bench-3.json

    Many effects at once: armlink gap bench --effects 5-8 --cases 30 --seed 3

    Positions alone: armlink gap bench --channels q,q_cmd --cases 60 --seed 3

    Real arms: armlink gap bench --real recordings/
    """
    from tempfile import TemporaryDirectory

    from rich.progress import Progress, TaskID

    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.errors import BadInput
    from sim_gap.blind.bench import diagnose_files, run_bench
    from sim_gap.blind.real_recordings import KNOWN, run_real

    if json is not None and str(json) != "-" and not json.resolve().parent.is_dir():
        raise BadInput(f"--json {json}: the folder of this file does not exist: create it first")
    if channels and {*channels.split(",")} != {"q", "q_cmd"}:
        raise BadInput(f"--channels {channels}: expected q,q_cmd; leave the option out for arms with torque sensors")
    positions = bool(channels)
    console = PlainConsole()
    with TemporaryDirectory(prefix="armlink-bench-") as scratch, Progress(console=console) as bars:
        stages: dict[str, TaskID] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in stages:
                stages[stage] = bars.add_task(stage, total=total)
            bars.update(stages[stage], completed=done)

        if real is not None:
            result = run_real(real, out or Path(scratch), known or KNOWN, progress)
        else:
            folder = out or Path(scratch)
            result = run_bench(diagnose_files, folder, seed, cases, workers, None, progress, effects, positions)
    shown = show_real if real is not None else show_positions if positions else show
    shown(result, results(json))
    write_json(json, result)


ROWS = (
    ("right effect first, if the motion can distinguish it", "label_withheld", "first_right_where_tellable"),
    ("right effect first", "label_withheld", "first_right"),
    ("right effect first or named as confounded", "label_withheld", "first_or_confounded"),
    ("an extra cause claimed with confidence", "label_withheld", "extra_confident"),
    ("joints: F1", "label_withheld", "joints", "f1"),
    ("no effect: false alarms", "label_withheld", "no_effect", "false_alarms"),
    ("two effects: both found", "label_withheld", "two", "both_found"),
    ("many effects: true effects that are named", "label_withheld", "several", "named"),
    (
        "many effects: false causes among the causes claimed with confidence",
        "label_withheld",
        "several",
        "false_confident",
    ),
    ("parameters: median error", "label_withheld", "parameters", "median_error"),
    ("parameters: within 10 %", "label_withheld", "parameters", "within_10_percent"),
    ("parameters: 95 % intervals that contain the true value", "label_withheld", "parameters", "inside_ci95"),
    (
        "decrease of the gap, divided by the decrease that the true effect gives: median",
        "label_withheld",
        "shrink",
        "median_ratio",
    ),
    ("effect withheld: a wrong effect is named", "effect_withheld", "false_blame"),
)


def show(result: Mapping[str, Any], console: "Console") -> None:
    from rich.table import Table

    table = Table("figure", "value", title=f"blind check, {_counted(result)}")
    for text, *path in ROWS:
        value: Any = result
        for key in path:
            value = value[key]
        table.add_row(text, _percent(value))
    console.print(table)
    _show_effects(result, console)


def show_positions(result: Mapping[str, Any], console: "Console") -> None:
    console.print(
        f"{_counted(result)}; {result['answers']} answers, {result['tellable']} of them on one distinguishable effect. "
        f"Right first or confounded: {_percent(result['named_where_tellable'])}; false causes above confidence 0.8: "
        f"{_percent(result['false_confident'])}; false alarms without an effect: "
        f"{_percent(result['label_withheld']['no_effect']['false_alarms'])}"
    )
    _show_effects(result, console)


def _counted(result: Mapping[str, Any]) -> str:
    left = f", {result['left_out']} left out, since no drawn arm shows them" if result["left_out"] else ""
    return f"{result['label_withheld']['cases']} cases{left}"


def _show_effects(result: Mapping[str, Any], console: "Console") -> None:
    from rich.table import Table

    table = Table("effect", "cases", "right first", "named", "median error", "first effect named instead")
    for effect, line in result["by_effect"].items():
        others = {name: k for name, k in result["confusion"].get(effect, {}).items() if name != effect}
        instead = ", ".join(f"{name} {k}" for name, k in others.items())
        counts = (str(line[key]) for key in ("cases", "first_right", "named"))
        table.add_row(effect, *counts, _percent(line["median_error"]), instead)
    console.print(table)
    table = Table("confidence", "answers", "right")
    for line in result["calibration"]:
        table.add_row(f"{line['from']:.2f} to {line['to']:.2f}", str(line["count"]), _percent(line["right"]))
    console.print(table)
    missed = [name for name, met in result["meets"].items() if not met]
    console.print("all bounds met" if not missed else f"bounds not met: {', '.join(missed)}")


def show_real(result: Mapping[str, Any], console: "Console") -> None:
    from rich.table import Table

    table = Table("case", "without", "verdict", "first", "confidence", "false above 0.8", "not named")
    for row in result["cases"]:
        sure = "–" if row["confidence"] is None else f"{row['confidence']:.2f}"
        cells = (row["case"], row["withheld"] or "", row["verdict"], row["first"] or "–", sure)
        table.add_row(*cells, ", ".join(row["false"]), ", ".join(row["lacking"]))
    console.print(table)
    right, false, named = (_percent(result[key]) for key in ("right_first", "false_confident", "named"))
    console.print(f"right first {right}, a false cause above 0.8 {false}, all known effects named {named}")
    if result["missing"]:
        console.print(f"recordings missing: {', '.join(result['missing'])}")


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"
