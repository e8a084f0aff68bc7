"""Compares two records: per joint, in units and in standard deviations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.commands.options import JsonFile, Store

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.records.compare import ParameterChange
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.records.store import RecordStore

STRIKING = 3.0
"""Changes of at least this many standard deviations are set in bold: by chance once in 370."""


def diff(
    before: Annotated[str, typer.Argument(metavar="A", help="Record A: its id, or its YAML file.")],
    after: Annotated[
        str, typer.Argument(metavar="B", help="Record B, which is compared with A: its id, or its YAML file.")
    ],
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Compare two calibration or two gravity records of one arm.

    Example: armlink diff 1f0c9a2b 77e01d3c --json -
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from calib.records.compare import differences
    from calib.records.store import RecordStore

    records = RecordStore(store)
    old, new = (_record(records, each) for each in (before, after))
    changes = differences(old, new)
    _show(old, new, changes, results(json_file))
    rows = [{**vars(each), "change": each.change, "deviations": each.deviations} for each in changes]
    sides = {
        side: {"id": each.id, "created": each.created.isoformat(), "sources": each.sources, "software": each.software}
        for side, each in (("before", old), ("after", new))
    }
    write_json(json_file, {"schema": "armlink.diff/1", "kind": old.kind, **sides, "changes": rows})


def _record(records: "RecordStore", given: str) -> "CalibrationRecord | GravityRecord":
    """A record by its id or from a YAML file, of any arm."""
    from calib.records.store import load_yaml

    return load_yaml(Path(given)) if given.endswith((".yaml", ".yml")) else records.get(given)


def _show(
    old: "CalibrationRecord | GravityRecord",
    new: "CalibrationRecord | GravityRecord",
    changes: "list[ParameterChange]",
    console: "PlainConsole",
) -> None:
    from rich.table import Table

    when = [f"{each.id} of {each.created:%Y-%m-%d %H:%M}" for each in (old, new)]
    title = f"{old.arm} {old.serial}: {old.kind} {' → '.join(when)}"
    table = Table("joint", "parameter", "unit", old.id, new.id, "change", "in std", title=title)
    count = 0
    for each in changes:
        if each.before is None and each.after is None:
            continue
        striking = each.deviations is not None and abs(each.deviations) >= STRIKING
        row = (each.joint, each.parameter.replace("_", " "), each.unit, *each.texts)
        table.add_row(*row, style="bold" if striking else None)
        count += striking
    console.print(table)
    console.print(f"{count} of {table.row_count} values changed by at least {STRIKING:g} standard deviations")
