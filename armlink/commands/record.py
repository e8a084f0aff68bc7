"""Records an arm's joints and their commands, raw frames too, while its host runs it; sends nothing."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import Arm, Json, LeRobot, OtherBus, Ros2

SUFFIX = ".mcap"


def record(
    arm: Arm,
    out: Annotated[
        Path | None,
        typer.Argument(help="File to write (.mcap); convert makes other formats from this file.", show_default=False),
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Write every frame unchanged to this file: .asc, .blf or .log.")
    ] = None,
    bus: OtherBus = None,
    ros2: Ros2 = None,
    lerobot: LeRobot = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to record [s]; 0: until Ctrl-C or SIGTERM.")] = 0.0,
    json: Json = None,
) -> int:
    """Record to MCAP, which opens in Foxglove, PlotJuggler and ROS 2; a kill loses at most the last second.

    Raw frames (--frames) are written by the loggers of python-can: Vector ASC, BLF, or the log of candump. Their times
    are the time stamps of the interface, to the microsecond, and armlink replay makes the same samples from the log,
    bit for bit. Ctrl-C ends the recording properly (exit status 0). Exit status 3 if no SYNC was heard.

    Example: armlink record sarcos run.mcap --frames run.blf --bus socketcan:vcan0 --seconds 60
    """
    import contextlib

    from armlink.arm_file import load_arm
    from armlink.bus.frame_log import FrameLog
    from armlink.bus.listening.joint_messages import silence_of
    from armlink.bus.open import open_link_bus
    from armlink.bus.taps import TappedBus
    from armlink.commands.options import stated_bus
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.content.atomic_file import writing
    from armlink.errors import BadInput, BusFault
    from armlink.extras import require_extra
    from armlink.recording.files import SUFFIXES
    from armlink.recording.recorder import Recorder

    arm_file = load_arm(arm)
    if (file := out or frames) is None:
        raise BadInput("record: nothing to write: give a .mcap file, or `--frames` with a .asc, .blf or .log file")
    if out is not None and out.suffix != SUFFIX:
        first = out.with_suffix(SUFFIX)
        then = f", then run `armlink convert {first} {out}`" if out.name.endswith(SUFFIXES) else ""
        raise BadInput(f"{out}: record writes {SUFFIX} files: give {first}{then}")
    if out is not None:
        require_extra(str(out), "bags")
        from armlink.recording.mcap import RecordingWriter
    rows, last = 0, 0.0
    with contextlib.ExitStack() as stack:
        log = stack.enter_context(FrameLog(frames)) if frames else None
        opened = open_link_bus(stated_bus(bus, ros2, lerobot), arm_file.require_link())
        stack.callback(opened.shutdown)
        recorder = Recorder(arm_file, TappedBus(opened, log.write) if log else opened)
        with writing(file), contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as files:
            writer = files.enter_context(RecordingWriter(out, recorder.names)) if out else None
            for t, channels in recorder.rows(seconds or float("inf")):
                if writer:
                    writer.append(t, channels)
                rows, last = rows + 1, t
    if not rows:
        if out:
            out.unlink(missing_ok=True)
        why = silence_of(opened, f"no SYNC was heard: is a host running {arm_file.name}?")
        raise BusFault(f"{opened.channel_info}: {why}")
    written = " and ".join(str(path) for path in (out, frames) if path)
    results(json).print(f"{written}: {rows} rows, {last:.1f} s")
    answer = {"file": out and str(out), "frames": frames and str(frames), "rows": rows, "seconds": last}
    write_json(json, {**answer, "joints": list(recorder.names)})
    return 0
