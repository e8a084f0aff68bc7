"""Fits gains and offsets of torque and position sensors to sweeps; keeps a calibration record."""

import getpass
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.commands.options import APPLY, Bus, Check, Flash, JsonFile, Replaced, Store, Sweeps, SweepsArm

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from calib.api import Calibrated
    from calib.fit.creep_fit import CreepFit
    from calib.fit.sensor_fit import SensorFit
    from calib.records.records import CalibrationRecord


def calibrate(
    directories: Sweeps,
    arm: SweepsArm = None,
    apply: Annotated[bool, typer.Option("--apply", help="Also write gains and offsets to the drives.")] = False,
    bus: Bus = None,
    check: Check = True,
    flash: Flash = False,
    replaced: Replaced = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            help="Write the values of this joint although the sensor model does not hold for it; may be repeated.",
            rich_help_panel=APPLY,
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Also write a report to this file: one self-contained HTML page.")
    ] = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Fit all sensors to the sweeps of all directories together, and store the result as a calibration record.

    Example: armlink calibrate unloaded loaded --json calibration.json
    """
    from functools import partial

    import numpy as np

    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.errors import BadInput, Refused
    from armlink.extras import require_extra
    from calib.api import calibrated
    from calib.commands.options import load_sweeps
    from calib.dataset import all_creep, drives_of
    from calib.fit.gravity_fit import held_out_steps
    from calib.fit.sensor_fit import SensorFit, mass_complaint
    from calib.install.apply import Apply, apply_creep, apply_record
    from calib.install.plausibility import replaced_record
    from calib.records.records import CalibrationRecord, GravityRecord, HeldOut
    from calib.records.store import RecordStore
    from calib.sweep.verify import creep_complaint

    if report is not None:
        require_extra("--report", "reports")
    data, arm_file = load_sweeps(directories, arm)
    if flash and all_creep(data):
        raise BadInput("--flash: the host keeps the calibration of these drives: leave the option out")
    fit = calibrated(arm_file, data)
    records = RecordStore(store)
    current = records.current(CalibrationRecord, arm_file)
    record = fit.record(arm_file).model_copy(update={"parent": None if current is None else current.id})
    if isinstance(fit, SensorFit):
        record = record.model_copy(update={"drives": drives_of(data)})
        if complaint := mass_complaint(fit.arm, fit.rows.readings):
            records.add(record.model_copy(update={"note": f"not made current: {complaint}"}))
            write_json(json_file, _answer(fit, record, False))
            raise Refused(f"{complaint} Record {record.id} is stored, but not made current")
    out = results(json_file)
    _show(fit, out)
    user = getpass.getuser()
    if apply:
        record = record.model_copy(update={"confirmed_by": user})
        before = replaced_record(record, arm_file, records) if isinstance(fit, SensorFit) else None
        if before is not None:
            gravity = records.current(GravityRecord, arm_file)
            proof = HeldOut(against=before.id) if replaced else held_out_steps(record, before, arm_file, data, gravity)
            record = record.model_copy(update={"held_out": proof})
    if report is not None:
        from calib.report.calibration import Calibrated, write_report

        write_report(Calibrated(arm_file, data, fit, record, current), report)
    how = Apply(
        by=user, bus=bus, replaced=tuple(replaced or ()), accepted=tuple(accept or ()), check=check, flash=flash
    )
    again = command_line("calibrate", *map(str, directories), "--apply", arm=arm, bus=bus, store=store)
    kept = "the drives keep their old calibration until `--apply` writes this record to them"
    if arm_file.serial == "unknown":
        kept += ", which needs the arm's serial number in the arm file"
    if not isinstance(fit, SensorFit):
        with early_end(arm_file, again) as work:
            work.enabled = apply and check
            agrees = None
            if work.enabled and fit.found_gain.any():
                gravity = fit.gravity.record(arm_file, record)
                agrees = partial(creep_complaint, arm=arm_file, gravity=gravity, calibration=record)
            if not apply:
                how = Apply(by="armlink calibrate", replaced=how.replaced, accepted=how.accepted, check=False)
            apply_creep(record, arm_file, records, how, fit.broken, agrees)
        kept = "it corrects readings and commands when the arm is opened next"
    elif apply:
        with early_end(arm_file, again) as work:
            work.enabled = check
            beta = None if np.isnan(fit.value("gain")).all() else fit.fit.complete.beta
            written = apply_record(record, arm_file, records, how, beta, "sweeps", fit.broken)
        kept = f"it was written to {len(written)} drives and read back"
    else:
        records.put(record, arm_file, by="armlink calibrate", reason="sweeps")
    out.print(f"record {record.id} is current; {kept}")
    suggest(command_line("identify", *map(str, directories), arm=arm, store=store))
    write_json(json_file, _answer(fit, record, apply))


def _answer(fit: "Calibrated", record: "CalibrationRecord", applied: bool) -> dict[str, Any]:
    from calib.fit.sensor_fit import SensorFit

    if isinstance(fit, SensorFit):
        own: dict[str, Any] = {"schema": "armlink.calibration/1", "applied": applied, **_of_steps(fit)}
    else:
        own = {"schema": "armlink.creep/1", **_of_creeps(fit)}
    return {
        **own,
        "record": record.id,
        "joints": list(fit.names),
        "not_identifiable": [
            {"joint": joint, "parameter": parameter, "reason": reason}
            for (joint, parameter), reason in fit.reasons.items()
        ],
        "residual_rms": fit.residual_rms.tolist(),
    }


def _of_steps(fit: "SensorFit") -> dict[str, Any]:
    from calib.records.records import PARAMETERS

    return {
        **{name: {"estimated": fit.value(name).tolist(), "ci95": fit.ci95(name).tolist()} for name in PARAMETERS},
        "imprecise": list(fit.imprecise),
        "attachment": _attachment(fit),
        "gain_ratio": None if fit.gain_ratio is None else fit.gain_ratio.tolist(),
        "hysteresis": fit.hysteresis.tolist(),
        "friction": fit.friction.tolist(),
        "findings": [vars(found) for found in fit.findings],
        "doubtful": list(fit.doubtful),
        "discrepancy": [
            {"joint": name, **each.model_dump()} for name, each in zip(fit.names, fit.goodness.discrepancy, strict=True)
        ],
        "left_out": [
            {"sweep": each.sweep, "joint": fit.names[each.joint], "rms": each.rms, "ratio": each.ratio}
            for each in fit.goodness.left_out
        ],
        "chi2": fit.fit.chi2,
        "dof": fit.fit.dof,
    }


def _of_creeps(fit: "CreepFit") -> dict[str, Any]:
    from calib.fit.creep_fit import VALUES, family_of

    values = {
        family_of(name): {
            "estimated": fit.value(name).tolist(),
            "ci95": [None if math.isnan(low) else [low, high] for low, high in fit.ci95(name).tolist()],
        }
        for name in VALUES
    }
    return {
        **values,
        "disturbed": [finding.text for finding in fit.findings],
        "temperature": [None if math.isnan(each) else each for each in fit.rows.warmest.tolist()],
    }


def _attachment(fit: "SensorFit") -> dict[str, list[Any]] | None:
    """Position of the reference mass [m]; None if it is not identifiable."""
    if fit.attachment is None:
        return None
    point, half = fit.attachment
    return {
        "estimated": point.tolist(),
        "ci95": [[at - by, at + by] for at, by in zip(point.tolist(), half.tolist(), strict=True)],
    }


def _show(fit: "Calibrated", console: "PlainConsole") -> None:
    from calib.commands.screen import print_intervals, print_lines
    from calib.fit.sensor_fit import SensorFit
    from calib.report.tables import columns_of

    lines = [f"{joint} {parameter}: {reason}" for (joint, parameter), reason in fit.reasons.items()]
    columns = columns_of(fit)
    if isinstance(fit, SensorFit):
        columns["locked friction [N·m]"] = (fit.friction, 0 * fit.friction)
        doubts = (f"{name} {each.level:.3g}" for name, each in zip(fit.names, fit.goodness.discrepancy, strict=True))
        told = "expected difference of sensors and gravity model at new poses, in addition to noise and these intervals"
        lines.append(f"{told} [N·m]: {', '.join(doubts)}")
        lines += [*fit.imprecise.values(), *([fit.attachment_text] if fit.attachment is not None else [])]
        if fit.gain_ratio is not None:
            ratios = ", ".join(f"{name} {ratio:.4f}" for name, ratio in zip(fit.names, fit.gain_ratio, strict=True))
            lines.append(f"gains relative to the gain of the last joint: {ratios}")
    title = "Sensors" if isinstance(fit, SensorFit) else "Drives"
    print_intervals(f"{title}, ± half of the 95 % interval", fit.names, columns, console)
    print_lines(lines, console=console)
    print_lines([finding.text for finding in fit.findings], "yellow", console)
    if not isinstance(fit, SensorFit):
        return
    worst = max(fit.goodness.left_out, key=lambda each: each.ratio, default=None)
    if worst is not None:
        off = f"the worst, {worst.sweep}, is off by {worst.ratio:.1f} times the expected error (about 1 is normal)"
        console.print(f"cross-validation, each sweep predicted by a fit of the others: {off}")
