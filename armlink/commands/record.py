"""Records an arm's joints and their commands while its host runs it; sends nothing."""

from pathlib import Path
from typing import Annotated

import typer

SUFFIX = ".mcap"


def record(
    arm: Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")],
    out: Annotated[Path, typer.Argument(help="File to write, .mcap; armlink convert makes others of it.")],
    bus: Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="Length; 0: until Ctrl-C or SIGTERM.")] = 0.0,
    json: Annotated[Path | None, typer.Option(help="Write what was recorded here; - is standard output.")] = None,
) -> int:
    """Record to MCAP, which opens in Foxglove, PlotJuggler and ROS 2; a kill loses at most the last second.

    Ctrl-C ends the recording properly (exit status 0). Exit status 3 where no SYNC was heard.

    Example: armlink record sarcos run.mcap --bus socketcan:vcan0 --seconds 60
    """
    import contextlib

    from rich.console import Console

    from armlink.armfile import load_arm
    from armlink.bus import open_bus
    from armlink.commands.output import write_json
    from armlink.errors import BadInput, BusFault
    from armlink.recorder import Recorder
    from armlink.recording_mcap import RecordingWriter

    arm_file = load_arm(arm)
    if out.suffix != SUFFIX:
        raise BadInput(f"{out}: recordings are written as {SUFFIX}; armlink convert makes other formats of it")
    opened = open_bus(bus, arm_file.require_link().bus)
    rows, last = 0, 0.0
    try:
        recorder = Recorder(arm_file, opened)
        with contextlib.suppress(KeyboardInterrupt), RecordingWriter(out, recorder.names) as writer:
            for t, channels in recorder.rows(seconds or float("inf")):
                writer.append(t, channels)
                rows, last = rows + 1, t
    except OSError as error:
        raise BadInput(f"{out}: cannot write it: {error.strerror}") from None
    finally:
        opened.shutdown()
    if not rows:
        out.unlink(missing_ok=True)
        raise BusFault(f"{opened.channel_info}: no SYNC was heard: does a host run {arm_file.name}?")
    Console(stderr=True).print(f"{out}: {rows} rows, {last:.1f} s", markup=False)
    write_json(json, {"file": str(out), "rows": rows, "seconds": last, "joints": list(recorder.names)})
    return 0
