"""Reports as one HTML page each: of a calibration, and of a verification with the paper's Figure 6.

Of a calibration: sources, results per joint and sweep, comparison with the last record.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from armlink.arm_file import ArmFile
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.calibration import rms
from calib.fit.creep_fit import CreepFit
from calib.fit.gravity_fit import heldout_scores
from calib.fit.sensor_fit import SensorFit
from calib.records.compare import differences
from calib.records.records import CalibrationRecord, GravityRecord
from calib.report.figures import (
    before_after_figure,
    creep_figure,
    joint_figure,
    left_out_figure,
    sweep_rows,
    sweeps_of,
    verify_figure,
)
from calib.report.page import ReportSection, html_of, paragraph, paragraphs, render, verdict_line
from calib.report.tables import ReportTable, columns_of, interval_table
from calib.sweep.verify import Verification
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque

FIGURE_6 = "Model against sensor (as Figure 6 of Ma and Hollerbach)"


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Data, fit and records of one calibration, from steps at rest or from creeps."""

    arm: ArmFile
    data: Sequence[SweepData]
    fit: SensorFit | CreepFit
    record: CalibrationRecord
    before: CalibrationRecord | None
    """The current record until now; None if this is the first."""


def write_report(done: Calibrated, path: Path) -> None:
    """Write one self-contained HTML file; raises OSError."""
    record = done.record
    title = f"Calibration {record.id}: {record.arm} {record.serial}"
    render(path, title, [_identity(done), *sections(done)], f"{record.created:%Y-%m-%d %H:%M} UTC, {record.software}")


def sections(done: Calibrated) -> list[ReportSection]:
    if isinstance(done.fit, CreepFit):
        return [_values(done.fit), _creeps(done.fit)]
    return [_comparison(done, done.fit), _values(done.fit), *_sweeps(done, done.fit), _left_out(done, done.fit)]


def _identity(done: Calibrated) -> ReportSection:
    record, fit, html = done.record, done.fit, Markup()
    rows = [
        ["arm", f"{record.arm}, serial {record.serial}"],
        ["description (SHA-256)", html_of("<small>{}</small>", record.description_hash)],
        ["record", record.id + (f", replaces {record.parent}" if record.parent else ", the first of this arm")],
    ]
    if isinstance(fit, SensorFit):
        broken = sorted(fit.doubtful)
        verdict = f"the model does not hold: {', '.join(broken)}" if broken else "the model holds"
        html = verdict_line(verdict) + _advice(done, fit, broken)
        html += paragraphs(each.text for each in fit.findings)
        chi2 = f"χ² {fit.fit.chi2:.0f} at {fit.fit.dof} degrees of freedom"
        rows += [
            ["confirmed by", record.confirmed_by or "not confirmed: stored, but not written to the drives"],
            ["readings", f"{len(fit.rows.swept)}, {chi2}"],
        ]
    for data in done.data:
        load = f"{data.manifest.reference_mass:g} kg attached" if data.manifest.reference_mass else "no mass"
        when = f"{data.manifest.created:%Y-%m-%d %H:%M} UTC"
        rows.append(
            [f"sweeps {data.path.name}", html_of("{}<br><small>SHA-256 {}</small>", f"{load}, {when}", data.digest)]
        )
    return ReportSection("Calibration", html, (), [ReportTable((), rows, texts=2)])


def _advice(done: Calibrated, fit: SensorFit, broken: list[str]) -> Markup:
    """Advice on what to do with this calibration, in a few sentences and a command, as HTML."""
    half = fit.half95("gain")
    known, unknown = half[np.isfinite(half)], [fit.names[joint] for joint in np.flatnonzero(np.isnan(half))]
    exactly = f"Intervals of gains: ± {known.min():.2%} to ± {known.max():.2%}" if known.size else "No gain is known"
    without = f"; the gains of {', '.join(unknown)} are not known, see below" if unknown else ""
    if broken:
        return paragraph(
            f"Do not write this calibration to the drives yet: look at {', '.join(broken)} first, then sweep again. "
            f"{exactly}{without}."
        )
    if done.record.confirmed_by:
        next_step, command = "This calibration is confirmed. Verify it with:", f"armlink verify {done.arm.argument}"
    else:
        sweeps = shlex.join(str(data.path) for data in done.data)
        next_step, command = "To write this calibration to the drives, run:", f"armlink calibrate {sweeps} --apply"
    return paragraph(f"{exactly}{without}. {next_step}") + html_of("<p><code>{}</code></p>", command)


