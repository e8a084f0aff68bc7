"""Lists the records kept for an arm, and which were current when, by whom and why."""

import getpass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm
from calib.commands.options import JsonFile, Store

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.records.store import Activation, ControllerWrite


def history(
    arm: Arm,
    store: Store = None,
    record: Annotated[str | None, typer.Option(help="Print only this record, as YAML.")] = None,
    import_file: Annotated[
        Path | None, typer.Option("--import", help="Add the record in this YAML file before listing.")
    ] = None,
    activate: Annotated[
        bool, typer.Option("--activate", help="With --import: also make the added record current.")
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """List the records of an arm (oldest first), and which records became current or were written to drives.

    Example: armlink history sarcos --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.output import write_json, write_out
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.errors import BadInput
    from calib.records.store import RecordStore

    arm_file, records = load_arm(arm), RecordStore(store)
    if activate and import_file is None:
        raise BadInput(f"--activate works only with --import FILE; `armlink history {arm}` lists the stored records")
    if import_file is not None:
        imported = records.import_yaml(import_file, arm_file)
        if activate:
            records.activate(imported, arm_file, by=getpass.getuser(), reason=f"imported from {import_file.name}")
    if record is not None:
        write_out(records.get(record).require(arm_file).to_yaml())
        return
    log, writes = records.activations(arm_file), records.writes(arm_file)
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
            "sources": kept.sources,
            "note": kept.note,
        }
        for kept in records.history(arm_file)
    ]
    serial = "without a serial number" if arm_file.serial == "unknown" else arm_file.serial
    title = f"{arm_file.name} {serial} in {records.url}"
    _print(title, rows, log, writes, results(json_file))
    if not rows:
        suggest(command_line("sweep", arm, "--plan"))
    answer = {"arm": arm_file.name, "serial": arm_file.serial, "records": rows}
    answer["activations"] = [vars(line) for line in log]
    answer["controller_writes"] = [vars(line) for line in writes]
    write_json(json_file, answer)


def _print(
    title: str,
    rows: list[dict[str, Any]],
    log: "list[Activation]",
    writes: "list[ControllerWrite]",
    console: "PlainConsole",
) -> None:
    from rich.table import Table

    if not rows:
        console.print(f"{title}: there are no records yet")
        return
    table = Table("record", "", "kind", "created", "replaces", "confirmed by", "note", title=title)
    for row in rows:
        created = row["created"][:19] + row["created"][-6:]  # whole seconds
        shown = (row["kind"], created, row["parent"] or "", row["confirmed_by"] or "", row["note"])
        table.add_row(row["id"], "current" if row["current"] else "", *shown)
    console.print(table)
    lines = Table("when", "what", "record", "by", "why", title="Current records and controller writes")
    happened = [(line.at, f"{line.kind} current", line.record, line.by, line.reason) for line in log]
    happened += [
        (line.at, f"controllers: {line.stage}", line.record, line.by, str(line.body.get("reason", "")))
        for line in writes
    ]
    for event in sorted(happened, key=lambda each: each[0]):
        lines.add_row(*event)
    if happened:
        console.print(lines)
    current = [f"{row['kind']} record {row['id']}" for row in rows if row["current"]]
    console.print(f"current: {', '.join(current) or 'none'}")
