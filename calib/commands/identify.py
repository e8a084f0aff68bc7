"""Identifies gravity parameters from sweeps, or from poses of any robot; keeps a gravity record."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import reads_recordings
from calib.commands.options import JsonFile, Store, SweepsArm

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from armlink.recording.corrections import Corrections
    from calib.fit.gravity_fit import GravityFit

POSES = "Poses of any robot, with --model"


@reads_recordings
def identify(
    data: Annotated[
        list[Path],
        typer.Argument(help="Data sets of sweep; or, with --model, recordings or tables of poses (CSV, bag, LeRobot)."),
    ],
    stated: "Corrections",
    arm: SweepsArm = None,
    calibration: Annotated[
        str | None,
        typer.Option(help="Id of the calibration record to use; by default sensors are fitted from the same sweeps."),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="URDF, MJCF or arm file of the recorded robot.", rich_help_panel=POSES)
    ] = None,
    base: Annotated[
        str | None, typer.Option(help="Body of the model file that carries the chain.", rich_help_panel=POSES)
    ] = None,
    tip: Annotated[
        str | None, typer.Option(help="Last body of the chain in the model file.", rich_help_panel=POSES)
    ] = None,
    reference_mass: Annotated[
        list[str] | None,
        typer.Option(help="Known mass that hung at the tip in one of the files: FILE=KG.", rich_help_panel=POSES),
    ] = None,
    heldout: Annotated[
        list[Path] | None,
        typer.Option(help="Poses on which the result is judged; by default cross-validation.", rich_help_panel=POSES),
    ] = None,
    gain_std: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="How far torque gains may be from 1 (standard deviation); default: 0.03 (sensors), 0.5 (currents).",
            rich_help_panel=POSES,
        ),
    ] = None,
    out_model: Annotated[
        Path | None, typer.Option(help="Also write the model with these moments: .urdf or .xml.", rich_help_panel=POSES)
    ] = None,
    coefficients: Annotated[
        Path | None, typer.Option(help="Also write base parameters as YAML for ROS 2.", rich_help_panel=POSES)
    ] = None,
    plan: Annotated[
        int, typer.Option(min=0, max=100, help="Number of further poses to propose.", rich_help_panel=POSES)
    ] = 0,
    store: Store = None,
    json_file: JsonFile = None,
) -> int:
    """Identify the mass moments that gravity compensation needs, and store them as a gravity record.

    Without --model from sweeps; with --model from poses of any robot, recorded at rest or in slow motion.
    Exit status 1 if held-out poses are predicted worse than by the model's own inertials.

    Example: armlink identify poses.csv --model arm.urdf --out-model better.urdf
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.errors import BadInput
    from calib.api import Calibrated, calibrated, identified
    from calib.commands.identify_poses import identify_poses
    from calib.commands.options import load_sweeps
    from calib.dataset import all_creep
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore

    records = RecordStore(store)
    of_poses: dict[str, Any] = {
        "base": base,
        "tip": tip,
        "reference_mass": reference_mass or None,
        "heldout": heldout or None,
        "gain_std": gain_std,
        "out_model": out_model,
        "coefficients": coefficients,
        "plan": plan or None,
    }
    if model is not None:
        if arm is not None or calibration is not None:
            raise BadInput("--arm and --calibration are only for sweeps; poses need only --model")
        return identify_poses(data, model, stated, records, json_file, **of_poses)
    for name, value in of_poses.items():
        if value is not None:
            raise BadInput(f"--{name.replace('_', '-')} is only for poses: give the model with --model")
    sweeps, arm_file = load_sweeps(data, arm)
    sensors: Calibrated | CalibrationRecord
    used: CalibrationRecord | None
    if calibration is None:
        sensors = calibrated(arm_file, sweeps)
        current = records.current(CalibrationRecord, arm_file)
        used = current if current is not None and current.sources == sensors.sources else None
    else:
        if all_creep(sweeps):
            raise BadInput("--calibration: the fit of creep sweeps finds the calibration too: leave this option out")
        kept = records.usable(calibration, arm_file)
        if not isinstance(kept, CalibrationRecord):
            raise BadInput(f"--calibration {calibration}: this is a {kept.kind} record, expected a calibration record")
        sensors = used = kept
    fit = identified(arm_file, sweeps, sensors)
    record = fit.record(arm_file, used)
    records.put(record, arm_file, by="armlink identify", reason="creep sweeps" if all_creep(sweeps) else "sweeps")
    out = results(json_file)
    _show(fit, out)
    out.print(f"record {record.id} is current: {fit.identifiable.sum()} of {len(fit.beta)} mass moments are determined")
    if sweeps[-1].manifest.reference_mass:
        out.print("take the reference mass off before the next command moves the arm")
    suggest(command_line("verify", arm_file.argument, bus=sweeps[-1].manifest.bus or None, store=store))
    write_json(json_file, _answer(fit, record.id))
    return 0


def _answer(fit: "GravityFit", record: str) -> dict[str, Any]:
    return {
        "schema": "armlink.gravity/1",
        "record": record,
        "joints": list(fit.names),
        "beta": fit.beta.tolist(),
        "std": fit.std.tolist(),
        "identifiable": fit.identifiable.tolist(),
        "recursive": None if fit.recursive is None else fit.recursive.beta.tolist(),
        "residual_rms": fit.residual_rms.tolist(),
    }


def _show(fit: "GravityFit", console: "PlainConsole") -> None:
    import numpy as np

    from calib.commands.screen import print_intervals

    beta, half = np.where(fit.identifiable, fit.beta, np.nan), 1.96 * fit.std
    columns = {"x": (beta[0::2], half[0::2]), "y": (beta[1::2], half[1::2])}
    if fit.recursive is not None:
        recursive = np.where(fit.identifiable, fit.recursive.beta, np.nan)
        columns["x, recursive"] = recursive[0::2], 0 * half[0::2]
        columns["y, recursive"] = recursive[1::2], 0 * half[1::2]
    columns["residual [N·m]"] = fit.residual_rms, 0 * fit.residual_rms
    print_intervals("Mass moments [kg·m], ± half of the 95 % interval", fit.names, columns, console)
    if fit.recursive is not None:
        console.print("recursive: one joint after the other, from tip to base, for comparison; x and y are the result")
