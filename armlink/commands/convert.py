"""Writes a recording in another format: CSV, gzipped CSV, Parquet or MCAP, by suffix."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armlink.commands.options import Json, reads_recordings

if TYPE_CHECKING:
    from armlink.recording.corrections import Corrections


@reads_recordings
def convert(
    source: Annotated[Path, typer.Argument(help="Recording: .csv, .csv.gz, .parquet or .mcap (bags of ROS too).")],
    target: Annotated[Path, typer.Argument(help="File to write; its suffix gives the format.")],
    stated: "Corrections",
    json: Json = None,
) -> int:
    """Convert a recording, with corrections if any; joint names are stored if the format has them (Parquet, MCAP).

    Example: armlink convert run.mcap run.csv.gz
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.content.atomic_file import writing
    from armlink.errors import BadInput
    from armlink.recording.files import keeps_names, load_recording, save_recording
    from armlink.recording.recording import default_names

    if stated.without_gravity:
        raise BadInput(
            "--effort-is without-gravity: convert has no model of the arm to add the gravity: convert "
            "without this option, and give the option to the diagnosis"
        )
    recording = load_recording(source, stated)
    with writing(target):
        save_recording(recording, target)
    if recording.warning:
        PlainConsole().print(f"{source}: {recording.warning}", style="yellow")
    rows, seconds = int(recording.t.size), float(recording.t[-1] - recording.t[0])
    channels = list(recording.channels())
    out = results(json)
    out.print(f"{target}: {rows} rows, {seconds:.1f} s, {recording.n} joints, {', '.join(channels)}")
    kept = recording.names if keeps_names(target) else default_names(recording.n)
    if kept != recording.names:
        renamed = ", ".join(f"{name} is called {other}" for name, other in zip(recording.names, kept, strict=True))
        out.print(
            f"this file format stores no joint names: in {target.name}, {renamed} (Parquet and MCAP store the names)",
            style="yellow",
        )
    answer = {"rows": rows, "seconds": seconds, "joints": list(recording.names), "channels": channels}
    write_json(json, {**answer, "warning": recording.warning})
    return 0
