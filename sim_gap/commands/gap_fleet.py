"""Diagnoses the recordings of a fleet on a cluster of workers, and those of one arm in turn."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from statistics import median_high
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Json, reads_recordings
from armlink.commands.output import write_json
from sim_gap.commands.gap_diagnose import Base, KnownGain, Tip, print_table

if TYPE_CHECKING:
    from armlink.recording.corrections import Corrections
    from sim_gap.fleet import Answers, CaseOptions


@reads_recordings
def diagnose_fleet(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="Folder of cases (folders with a model, train*, heldout* recordings) or, with --sim, of recordings.",
        ),
    ],
    stated: "Corrections",
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a dask scheduler; by default workers run on this machine.")
    ] = None,
    sim: Annotated[Path | None, typer.Option(help="Nominal model for cases without a model of their own.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Number of workers on this machine.")] = 2,
    out: Annotated[
        Path | None,
        typer.Option(help="File of results, one JSON line each; cases that are already in this file are not repeated."),
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="Also write a table, one row per case and effect (.parquet).")
    ] = None,
    json: Json = None,
    base: Base = None,
    tip: Tip = None,
    gains: KnownGain = "",
) -> int:
    """Run the diagnosis on every case of a fleet; exit status 1 if a case could not be diagnosed.

    Example: armlink gap diagnose-fleet fleet/ --out answers.jsonl --table causes.parquet --scheduler tcp://127.0.0.1:8786
    """
    from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

    from armlink.commands.plain_console import PlainConsole, results
    from armlink.extras import require_extra
    from sim_gap import fleet
    from sim_gap.better_model.training_files import write_parquet
    from sim_gap.trends import fleet_outliers, fleet_trends

    require_extra("diagnose-fleet", "cluster")
    if table is not None:
        require_extra("--table", "parquet")
    options = fleet.CaseOptions(stated, gains, base, tip)
    cases = fleet.find_cases(folder, sim)
    answers, console = _open_answers(out or folder / "answers.jsonl", options), PlainConsole()
    left = [case for case in cases if case.name not in answers.found]
    if len(left) < len(cases):
        console.print(f"{answers.path}: {len(cases) - len(left)} of {len(cases)} cases are done already")
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    if left and (warning := fleet.open_to_all(scheduler)):
        console.print(warning, style="yellow")
    if left:
        with fleet.cluster(scheduler, min(workers, len(left))) as client, Progress(*columns, console=console) as bars:
            task = bars.add_task("diagnosing", total=len(left))
            for name, answer in fleet.diagnose_fleet(left, client, options):
                answers.add(name, answer)
                bars.advance(task)
    found = {case.name: answers.found[case.name] for case in cases}
    rows, out_console = fleet.table(found), results(json)
    _show(rows, out_console)
    trends, outliers = ([asdict(each) for each in every] for every in (fleet_trends(found), fleet_outliers(found)))
    show_changes(trends, outliers, out_console)
    failed = sum("error" in answer for answer in found.values())
    out_console.print(f"{len(found) - failed} of {len(found)} cases are diagnosed: {answers.path}")
    if table is not None:
        write_parquet(rows, table)
    write_json(json, {"schema": "armlink.gap-fleet/1", "answers": found, "trends": trends, "outliers": outliers})
    return int(any("error" in answer for answer in found.values()))


def _show(rows: list[dict[str, Any]], console: Any) -> None:
    cases = {row["case"]: row["verdict"] for row in rows}
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in sorted(Counter(cases.values()).items()))
    shown, effects = [], Counter(sorted(row["effect"] for row in rows if row["effect"]))
    for effect, _ in effects.most_common():
        own = [row for row in rows if row["effect"] == effect]
        counts = (str(len({row[key] for row in own})) for key in ("arm", "case"))
        shown.append((effect, *counts, f"{median_high(row['shrink'] or 0.0 for row in own):.2f}"))
    print_table(console, ("effect", "arms", "cases", "median shrink"), shown, f"{len(cases)} cases: {verdicts}")
    for row in rows:
        if row["error"]:
            console.print(f"{row['case']}: {row['error']}", style="yellow")


def show_changes(trends: list[dict[str, Any]], outliers: list[dict[str, Any]], console: Any) -> None:
    if trends:
        header = ("arm", "effect", "joint", "parameter", "before", "now", "since", "noticed")
        texts = [x | {"before": f"{x['before']:.3g}", "now": f"{x['now']:.3g} {x['unit']}"} for x in trends]
        print_table(console, header, [[each[name] for name in header] for each in texts], "what changes")
    for one in outliers:
        console.print(
            f"{one['arm']}: {one['effect']} of {one['joint']}: {one['parameter']} is {one['value']:.3g} "
            f"{one['unit']}, but {one['others']:.3g} on the other arms"
        )


@reads_recordings
def trend(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of recordings, with dates in their names.")],
    sim: Annotated[Path, typer.Option(help="Nominal model: MJCF, URDF or arm file.")],
    stated: "Corrections",
    out: Annotated[
        Path | None,
        typer.Option(
            help="File of answers, one JSON line each; recordings that are already in this file are not repeated."
        ),
    ] = None,
    json: Json = None,
    base: Base = None,
    tip: Tip = None,
    gains: KnownGain = "",
) -> int:
    """Diagnose the new recordings of an arm, and show what changes; exit status 1 if the newest one cannot be used.

    A recording that was diagnosed may be deleted, since its answer is stored.

    Example: armlink gap trend recordings/ --sim arm.yaml
    """
    from armlink.commands.plain_console import results
    from sim_gap import fleet
    from sim_gap.model.load import load_compiled
    from sim_gap.trends import UNDATED, date_of, fleet_trends, needed_recordings

    load_compiled(sim)  # what is wrong with it is no answer of a recording
    console = results(json)
    options = fleet.CaseOptions(stated, gains, base, tip)
    answers = _open_answers(out or folder / "answers.jsonl", options)
    newest = ""
    for case in sorted(fleet.find_cases(folder, sim), key=lambda case: (date_of(case.name) or UNDATED, case.name)):
        newest = f"{folder.resolve().name}/{case.name}"
        if newest not in answers.found:
            answers.add(newest, fleet.diagnose_case(case, options))
        answer = answers.found[newest]
        console.print(f"{case.name}: {answer.get('verdict') or answer['error']}")
    trends = [asdict(each) for each in fleet_trends(answers.found)]
    show_changes(trends, [], console)
    changes = f"{len(trends)} parameters change" if trends else "no parameter changes"
    console.print(f"{_count(len(answers.found), 'recording')}: {needed_recordings(answers.found) or changes}")
    newest_answer = answers.found[newest]
    shown = {"case": newest.partition("/")[2], "answer": newest_answer}
    write_json(json, {"schema": "armlink.gap-trend/1", "newest": shown, "trends": trends})
    return int("error" in newest_answer)


def _open_answers(path: Path, options: "CaseOptions") -> "Answers":
    """The answers in a file; those that were made with other options are told."""
    from armlink.commands.plain_console import PlainConsole
    from sim_gap.fleet import Answers

    answers = Answers(path, options)
    if number := answers.of_other_options:
        made = f"{_count(number, 'answer')} {'was' if number == 1 else 'were'} made with other options"
        PlainConsole().print(f"{path}: {made}; they stay in the file, but are not used")
    return answers


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
