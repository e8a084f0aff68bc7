"""Diagnoses the recordings of one arm in turn, and tells which parameter changes over them."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

UNDATED = datetime.min.replace(tzinfo=UTC)


def trend(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of recordings, with dates in their names.")],
    sim: Annotated[Path, typer.Option(help="Nominal model: MJCF, URDF or arm file.")],
    out: Annotated[
        Path | None, typer.Option(help="Answers, one JSON line each; recordings already in it are not repeated.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write newest answer and changes here; - is standard output.")
    ] = None,
) -> int:
    """Diagnose an arm's recordings that are new, and show what changes; exit status 1 if the newest cannot be used.

    A recording that was diagnosed may be deleted: its answer is kept.

    Example: armlink gap trend recordings/ --sim arm.yaml
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from sim_gap.commands.gap_fleet import show_changes
    from sim_gap.fleet.fleet import Answers, diagnose_case, find_cases
    from sim_gap.fleet.trends import date_of, fleet_trends, rows
    from sim_gap.model.load import load_compiled

    load_compiled(sim)  # what is wrong with it is no answer of a recording
    console = results(json_file)
    answers = Answers(out or folder / "answers.jsonl")
    newest = ""
    for case in sorted(find_cases(folder, sim), key=lambda case: (date_of(case.name) or UNDATED, case.name)):
        newest = f"{folder.resolve().name}/{case.name}"
        if newest not in answers.found:
            answers.add(newest, diagnose_case(case))
        answer = answers.found[newest]
        console.print(f"{case.name}: {answer.get('verdict') or answer['error']}")
    trends = rows(fleet_trends(answers.found))
    show_changes(trends, [], console)
    changes = f"{len(trends)} parameters change" if trends else "no parameter changes"
    console.print(f"{len(answers.found)} recordings: {changes}")
    newest_answer = answers.found[newest]
    shown = {"case": newest.partition("/")[2], "answer": newest_answer}
    write_json(json_file, {"schema": "armlink.gap-trend/1", "newest": shown, "trends": trends})
    return int("error" in newest_answer)
