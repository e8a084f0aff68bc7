"""Torque and position sensor gains and offsets from sweeps; writes a calibration record."""

import getpass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.commands.options import Bus, Check, Flash, JsonFile, Replaced, Store

if TYPE_CHECKING:
    from calib.fit.sensor_fit import SensorFit
    from calib.records.records import CalibrationRecord, Parameter


def calibrate(
    directories: Annotated[list[Path], typer.Argument(help="Data sets of armlink sweep, without and with load.")],
    arm: Annotated[str | None, typer.Option(help="Arm file, where it is no longer where the sweep had it.")] = None,
    apply: Annotated[bool, typer.Option("--apply", help="Also write gains and offsets to the controllers.")] = False,
    bus: Bus = None,
    check: Check = True,
    flash: Flash = False,
    replaced: Replaced = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(help="With --apply: a joint to be written although the model does not hold there."),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Also write a page to file: one self-contained HTML.")] = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Fit every sensor to sweeps, all directories in one problem, and keep the result as a calibration record.

    Example: armlink calibrate unloaded loaded --json calibration.json
    """
    from armlink.commands.output import write_json
    from armlink.errors import BadInput
    from calib.commands.screen import print_lines
    from calib.fit.sensor_fit import fit_sensors
    from calib.install.apply import Apply, apply_calibration
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore
    from calib.sweep.dataset import load_data

    if not directories:
        raise BadInput("calibrate: give the directories that armlink sweep wrote")
    data = [load_data(path) for path in directories]
    arm_file = data[0].load_arm(arm)
    fit = fit_sensors(arm_file, data)
    records = RecordStore(store)
    current = records.current(CalibrationRecord, arm_file)
    record = fit.record(arm_file).model_copy(update={"parent": None if current is None else current.id})
    _show(fit)
    if apply:
        user = getpass.getuser()
        record = record.model_copy(update={"confirmed_by": user})
    if report is not None:
        from calib.report.calibration import Calibrated, write_report

        write_report(Calibrated(arm_file, data, fit, record, current), report)
    if apply:
        how = Apply(
            by=user, bus=bus, replaced=tuple(replaced or ()), accepted=tuple(accept or ()), check=check, flash=flash
        )
        written = apply_calibration(record, arm_file, records, data, fit, how)
        print_lines([f"record {record.id} written to {len(written)} controllers, read back and current"])
    else:
        records.put(record, arm_file, by="armlink calibrate", reason="sweeps")
    write_json(json_file, _answer(fit, record, apply))


def _answer(fit: "SensorFit", record: "CalibrationRecord", applied: bool) -> dict[str, Any]:
    from calib.records.records import PARAMETERS

    return {
        "schema": "armlink.calibration/1",
        "record": record.id,
        "applied": applied,
        "joints": list(fit.names),
        **{name: {"estimated": fit.value(name).tolist(), "ci95": fit.ci95(name).tolist()} for name in PARAMETERS},
        "not_identifiable": [
            {"joint": joint, "parameter": parameter, "reason": reason}
            for (joint, parameter), reason in fit.reasons.items()
        ],
        "imprecise": list(fit.imprecise),
        "attachment": _attachment(fit),
        "gain_ratio": None if fit.gain_ratio is None else fit.gain_ratio.tolist(),
        "residual_rms": fit.residual_rms.tolist(),
        "hysteresis": fit.hysteresis.tolist(),
        "friction": fit.friction.tolist(),
        "findings": [
            {"joint": found.joint, "kind": found.kind, "size": found.size, "unit": found.unit, "text": found.text}
            for found in fit.findings
        ],
        "doubtful": list(fit.doubtful),
        "left_out": [
            {"sweep": each.sweep, "joint": fit.names[each.joint], "rms": each.rms, "ratio": each.ratio}
            for each in fit.goodness.left_out
        ],
        "chi2": fit.fit.chi2,
        "dof": fit.fit.dof,
    }


def _attachment(fit: "SensorFit") -> dict[str, list[Any]] | None:
    """Where the reference mass hung [m], null where not determined."""
    if fit.attachment is None:
        return None
    point, half = fit.attachment
    return {
        "estimated": point.tolist(),
        "ci95": [[at - by, at + by] for at, by in zip(point.tolist(), half.tolist(), strict=True)],
    }


def _show(fit: "SensorFit") -> None:
    from calib.commands.screen import print_intervals, print_lines

    headings: dict[Parameter, str] = {"gain": "gain", "offset": "offset [N·m]", "position_gain": "position gain"}
    columns = {heading: (fit.value(name), fit.quantile * fit.std(name)) for name, heading in headings.items()}
    columns["locked friction [N·m]"] = (fit.friction, 0 * fit.friction)
    print_intervals("Sensors, ± half of the 95 % interval", fit.names, columns)
    lines = [f"{joint} {parameter}: {reason}" for (joint, parameter), reason in fit.reasons.items()]
    lines += [*fit.imprecise.values(), *([fit.attachment_text] if fit.attachment is not None else [])]
    if fit.gain_ratio is not None:
        ratios = ", ".join(f"{name} {ratio:.4f}" for name, ratio in zip(fit.names, fit.gain_ratio, strict=True))
        lines.append(f"gains as multiples of the last joint's: {ratios}")
    print_lines(lines)
    print_lines([finding.text for finding in fit.findings], "yellow")
    worst = max(fit.goodness.left_out, key=lambda each: each.ratio, default=None)
    if worst is not None:
        told = f"{worst.ratio:.1f} times its expected error at worst ({worst.sweep})"
        print_lines([f"each sweep told by all others: within {told}"])
