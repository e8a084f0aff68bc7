"""Tells torque and force that the surroundings exert on an arm, with bounds, and contacts as events."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import LeRobot, OtherBus, Ros2, reads_recordings
from armlink.commands.output import write_json
from armlink.errors import BadInput
from calib.commands.options import ArmOrModel, ChainBase, ChainTip, JsonFile, Store, Tool

if TYPE_CHECKING:
    from armlink.recording.corrections import Corrections
    from armlink.recording.recording import Recording
    from calib.external.arm_model import ArmRecords
    from calib.external.listening import Heard, WrenchFrame
    from gcomp.arrays import Array


@reads_recordings
def external(
    arm: ArmOrModel,
    stated: "Corrections",
    recordings: Annotated[
        list[str] | None, typer.Argument(help="Recordings to examine; without any, listen to the arm.")
    ] = None,
    baseline: Annotated[
        list[str] | None,
        typer.Option(help="Recording of the arm's own work without contact, to learn from; may be repeated."),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            metavar="JOINT[,X,Y,Z]",
            help="Reference point of the wrench [m], in the frame that turns with this joint. By default the centre "
            "of the tool, or of the last link.",
        ),
    ] = None,
    false_alarms: Annotated[str, typer.Option(help="Allowed rate of false alarms: 1/h, 2/d.")] = "1/h",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write torques, bounds and wrench over time: .csv, .mcap for ROS 2, or .parquet with LeRobot's keys."
        ),
    ] = None,
    learned: Annotated[
        Path | None,
        typer.Option(
            help="Write what is learned from --baseline to this file (.npz); without --baseline, read this file. "
            "The daemon reads external.npz in its state directory."
        ),
    ] = None,
    bus: OtherBus = None,
    ros2: Ros2 = None,
    lerobot: LeRobot = None,
    foxglove: Annotated[
        int | None,
        typer.Option(min=0, max=65535, metavar="PORT", help="While listening, serve to Foxglove; 0: a free port."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to listen [s]; 0: until Ctrl-C or SIGTERM.")] = 0.0,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the smallest detectable force over the workspace (SVG).")
    ] = None,
    base: ChainBase = None,
    tip: ChainTip = None,
    tool: Tool = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Estimate the torque that arm, tool and friction do not explain, with 95 % bounds, and report contacts.

    Without recordings, listen until Ctrl-C to an arm that another program runs, and send nothing; with --json, write a
    line for each row and event. Exit status 3 if nothing is heard. Without --baseline or --learned, the bounds of
    recordings come from the arm's records alone.

    Example: armlink external arm.yaml run.mcap --baseline free.mcap
    """
    import numpy as np

    from armlink.commands.options import stated_bus
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.recording.files import load_recordings
    from calib.external.arm_model import SHORTEST, listener_of
    from calib.external.listening import Learned, listen, load_learned, save_learned
    from calib.external.tables import answer_of, draw_map, require_writable, save_heard, smallest_forces
    from calib.fit.recorded_rows import in_joint_order

    source = stated_bus(bus, ros2, lerobot)
    listens = not recordings and picture is None and (source is not None or not (learned and baseline))
    if source is not None and not listens:
        raise BadInput(
            f"external: {source} and {recordings[0] if recordings else picture}: give recordings or a live source"
        )
    if not listens and (foxglove is not None or seconds):
        raise BadInput("external: --foxglove and --seconds are for listening: leave the recordings out")
    if listens and not (learned or baseline):
        raise BadInput(
            "external: give recordings, or --picture FILE.svg for a map of the smallest detectable force; to listen "
            "to the arm, give --learned FILE or --baseline RECORDING"
        )
    if out is not None:
        require_writable(out)
        if not recordings:
            raise BadInput(f"--out {out}: this option needs recordings")
    per_hour = parse_rate(false_alarms)
    records = _records(arm, base, tip, tool, store)
    names = records.stated.arm.names

    def loaded(paths: list[str] | None) -> "dict[str, Recording]":
        every = {
            label: each for path in paths or [] for label, each in load_recordings(path, stated, efforts=True).items()
        }
        return {label: in_joint_order(each, names, label) for label, each in every.items()}

    console, answers = results(json_file), list[dict[str, Any]]()
    judged, free = loaded(recordings), list(loaded(baseline).values())
    place = parse_frame(frame, records)
    if learned is not None and not free:
        listener = load_learned(learned, records).listener
    else:
        with PlainConsole().status("learning what the arm does without contact"):
            listener = listener_of(records, free, list(judged.values()))
        if free and not listener.model.seconds:
            raise BadInput(f"--baseline: no recording has {SHORTEST:g} s without missing rows: record for longer")
        if learned is not None:
            save_learned(learned, Learned(listener, place, per_hour))
            console.print(f"{learned} is written: it holds {listener.model.seconds:.0f} s of work without contact")
    if listens:
        from calib.commands.external_live import follow

        if records.stated.arm_file is None:
            raise BadInput(f"{arm}: listening needs an arm file, which `armlink new` makes")
        follow(records.stated.arm_file, source, Learned(listener, place, per_hour), seconds, json_file, foxglove)
        return
    every: list[tuple[str, Array, list[Heard]]] = []
    if not free and learned is None:
        recorded = records.gravity is not None or records.calibration is not None
        PlainConsole().print(
            f"the bounds follow from the {'records' if recorded else 'model'} alone, and were not checked on work of "
            "the arm: give recordings without contact as --baseline",
            style="yellow",
        )
    for label, recording in judged.items():
        heard = list(listen(listener, recording, place, per_hour))
        if not heard:
            raise BadInput(f"{label}: it has no {SHORTEST:g} s without missing rows: record for longer")
        every.append((label, recording.t, heard))
        answers.append(answer_of(label, heard, names))
        _tell(console, answers[-1], names)
    if picture is not None:
        places, force = smallest_forces(listener.model, place, per_hour)
        draw_map(picture, places, force, f"{arm}: force at {names[place.link]} that is found in 95 % of cases, at rest")
        console.print(f"{picture}: half of the workspace needs {np.median(force):.1f} N or less")
    if out is not None:
        save_heard(out, every, names)
        console.print(f"{out} is written")
    described = Learned(listener, place, per_hour).described()
    write_json(json_file, {"schema": "armlink.external/1", **described, "recordings": answers})


