"""Explains the gap between a simulation model and recordings of the real arm."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Json, reads_recordings

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status
    from rich.table import Column

    from armlink.recording.corrections import Corrections
    from sim_gap.attribution.diagnosis import Diagnosis


def _about(help_text: str, **more: Any) -> Any:
    return typer.Option(help=help_text, rich_help_panel="About the arm and the recordings", **more)


def _training(help_text: str, **more: Any) -> Any:
    return typer.Option(help=help_text, rich_help_panel="For training in simulation", **more)


Base = Annotated[str | None, _about("Body of the model that carries the recorded arm; by default the world.")]
Tip = Annotated[str | None, _about("Last body of the recorded arm, if the model has several arms.")]
KnownGain = Annotated[
    str,
    _about(
        "Gains of the position controllers, if the model does not have them: kp=20,kd=1.5, or by joint "
        "kp=A;B;… (N·m/rad, N·m·s/rad).",
        metavar="kp=…,kd=…",
    ),
]


@reads_recordings
def diagnose(
    sim: Annotated[str, typer.Option(help="Nominal model: MJCF, URDF or arm file.")],
    train: Annotated[list[Path], typer.Option(help="Recording to fit; may be repeated.")],
    stated: "Corrections",
    heldout: Annotated[
        list[Path] | None,
        typer.Option(
            help="Held-out recording, on which causes are judged; may be repeated. By default the end of each "
            "--train recording."
        ),
    ] = None,
    base: Base = None,
    tip: Tip = None,
    gains: KnownGain = "",
    group: Annotated[
        list[str] | None,
        _about(
            "Recordings, also held-out ones, in which the arm carries the same body, such as a payload; may be "
            "repeated. By default the diagnosis finds these groups.",
            metavar="NAME=REC[,REC…]",
        ),
    ] = None,
    json: Json = None,
    report: Annotated[Path | None, typer.Option(help="Write a self-contained HTML report to this file.")] = None,
    gain: Annotated[
        list[str] | None,
        _about(
            "Gain of the position controller in a recording (patterns allowed), in any unit; only needed if there is "
            "no torque channel and the gain differs between recordings.",
            metavar="REC=VALUE",
        ),
    ] = None,
    samples: Annotated[
        int, _training("Write this number of random samples of all parameters, for domain randomisation.", min=0)
    ] = 0,
    out_samples: Annotated[
        Path | None, _training("File for the samples: .csv, .json or .parquet; by default samples.csv.")
    ] = None,
    out_actuators: Annotated[
        Path | None, _training("Write actuator entries for Isaac Lab and mjlab to this file (.py).")
    ] = None,
    physics_step: Annotated[
        float,
        _training("Physics step of the training simulation [s]; the actuator entries count delays in these steps."),
    ] = 0.005,
    out_model: Annotated[
        Path | None,
        typer.Option(
            help="Write the corrected model to this file (MJCF, or URDF if the name ends in .urdf). Effects that the "
            "format cannot express are written to a Python module in the same folder."
        ),
    ] = None,
) -> None:
    """Find where the gap is, which effects cause it, and how much of it they explain on held-out data.

    Example: armlink gap diagnose --sim arm.xml --train slow.csv --train fast.csv --heldout other.csv --json -
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.errors import BadInput
    from armlink.extras import require_extra
    from armlink.recording.files import load_recordings
    from sim_gap.attribution import diagnose as diagnosis
    from sim_gap.model.load import parse_known_gains
    from sim_gap.report.effect_text import sentence

    console = PlainConsole()
    paths = [*train, *(heldout or [])]
    for target in (None if str(json) == "-" else json, report, out_model, out_samples, out_actuators):
        if target is not None and not target.resolve().parent.is_dir():
            raise BadInput(f"{target}: the folder of this file does not exist: create it first")
    if report is not None:
        require_extra("--report", "reports")
    if out_samples is not None and out_samples.suffix == ".parquet":
        require_extra("--out-samples", "parquet")
    reading = stated.of_reading()
    with console.status(f"reading {len(paths)} recordings"):
        fitted = {name: each for path in train for name, each in load_recordings(path, reading).items()}
        judged = {name: each for path in heldout or () for name, each in load_recordings(path, reading).items()}
    with console.status("checking the data, and fitting effects to the gap") as status:
        answer = diagnosis.diagnose(
            sim,
            list(fitted.values()),
            list(judged.values()),
            labels=[*fitted, *judged],
            stated=stated,
            groups=group or (),
            gains=gain or (),
            known_gains=parse_known_gains(gains),
            base=base,
            tip=tip,
            progress=lambda stage: _progress(console, status, stage),
        )
    for name, recording in {**fitted, **judged}.items():
        if recording.warning:
            console.print(f"{name}: {recording.warning}", style="yellow")
    out = results(json)
    for finding in answer.checks:
        out.print(finding.sentence(), style="yellow")
    show(answer, out)
    if report is not None:
        from sim_gap.report.page import write_report

        write_report(answer, report, subtitle=f"{sim} against {', '.join(str(path) for path in paths)}")
        out.print(f"report: {report}")
    if out_model is not None:
        _write_model(answer, out_model, out)
    if samples:
        _write_samples(answer, samples, out_samples, out)
    if out_actuators is not None:
        _write_actuators(answer, out_actuators, physics_step)
        out.print(f"actuator entries for Isaac Lab and mjlab: {out_actuators}")
    write_json(json, answer.to_json())
    out.print(sentence(answer), style="bold")
    _suggest(answer, sim, json, out_model)


