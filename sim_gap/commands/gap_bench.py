"""Tests the diagnosis on sealed cases of simulated arms."""

from pathlib import Path
from typing import Annotated, Any

import typer

from armlink.commands.options import Json


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
        Path | None, _other("YAML file with the known effects of these arms; by default of the published arms.")
    ] = None,
    json: Json = None,
    out: Annotated[Path | None, typer.Option(help="Store cases, answers and labels in this new folder.")] = None,
    workers: Annotated[int, typer.Option(help="Number of processes.")] = 2,
) -> None:
    """Make sealed cases, diagnose them with the true effect known and with it unknown, open the labels and score.

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
    from sim_gap.blind.tables import show, show_positions, show_real

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
