"""Replays a raw frame log or a recording: as a live table, into another recording, or onto a virtual bus."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import Arm, Json


def replay(
    arm: Arm,
    source: Annotated[
        Path, typer.Argument(help="Raw frames (.asc, .blf, .log) or a recording (.mcap, .parquet, .csv, .csv.gz).")
    ],
    target: Annotated[
        Path | None, typer.Argument(help="Recording to write; its suffix gives the format.", show_default=False)
    ] = None,
    bus: Annotated[
        str | None,
        typer.Option(help="Send the frames to this bus instead: virtual:…, udp_multicast:… or socketcan:vcan…."),
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Speed relative to the recording; 0: as fast as possible.")
    ] = 1.0,
    json: Json = None,
) -> int:
    """Decode a raw log or a recording again; with neither TARGET nor --bus, show it as a live table at --speed.

    A raw log goes through the same decoding as live frames: its samples are those that armlink record --frames wrote,
    bit for bit. A log that was cut off is read up to its end, with a warning. With --bus, only the frames of the joints
    and SYNC are sent, never a command, an SDO or NMT, and only to a virtual bus: for a listener such as armlink daemon
    --listen-only or armlink monitor. Nothing is ever replayed as torque or motion.

    Example: armlink replay sarcos run.blf run.csv
    """
    from armlink.arm_file import load_arm
    from armlink.bus.frame_log import is_log
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.content.atomic_file import writing
    from armlink.errors import BadInput
    from armlink.recording.files import load_recording, save_recording
    from armlink.recording.replay import play_onto, recording_of_log, show

    arm_file = load_arm(arm)
    if bus is not None and target is not None:
        raise BadInput("replay: give a file to write or `--bus`, not both")
    recording = recording_of_log(arm_file, source) if is_log(source) else load_recording(source)
    if recording.warning:
        PlainConsole().print(f"{source}: {recording.warning}", style="yellow")
    out = results(json)
    if bus is not None:
        sent = play_onto(arm_file, source, recording, bus, speed)
        out.print(f"{source}: {sent} frames sent to {bus}")
    elif target is not None:
        with writing(target):
            save_recording(recording, target)
        out.print(f"{target}: {recording.t.size} rows")
    else:
        show(recording, out, speed)
        out.print(f"{source}: {recording.t.size} rows")
    counts = {"rows": int(recording.t.size), "seconds": float(recording.t[-1] - recording.t[0])}
    content = {"joints": list(recording.names), "channels": list(recording.channels())}
    write_json(json, {**counts, **content, "warning": recording.warning})
    return 0