def _suggest(answer: "Diagnosis", sim: str, json: Path | None, out_model: Path | None) -> None:
    """The next command after an ambiguous or explained gap, or with what settles a doubt about the recordings."""
    from armlink.arm_file import bundled_arms
    from armlink.commands.plain_console import PlainConsole, command_line, suggest

    if answer.doubts:
        PlainConsole().print(f"next: repeat this command with {' and '.join(each.option for each in answer.doubts)}")
    elif answer.verdict == "ambiguous":
        arm = sim if sim in bundled_arms() or sim.endswith((".yaml", ".yml")) else "ARM.yaml"
        kept = json is not None and str(json) != "-"
        plan = command_line("gap", "plan", arm, answer=json if kept else "gap.json", out="motion.csv")
        suggest(plan if kept else f"repeat this command with --json gap.json, then run {plan}")
    elif answer.verdict == "explained" and out_model is None:
        PlainConsole().print(
            "next: repeat this command with --out-model corrected.xml, which writes the corrected model"
        )


def _progress(console: "Console", status: "Status", stage: str) -> None:
    """Show the stage: on a terminal in place, else as a line."""
    status.update(stage)
    if not console.is_terminal:
        console.print(stage)


def _write_actuators(answer: "Diagnosis", path: Path, step: float) -> None:
    from sim_gap.better_model.training_files import write_motor_entries
    from sim_gap.position_gap.training.position_files import write_actuators

    if answer.unit == "rad":
        write_actuators(answer.internals, path, step)
    else:
        write_motor_entries(answer.internals.model, answer.internals.estimate, path, step)


def _write_samples(answer: "Diagnosis", count: int, path: Path | None, console: "Console") -> None:
    from sim_gap.better_model.training_files import drawn_parameters, write_rows
    from sim_gap.position_gap.training.position_files import write_samples

    target = path or Path("samples.csv")
    if answer.unit == "rad":
        write_samples(answer.internals, count, target)
    elif not answer.internals.estimate.terms:
        console.print("no samples were written, since there is no gap that parameters could explain", style="yellow")
        return
    else:
        write_rows(drawn_parameters(answer.internals.estimate, answer.names, count), target)
    console.print(f"{count} samples of all parameters were written to {target}")


def _write_model(answer: "Diagnosis", path: Path, console: "Console") -> None:
    from sim_gap.attribution.residual_laws import as_effects
    from sim_gap.better_model.export import module_path, write_model
    from sim_gap.position_gap.training.position_files import batch_path, module_model, write_exported

    made, positions, kind = answer.internals, answer.unit == "rad", "URDF" if path.suffix == ".urdf" else "MJCF"
    if positions:
        left_out, model = write_exported(made, path), module_model(path)
    else:
        left_out, model = write_model(made.model, made.estimate, path, as_effects(answer.laws, answer.names)), path
    console.print(f"corrected model: {path}")
    for line in left_out:
        console.print(f"not in {kind}: {line}", style="yellow")
    if positions and batch_path(path).is_file():
        console.print(f"the same model without PID actuators, for MuJoCo Warp: {batch_path(path)}")
    if left_out and module_path(path).is_file() and model.is_file() and not (positions and kind == "URDF"):
        console.print(f"in a simulation of {model}, {module_path(path)} applies the effects that MJCF cannot represent")


def show(answer: "Diagnosis", console: "Console") -> None:
    from rich.table import Column

    from sim_gap.report.effect_text import parameter_rows, rivals_of

    rows = []
    for cause in answer.causes:
        joints = f"all {len(answer.names)}" if cause.joints == answer.names else ", ".join(cause.joints)
        numbers = f"{cause.gap_before:.3g}", f"{cause.gap_after:.3g}", f"{cause.confidence:.2f}"
        rows.append((cause.effect, joints, *numbers, rivals_of(cause, ", ")))
    if rows:
        of_cause = Column("effect", no_wrap=True), "joints", "RMS before", "after", "confidence", "confounded with"
        print_table(console, of_cause, rows, "causes, on held-out data")
        effect, interval = (Column(name, no_wrap=True) for name in ("effect", "95 % interval"))
        of_parameter = effect, "joint", "parameter", "value", interval, "unit"
        parameters = (row for cause in answer.causes for row in parameter_rows(cause))
        print_table(console, of_parameter, parameters, "their parameters")
    values = zip(answer.noise_floor, answer.heldout_before, answer.heldout_after, strict=True)
    gaps = ((name, *(f"{x:.3g}" for x in each)) for name, each in zip(answer.names, values, strict=True))
    title = f"gap on {answer.heldout_is}, RMS in {answer.unit}"
    print_table(console, ("joint", "noise floor", "before", "after"), gaps, title)
    for note in answer.notes:
        console.print(note, style="yellow")


def print_table(
    console: "Console", header: "Sequence[str | Column]", rows: Iterable[Sequence[str]], title: str | None = None
) -> None:
    from rich.table import Table

    table = Table(*header, title=title)
    for row in rows:
        table.add_row(*row)
    console.print(table)
