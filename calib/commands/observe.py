"""Observes an arm that another program commands, or its recording: drifts, changes and payloads; sends nothing."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, LeRobot, OtherBus, Ros2
from armlink.commands.output import write_json
from armlink.errors import BadInput
from calib.commands.options import JsonFile, Store

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.arrays import Array

CHANGES = ("drift", "effect", "payload")
"""Kinds of event that name a change; others say that there may be one, or that it is gone."""


def observe(
    arm: Arm,
    recording: Annotated[
        Path | None,
        typer.Argument(help="A recording of the arm at work, instead of a live source.", show_default=False),
    ] = None,
    bus: OtherBus = None,
    ros2: Ros2 = None,
    lerobot: LeRobot = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to listen [s]; 0: until Ctrl-C or SIGTERM.")] = 0.0,
    store: Store = None,
    json_file: JsonFile = None,
) -> int:
    """Compare the torques of an arm at work with its calibration and gravity record; exit status 1 for a change.

    It listens like the daemon and only reports: nothing is written or proposed. Exit status 3 if nothing is heard.

    Example: armlink observe arm.yaml --ros2 /joint_states --seconds 600
    """
    from armlink.arm_file import load_arm
    from armlink.commands.options import stated_bus
    from armlink.commands.plain_console import PlainConsole, results
    from calib.arm.kinematics import gcomp_arm
    from calib.daemon.state.events import describe, one_alarm_a_joint
    from calib.observer.observer import observer_of
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.records.store import RecordStore

    arm_file, records = load_arm(arm), RecordStore(store)
    source = stated_bus(bus, ros2, lerobot)
    if recording is not None and source is not None:
        raise BadInput(f"observe: {recording} and {source}: give a recording or a live source, not both")
    calibration = records.required(CalibrationRecord, arm_file)
    gravity = records.required(GravityRecord, arm_file).carrying(arm_file)
    described = gcomp_arm(arm_file)
    observer = observer_of(described, calibration, gravity, arm_file.require_link().rated_torques)
    samples = recorded(arm_file, recording) if recording is not None else _heard(arm_file, source, seconds)
    console, told = PlainConsole(), list[dict[str, Any]]()
    rows, first, last = 0, 0.0, 0.0
    for t, position, torque in samples:
        first, last, rows = (t if not rows else first), t, rows + 1
        for event in one_alarm_a_joint(observer.handle(t, position, torque)):
            kind, text, _ = describe(event)
            console.print(f"{t - first:8.1f} s  {text}")
            told.append({"t": t - first, "kind": kind, "joint": event.joint, "text": text})
    found, out = observer.estimate(), results(json_file)
    changes = [each for each in told if each["kind"] in CHANGES]
    for each in changes:
        out.print(f"{each['t']:.1f} s: {each['text']}")
    out.print(f"{len(changes)} changes in {last - first:.1f} s of work ({rows} samples, {observer.rows} measurements)")
    answer = {
        "schema": "armlink.observe/1",
        "records": {"calibration": calibration.id, "gravity": gravity.id},
        "seconds": last - first,
        "samples": rows,
        "rows": observer.rows,
        "events": told,
        "joints": list(described.names),
        **found.as_json(),
    }
    write_json(json_file, answer)
    return int(bool(changes))


def recorded(arm: "ArmFile", path: Path) -> "Iterator[tuple[float, Array, Array]]":
    """Rows of a recording: time [s], positions and torques, in the order of the arm's joints. Raises BadInput."""
    from armlink.recording.files import load_recording
    from calib.fit.recorded_rows import in_joint_order

    run = in_joint_order(load_recording(path), arm.joint_names, str(path))
    torque = run.torque if run.torque is not None else run.motor_torque
    if torque is None:
        raise BadInput(f"{path}: it has no torques, expected those of {', '.join(arm.joint_names)}")
    yield from ((float(t), q, tau) for t, q, tau in zip(run.t, run.position, torque, strict=True))


def _heard(arm: "ArmFile", bus: str | None, seconds: float) -> "Iterator[tuple[float, Array, Array]]":
    """Samples of a listener until the time is over or Ctrl-C; raises BusFault if none comes."""
    from calib.commands.heard_samples import heard_samples

    for together in heard_samples(arm, bus, seconds, lambda _, sample: (sample.t, sample.position, sample.torque)):
        yield from together