def parse_rate(text: str) -> float:
    """Events an hour of `1/h` or `2/d`; raises BadInput."""
    number, _, unit = text.partition("/")
    hours = {"h": 1.0, "d": 24.0, "min": 1.0 / 60.0}
    try:
        rate = float(number) / hours[unit]
    except (ValueError, KeyError):
        rate = float("nan")
    if not 0.0 < rate <= 600.0:
        raise BadInput(f"--false-alarms {text}: expected a rate such as 1/h or 2/d, at most 10/min")
    return rate


def parse_frame(text: str | None, records: "ArmRecords") -> "WrenchFrame":
    """The frame of an option `--frame`; raises BadInput."""
    import numpy as np

    from calib.external.listening import WrenchFrame

    arm, file = records.stated.arm, records.stated.arm_file
    if text is None:
        if file is not None and file.tool is not None:
            return WrenchFrame(arm.n - 1, np.array(file.tool.centre))
        last = records.links[-1]
        return WrenchFrame(arm.n - 1, last[1:4] / last[0] if last[0] > 0.0 else np.zeros(3))
    name, *numbers = text.split(",")
    try:
        point = np.array([float(each) for each in numbers])
    except ValueError:
        point = np.empty(1)
    if name not in arm.names or len(point) not in (0, 3) or not np.isfinite(point).all():
        known = ", ".join(arm.names)
        raise BadInput(f"--frame {text}: expected JOINT or JOINT,X,Y,Z with one of the joints {known}")
    return WrenchFrame(arm.names.index(name), point if len(point) else np.zeros(3))


def _records(arm: str, base: str | None, tip: str | None, tool: str | None, store: str | None) -> "ArmRecords":
    from calib.arm.kinematics import stated_model
    from calib.external.arm_model import ArmRecords
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.records.store import RecordStore

    stated = stated_model(arm, base, tip, tool)
    if stated.arm_file is None:
        return ArmRecords(stated)
    kept = RecordStore(store)
    gravity = kept.current(GravityRecord, stated.arm_file)
    return ArmRecords(
        stated,
        kept.current(CalibrationRecord, stated.arm_file),
        None if gravity is None else gravity.carrying(stated.arm_file),
    )


def _tell(console: Any, answer: dict[str, Any], names: tuple[str, ...]) -> None:
    from rich.table import Table

    from calib.external.tables import event_text

    table = Table(
        "joint", "external torque, RMS [N·m]", "95 % bound ± [N·m]", "at rest ± [N·m]", title=answer["recording"]
    )
    for name, rms, bound, rest in zip(names, answer["rms"], answer["bound"], answer["bound_at_rest"], strict=True):
        table.add_row(name, *("–" if x is None else f"{x:.3g}" for x in (rms, bound, rest)))
    console.print(table)
    best, worst = ("not determined" if force is None else f"{force:.1f} N" for force in answer["smallest_force"])
    console.print(
        f"{answer['seconds']:.1f} s judged. Smallest force at the frame, found in 95 % of cases: {best} along the best "
        f"direction, {worst} along the worst"
    )
    for event in answer["events"]:
        console.print(f"{event['t']:9.2f} s  {event_text(event)}")
    if not answer["events"]:
        console.print("no contact")