def _values(fit: SensorFit | CreepFit) -> ReportSection:
    columns, text = columns_of(fit), "Estimates ± half of the 95 % interval."
    reasons = [f"{joint}, {parameter.replace('_', ' ')}: {why}." for (joint, parameter), why in fit.reasons.items()]
    if isinstance(fit, SensorFit):
        text = "Estimates ± half of the 95 % interval; reading = gain · torque + offset."
        columns |= {"residual RMS [N·m]": (fit.residual_rms, 0 * fit.residual_rms)}
        columns |= {"hysteresis [N·m]": (fit.hysteresis, 0 * fit.hysteresis)}
        reasons += [f"{why}." for why in fit.imprecise.values()]
        if fit.attachment is not None:
            reasons.append(f"{fit.attachment_text[0].upper()}{fit.attachment_text[1:]}.")
    title = "Sensors" if isinstance(fit, SensorFit) else "Drives"
    return ReportSection(title, paragraphs(reasons), (), [interval_table(fit.names, columns, text)])


def _comparison(done: Calibrated, fit: SensorFit) -> ReportSection:
    """The calibration in use until now against the new one, on the same readings."""
    before, record, names = done.before, done.record, fit.names
    n = len(names)
    if before is None:
        manifest = done.data[0].manifest
        old, label = manifest.installed, "the calibration in the drives"
    else:
        old, label = before.torque_calibration(UNCALIBRATED), f"record {before.id}"
    before_rms, now_rms = (_rms_of_pair(done, fit, pair) for pair in (old, record.torque_calibration(old)))
    shown = np.isfinite(before_rms) & np.isfinite(now_rms)
    text = (
        "Calibrated torque minus model torque over all readings without load, with the calibration used "
        "until now and with the new calibration."
    )
    figures = []
    if shown.any():
        figures.append(
            before_after_figure(tuple(np.array(names)[shown].tolist()), before_rms[shown], now_rms[shown], label)
        )
    header = ("joint", f"RMS with {label} [N·m]", "RMS now [N·m]")
    rows = [[names[j], _number(before_rms[j], ".4f"), _number(now_rms[j], ".4f")] for j in range(n)]
    tables = [ReportTable(header, rows)]
    if before is not None:
        tables.append(_changes(before, record))
    else:
        text += " This arm had no record before."
    return ReportSection("Before and after", paragraph(text), figures, tables)


def _changes(before: CalibrationRecord, record: CalibrationRecord) -> ReportTable:
    rows = [
        [each.joint, f"{each.parameter.replace('_', ' ')} [{each.unit}]", *each.texts]
        for each in differences(before, record)
        if each.before is not None or each.after is not None
    ]
    header = ("joint", "parameter", before.id, record.id, "change", "in standard deviations")
    return ReportTable(
        header, rows, f"Compared with record {before.id} of {before.created:%Y-%m-%d %H:%M} UTC.", texts=2
    )


def _rms_of_pair(done: Calibrated, fit: SensorFit, pair: TorqueCalibration[Array]) -> Array:
    """RMS (n,) [N·m] of calibrated minus model torque over own readings without load; NaN without any."""
    rows = fit.rows
    complete = fit.fit.complete
    counted = np.isfinite(rows.readings.torque) & (rows.readings.load == 0)[:, None]
    q = rows.readings.position * complete.position_gain + complete.position_offset
    model = gravity_torque(gcomp_arm(done.arm), complete.beta, q)
    return rms(np.where(counted, pair.invert(rows.readings.torque) - model, np.nan))


