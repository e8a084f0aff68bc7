"""Calibration and gravity records kept for an arm, and which were current when."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer


def history(
    arm: Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")],
    store: Annotated[
        str | None, typer.Option(help="Record store: file or database URL; default: state folder.")
    ] = None,
    record: Annotated[str | None, typer.Option(help="Show this record alone, as YAML on standard output.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the answer here; - is standard output.")
    ] = None,
) -> None:
    """List the records of an arm, oldest first, and the log of which was current when.

    Example: armlink history sarcos --json -
    """
    from armlink.armfile import load_arm
    from calib.store import RecordStore

    arm_file, records = load_arm(arm), RecordStore(store)
    if record is not None:
        typer.echo(records.get(record).require(arm_file).to_yaml(), nl=False)
        return
    log = records.activations(arm_file)
    current = {line.kind: line.record for line in log}
    rows = [
        {
            "id": kept.id,
            "kind": kept.kind,
            "created": kept.created.isoformat(),
            "software": kept.software,
            "parent": kept.parent,
            "confirmed_by": kept.confirmed_by,
            "current": current.get(kept.kind) == kept.id,
            "description_hash": kept.description_hash,
            "note": kept.note,
        }
        for kept in records.history(arm_file)
    ]
    _print(f"{arm_file.name} {arm_file.serial} in {records.url}", rows)
    if json_file is not None:
        answer = {"arm": arm_file.name, "serial": arm_file.serial, "records": rows}
        answer["activations"] = [vars(line) for line in log]
        text = json.dumps(answer, indent=1, ensure_ascii=False) + "\n"
        if str(json_file) == "-":
            typer.echo(text, nl=False)
        else:
            json_file.write_text(text, encoding="utf-8")


def _print(title: str, rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "record", "kind", "created", "replaces", "confirmed by", "note", title=title)
    for row in rows:
        shown = (row["id"], row["kind"], row["created"], row["parent"] or "", row["confirmed_by"] or "", row["note"])
        table.add_row("current" if row["current"] else "", *shown)
    Console(stderr=True).print(table if rows else f"{title}: no records yet")
