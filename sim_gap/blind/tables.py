"""The score of a blind check as tables in the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

ROWS = (
    ("right effect first, if the recording can separate it", "label_withheld", "first_right_where_tellable"),
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
        "decrease of the gap relative to the decrease by the true effect: median",
        "label_withheld",
        "shrink",
        "median_ratio",
    ),
    ("effect withheld: a wrong effect is named", "effect_withheld", "false_blame"),
)


def show(result: Mapping[str, Any], console: Console) -> None:
    table = Table("figure", "value", title=f"blind check, {_counted(result)}")
    for text, *path in ROWS:
        value: Any = result
        for key in path:
            value = value[key]
        table.add_row(text, _percent(value))
    console.print(table)
    _show_effects(result, console)


def show_positions(result: Mapping[str, Any], console: Console) -> None:
    console.print(
        f"{_counted(result)}; {result['answers']} answers, {result['tellable']} of them to one identifiable effect. "
        f"Right first or confounded: {_percent(result['named_where_tellable'])}; a false cause above 0.8: "
        f"{_percent(result['false_confident'])}; false alarms without an effect: "
        f"{_percent(result['label_withheld']['no_effect']['false_alarms'])}"
    )
    _show_effects(result, console)


def _counted(result: Mapping[str, Any]) -> str:
    left = f", {result['left_out']} left out, since no drawn arm shows them" if result["left_out"] else ""
    return f"{result['label_withheld']['cases']} cases{left}"


def _show_effects(result: Mapping[str, Any], console: Console) -> None:
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


def show_real(result: Mapping[str, Any], console: Console) -> None:
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
