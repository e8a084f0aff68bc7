"""An answer on the terminal: causes with their parameters, gap of each joint, notes."""

from rich.console import Console
from rich.table import Column, Table

from sim_gap.attribution.diagnosis import Diagnosis


def show(answer: Diagnosis, console: Console) -> None:
    """Print causes and gap as tables, then the notes."""
    if answer.causes:
        effect = Column("effect", no_wrap=True)
        headers = "joints", "RMS before", "after", "confidence", "confounded with"
        table = Table(effect, *headers, title="causes, on held-out data")
        for cause in answer.causes:
            joints = f"all {len(answer.names)}" if cause.joints == answer.names else ", ".join(cause.joints)
            numbers = f"{cause.gap_before:.3g}", f"{cause.gap_after:.3g}", f"{cause.confidence:.2f}"
            table.add_row(cause.effect, joints, *numbers, ", ".join(cause.confounded_with))
        console.print(table)
        console.print(_parameters(answer))
    table = Table("joint", "noise floor", "before", "after", title=f"gap on {answer.heldout_is}, RMS in {answer.unit}")
    for j, name in enumerate(answer.names):
        numbers = answer.noise_floor[j], answer.heldout_before[j], answer.heldout_after[j]
        table.add_row(name, *(f"{value:.3g}" for value in numbers))
    console.print(table)
    for note in answer.notes:
        console.print(note, style="yellow")


def _parameters(answer: Diagnosis) -> Table:
    """The parameters of the causes with their 95 % intervals."""
    effect, interval = Column("effect", no_wrap=True), Column("95 % interval", no_wrap=True)
    table = Table(effect, "joint", "parameter", "value", interval, title="their parameters")
    for cause in answer.causes:
        for joint, values in cause.parameters.items():
            for name, each in values.items():
                unit = "" if each.unit == "1" else f" ({each.unit})"
                between = f"{each.low:.3g} to {each.high:.3g}"
                table.add_row(cause.effect, joint, name + unit, f"{each.value:.4g}", between)
    return table
