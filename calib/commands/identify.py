"""Identifies gravity parameters from sweeps, recursively from tip to base, then globally; keeps a gravity record."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.commands.options import JsonFile, Store, Sweeps, SweepsArm

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.fit.gravity_fit import GravityFit


def identify(
    directories: Sweeps,
    arm: SweepsArm = None,
    calibration: Annotated[
        str | None,
        typer.Option(help="Id of the calibration record to use; by default sensors are fitted from the same sweeps."),
    ] = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Identify the mass moments that gravity compensation needs, and store them as a gravity record.

    Example: armlink identify unloaded loaded --json gravity.json
    """
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.errors import BadInput
    from calib.api import Calibrated, calibrated, identified
    from calib.commands.options import load_sweeps
    from calib.dataset import all_creep
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore

    data, arm_file = load_sweeps(directories, arm)
    records = RecordStore(store)
    sensors: Calibrated | CalibrationRecord
    used: CalibrationRecord | None
    if calibration is None:
        sensors = calibrated(arm_file, data)
        current = records.current(CalibrationRecord, arm_file)
        used = current if current is not None and current.sources == sensors.sources else None
    else:
        if all_creep(data):
            raise BadInput("--calibration: creep sweeps give drives and gravity in one fit: leave this option out")
        kept = records.usable(calibration, arm_file)
        if not isinstance(kept, CalibrationRecord):
            raise BadInput(f"--calibration {calibration}: this is a {kept.kind} record, expected a calibration record")
        sensors = used = kept
    fit = identified(arm_file, data, sensors)
    record = fit.record(arm_file, used)
    records.put(record, arm_file, by="armlink identify", reason="creep sweeps" if all_creep(data) else "sweeps")
    out = results(json_file)
    _show(fit, out)
    out.print(f"record {record.id} is current: {fit.identifiable.sum()} of {len(fit.beta)} mass moments are determined")
    suggest(command_line("verify", arm_file.argument, store=store))
    write_json(json_file, _answer(fit, record.id))


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
        recursive = fit.recursive.beta
        columns["x, recursive"] = recursive[0::2], 0 * half[0::2]
        columns["y, recursive"] = recursive[1::2], 0 * half[1::2]
    columns["residual [N·m]"] = fit.residual_rms, 0 * fit.residual_rms
    print_intervals("Mass moments [kg·m], ± half of the 95 % interval", fit.names, columns, console)
