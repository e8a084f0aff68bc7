"""What `armlink gap diagnose` does: load, diagnose, tell, write."""

import json as json_format
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from armlink.errors import BadInput
from armlink.recording.recording import load_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.better_model.effects_module import module_path
from sim_gap.better_model.export import write_model
from sim_gap.report.effect_text import sentence


def run_diagnose(
    sim: str,
    train: list[Path],
    heldout: list[Path],
    json: str | None,
    report: Path | None,
    out_model: Path | None,
    console: Console,
) -> Diagnosis:
    """Diagnose, show tables on `console`, write what was asked for. Raises BadInput."""
    paths = [*train, *heldout]
    for target in (None if json == "-" else json, report, out_model):
        if target is not None and not Path(target).resolve().parent.is_dir():
            raise BadInput(f"{target}: its folder does not exist: make it first")
    with console.status(f"reading {len(paths)} recordings"):
        recordings = [load_recording(path) for path in paths]
    with console.status("comparing with the model; every effect competes"):
        answer = diagnose(sim, recordings[: len(train)], recordings[len(train) :], labels=[str(path) for path in paths])
    for path, recording in zip(paths, recordings, strict=True):
        if recording.warning:
            console.print(f"{path}: {recording.warning}", style="yellow")
    show(answer, console)
    if report is not None:
        from sim_gap.report.page import write_report

        write_report(answer, report, subtitle=f"{sim} against {', '.join(str(path) for path in paths)}")
        console.print(f"report in {report}")
    if out_model is not None:
        missing = write_model(answer.internals.model, answer.internals.estimate, out_model)
        console.print(f"model with the effects in {out_model}")
        for line in missing:
            console.print(f"MJCF cannot hold {line}", style="yellow")
        if missing:
            console.print(f"{module_path(out_model)} applies these in a MuJoCo simulation")
    text = json_format.dumps(answer.to_json(), indent=1, ensure_ascii=False)
    if json == "-":
        sys.stdout.write(text + "\n")
    elif json is not None:
        Path(json).write_text(text + "\n", encoding="utf-8")
    return answer


def show(answer: Diagnosis, console: Console) -> None:
    """Print verdict, causes and gap as tables for people."""
    console.print(f"[bold]{answer.verdict}[/bold]: {sentence(answer)}")
    if answer.causes:
        effect = Column("effect", no_wrap=True)
        headers = "joints", "RMS before", "after", "confidence", "confounded with"
        table = Table(effect, *headers, title="causes, held-out motion")
        for cause in answer.causes:
            joints = f"all {len(answer.names)}" if cause.joints == answer.names else ", ".join(cause.joints)
            numbers = f"{cause.gap_before:.3g}", f"{cause.gap_after:.3g}", f"{cause.confidence:.2f}"
            table.add_row(cause.effect, joints, *numbers, ", ".join(cause.confounded_with))
        console.print(table)
    table = Table("joint", "noise floor", "before", "after", title=f"gap on {answer.heldout_is}, RMS in N·m")
    for j, name in enumerate(answer.names):
        numbers = answer.noise_floor[j], answer.heldout_before[j], answer.heldout_after[j]
        table.add_row(name, *(f"{value:.3g}" for value in numbers))
    console.print(table)
    for note in answer.notes:
        console.print(note, style="yellow")
