"""Tests the diagnosis on sealed cases of simulated arms."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Json
from sim_gap.commands.gap_diagnose import print_table

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
        _other("Diagnose instead the recordings of the published arms in this folder.", metavar="DIR"),
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
    from sim_gap.blind.bench import diagnose_folder, run_bench
    from sim_gap.blind.real_recordings import run_real

    if json is not None and str(json) != "-" and not json.resolve().parent.is_dir():
        raise BadInput(f"--json {json}: the folder of this file does not exist: create it first")
    if channels and {*channels.split(",")} != {"q", "q_cmd"}:
        raise BadInput(f"--channels {channels}: expected q,q_cmd; leave the option out for arms with torque sensors")
    positions = bool(channels)
    with TemporaryDirectory(prefix="armlink-bench-") as scratch, Progress(console=PlainConsole()) as bars:
        stages: dict[str, TaskID] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in stages:
                stages[stage] = bars.add_task(stage, total=total)
            bars.update(stages[stage], completed=done)

        folder = out or Path(scratch)
        if real is not None:
            result = run_real(real, folder, progress=progress, workers=workers)
        else:
            result = run_bench(diagnose_folder, folder, seed, cases, workers, None, progress, effects, positions)
    console = results(json)
    if real is not None:
        show_real(result, console)
    else:
        (show_positions if positions else show_figures)(result, console)
        show_effects(result, console)
    write_json(json, result)


LABEL_FIGURES = {
    "right effect first, if the motion can distinguish it": "first_right_where_tellable",
    "right effect first": "first_right",
    "right effect first or named as confounded": "first_or_confounded",
    "an extra cause claimed with confidence": "extra_confident",
    "joints: F1": "joints.f1",
    "no effect: false alarms": "no_effect.false_alarms",
    "two effects: both found": "two.both_found",
    "many effects: true effects that are named": "several.named",
    "many effects: false causes among the causes claimed with confidence": "several.false_confident",
    "parameters: median error": "parameters.median_error",
    "parameters: within 10 %": "parameters.within_10_percent",
    "parameters: 95 % intervals that contain the true value": "parameters.inside_ci95",
    "decrease of the gap, divided by the decrease that the true effect gives: median": "shrink.median_ratio",
}
"""Figures of the cases whose labels are hidden: text → key, or key within a mapping, of `label_withheld`."""


def show_figures(result: Mapping[str, Any], console: "Console") -> None:
    shown = []
    for text, path in LABEL_FIGURES.items():
        value: Any = result["label_withheld"]
        for key in path.split("."):
            value = value[key]
        shown.append((text, _percent(value)))
    shown.append(("effect withheld: a wrong effect is named", _percent(result["effect_withheld"]["false_blame"])))
    print_table(console, ("figure", "value"), shown, f"blind check, {_counted(result)}")


def show_positions(result: Mapping[str, Any], console: "Console") -> None:
    console.print(
        f"{_counted(result)}; {result['answers']} answers, {result['tellable']} of them on one distinguishable effect. "
        f"Right first or confounded: {_percent(result['named_where_tellable'])}; false causes above confidence 0.8: "
        f"{_percent(result['false_confident'])}; false alarms without an effect: "
        f"{_percent(result['label_withheld']['no_effect']['false_alarms'])}"
    )


def show_effects(result: Mapping[str, Any], console: "Console") -> None:
    rows = []
    for effect, line in result["by_effect"].items():
        others = {name: k for name, k in result["confusion"].get(effect, {}).items() if name != effect}
        instead = ", ".join(f"{name} {k}" for name, k in others.items())
        counts = (str(line[key]) for key in ("cases", "first_right", "named"))
        rows.append((effect, *counts, _percent(line["median_error"]), instead))
    header = ("effect", "cases", "right first", "named", "median error", "first effect named instead")
    print_table(console, header, rows)
    ranges = result["calibration"]
    rows = [(f"{x['from']:.2f} to {x['to']:.2f}", str(x["count"]), _percent(x["right"])) for x in ranges]
    print_table(console, ("confidence", "answers", "right"), rows)
    missed = [name for name, met in result["meets"].items() if not met]
    console.print("all bounds met" if not missed else f"bounds not met: {', '.join(missed)}")


def show_real(result: Mapping[str, Any], console: "Console") -> None:
    rows = []
    for row in result["cases"]:
        sure = "–" if row["confidence"] is None else f"{row['confidence']:.2f}"
        cells = (row["case"], row["withheld"] or "", row["verdict"], row["first"] or "–", sure)
        rows.append((*cells, ", ".join(row["false"]), ", ".join(row["lacking"])))
    header = ("case", "without", "verdict", "first", "confidence", "false above 0.8", "not named")
    print_table(console, header, rows)
    right, false, named = (_percent(result[key]) for key in ("right_first", "false_confident", "named"))
    console.print(f"right first {right}, a false cause above 0.8 {false}, all known effects named {named}")
    if result["missing"]:
        console.print(f"recordings missing: {', '.join(result['missing'])}")


def _counted(result: Mapping[str, Any]) -> str:
    left = f", {result['left_out']} left out, since no drawn arm shows them" if result["left_out"] else ""
    return f"{result['label_withheld']['cases']} cases{left}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"
