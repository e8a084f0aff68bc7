"""`armlink calibrate` and `armlink identify` of creep sweeps: arms without torque sensors."""

from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.commands.output import write_json
from armlink.commands.plain_console import PlainConsole, results
from calib.commands.screen import print_intervals, print_lines
from calib.creep.fit import QUANTILE, CreepFit, fit_creep
from calib.creep.record import HEADINGS, calibration_record, determined_values, gravity_record, missing
from calib.creep.run import contacts
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData


def calibrate_creep(
    data: list[SweepData], arm_file: ArmFile, store: str | None, json_file: Path | None, report: Path | None
) -> None:
    """Fit, show and keep a calibration record; it is in force when the arm is opened next: the host keeps it."""
    fit = _fit(data, arm_file)
    records = RecordStore(store)
    current = records.current(CalibrationRecord, arm_file)
    record = calibration_record(fit, arm_file).model_copy(update={"parent": None if current is None else current.id})
    records.put(record, arm_file, by="armlink calibrate", reason="creep sweeps")
    out = results(json_file)
    _show(fit, data, out)
    if report is not None:
        from calib.report.calibration import write_creep_report

        write_creep_report(fit, record, [each.reason for one in data for each in contacts(one)], report)
    out.print(f"record {record.id} is current: it corrects readings and commands when the arm is opened next")
    write_json(json_file, {"schema": "armlink.creep/1", "record": record.id, **_answer(fit, data)})


def identify_creep(data: list[SweepData], arm_file: ArmFile, store: str | None, json_file: Path | None) -> None:
    """Fit, show and keep the gravity record of the same sweeps."""
    fit = _fit(data, arm_file)
    records = RecordStore(store)
    current = records.current(CalibrationRecord, arm_file)
    used = current if current is not None and current.sources == fit.sources else None
    record = gravity_record(fit, arm_file, used)
    records.put(record, arm_file, by="armlink identify", reason="creep sweeps")
    out, found = results(json_file), fit.found("beta")
    beta, half = np.where(found, fit.value("beta"), np.nan), QUANTILE * fit.std("beta")
    print_intervals(
        "Mass moments [kg·m], ± half of the 95 % interval",
        fit.names,
        {"x": (beta[0::2], half[0::2]), "y": (beta[1::2], half[1::2])},
        out,
    )
    out.print(f"record {record.id} is current: {found.sum()} of {len(found)} mass moments are determined")
    answer = {
        "schema": "armlink.gravity/1",
        "record": record.id,
        "joints": list(fit.names),
        "beta": fit.beta.tolist(),
        "std": fit.std("beta").tolist(),
        "identifiable": found.tolist(),
        "recursive": None,
        "residual_rms": fit.residual_rms.tolist(),
    }
    write_json(json_file, answer)


def _fit(data: list[SweepData], arm_file: ArmFile) -> CreepFit:
    return fit_creep(arm_file, [each.require(arm_file) for each in data])


def _show(fit: CreepFit, data: list[SweepData], console: PlainConsole) -> None:
    reasons = missing(fit)
    columns = {title: (determined_values(fit, key), QUANTILE * fit.std(key)) for key, title in HEADINGS.items()}
    print_intervals("Drives, ± half of the 95 % interval", fit.names, columns, console)
    print_lines([f"{joint} {parameter}: {reason}" for (joint, parameter), reason in reasons.items()], console=console)
    print_lines([*(each.reason for one in data for each in contacts(one)), *fit.findings], "yellow", console)


def _answer(fit: CreepFit, data: list[SweepData]) -> dict[str, Any]:
    values = {
        family: {
            "estimated": values.tolist(),
            "ci95": [
                each if kept else None
                for each, kept in zip(fit.ci95(family).tolist(), np.isfinite(values), strict=True)
            ],
        }
        for family, values in ((each, determined_values(fit, each)) for each in (*HEADINGS, "asymmetry", "warming"))
    }
    return {
        "joints": list(fit.names),
        **values,
        "not_identifiable": [
            {"joint": joint, "parameter": parameter, "reason": reason}
            for (joint, parameter), reason in missing(fit).items()
        ],
        "disturbed": [*(each.reason for one in data for each in contacts(one)), *fit.findings],
        "residual_rms": fit.residual_rms.tolist(),
        "temperature": [None if np.isnan(each) else each for each in fit.rows.warmest.tolist()],
    }