def _sweeps(done: Calibrated, fit: SensorFit) -> list[ReportSection]:
    arm = gcomp_arm(done.arm)
    text = (
        "Upward (▸) and downward (◂) readings, one colour per sweep. Lines: the fit to all sweeps of all joints. Bars:"
        " the 95 % interval of one reading."
    )
    left_out = {each.sweep: each for each in fit.goodness.left_out}
    made = []
    for joint in reversed(range(len(fit.names))):
        rows = []
        for sweep in sweeps_of(fit, joint):
            at = sweep_rows(fit, joint, sweep)
            residual = fit.fit.residual[at, joint]
            others = left_out.get(sweep)
            angle = fit.rows.readings.position[at, joint]
            rows.append(
                [
                    sweep,
                    f"{fit.rows.readings.load[at[0]]:g}",
                    str(len(at)),
                    f"{angle.min():.2f}\u202f…\u202f{angle.max():.2f}".replace("-", "\u2212"),
                    _number(float(np.sqrt(np.nanmean(residual**2))), ".4f"),
                    _number(float(np.nanmax(np.abs(residual))), ".4f"),
                    "–" if others is None else f"{others.rms:.4f} ({others.ratio:.1f} ×)",
                ]
            )
        header = (
            "sweep",
            "mass [kg]",
            "readings",
            "range [rad]",
            "residual RMS [N·m]",
            "largest [N·m]",
            "cross-validation RMS [N·m]",
        )
        caption = (
            "Cross-validation: RMS error on this sweep of a fit to all other sweeps, and the ratio of this error "
            "to the expected error."
        )
        figures = [joint_figure(arm, fit, joint)] if rows else []
        made.append(
            ReportSection(
                f"Sweeps of {fit.names[joint]}", paragraph(text), figures, [ReportTable(header, rows, caption)]
            )
        )
        text = ""
    return made


def _left_out(done: Calibrated, fit: SensorFit) -> ReportSection:
    """The paper's Figure 6 on held-out steps."""
    rows = fit.rows
    score = heldout_scores(done.record, done.arm, rows, refit=True)
    own = rows.own & (rows.readings.load == 0)[:, None]
    complete = fit.fit.complete
    pair = TorqueCalibration(complete.gain, complete.offset)
    sensor = np.where(own, pair.invert(rows.readings.torque), np.nan)
    model = sensor - np.where(own, score * rows.readings.sigma, np.nan) / complete.gain
    text = (
        "Torque at held-out steps (every second step of each sweep, then the other steps): the model, "
        "fitted without these steps, is solid, the sensor is dashed. For poses that are in no sweep, run: "
        f"armlink verify {done.arm.argument} --report verify.html"
    )
    return ReportSection(FIGURE_6, paragraph(text), [left_out_figure(fit.names, sensor, model)])


def _number(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "–"


def _creeps(fit: CreepFit) -> ReportSection:
    text = (
        "At each position, half the sum of upward (▸) and downward (◂) readings is gravity, and half their "
        "difference is friction."
    )
    return ReportSection(
        "Creep sweeps", paragraph(text) + paragraphs(each.text for each in fit.findings), [creep_figure(fit)]
    )


def write_verification(
    result: Verification, arm: ArmFile, gravity: GravityRecord, calibration: CalibrationRecord | None, path: Path
) -> None:
    """Write one self-contained HTML file; raises OSError."""
    verdict = "passed" if result.passed else "not passed"
    sensors = "the calibration in the drives" if calibration is None else f"calibration record {calibration.id}"
    skipped = f" {result.skipped} poses were skipped, since the drives cannot reach them." if result.skipped else ""
    html = verdict_line(verdict) + paragraph(
        f"Gravity record {gravity.id} compared with the torque sensors with {sensors}, at "
        f"{len(result.sensor)} random poses that no fit used.{skipped}"
    )
    header = ("joint", "RMS [N·m]", "allowed RMS", "largest [N·m]", "standard deviation of the model", "largest torque")
    of_model = result.model_std.mean(axis=0), abs(result.model).max(axis=0)
    numbers = (result.rms, result.tolerance, result.max_error, *of_model)
    rows = [[name, *(f"{column[joint]:.4f}" for column in numbers)] for joint, name in enumerate(result.names)]
    section = ReportSection(FIGURE_6, html, [verify_figure(result)], [ReportTable(header, rows)])
    subtitle = f"gravity record {gravity.id} of {gravity.created:%Y-%m-%d %H:%M} UTC, {gravity.software}"
    render(path, f"Verification: {arm.name} {arm.serial}", [section], subtitle)
