"""The demo's report: one self-contained HTML page."""

from pathlib import Path

import numpy as np

from calib.report.figures import verify_figure
from calib.report.page import ReportSection as Section
from calib.report.page import ReportTable, bullets, paragraph, paragraphs, render
from sim_gap.demo.figures import drift_figure, error_bars, sweep_figure
from sim_gap.demo.show import drift_line, gap_line
from sim_gap.demo.summary import SHOWN, DemoResult
from sim_gap.report.page import sections as gap_sections


def write_report(result: DemoResult, path: Path) -> None:
    """Write the page; raises OSError."""
    parts = [_overview(result), _calibration(result), _sweeps(result), _gravity(result), _drift(result)]
    subtitle = f"simulated arm {result.run.arm}, hidden truth of seed {result.run.seed}"
    render(path, "armlink demo", [*parts, *gap_sections(result.run.gap)], subtitle)


def _overview(result: DemoResult) -> Section:
    run = result.run
    sensors, check = result.sensors, run.gravity_check
    error = np.abs(sensors.value("gain") / run.truth.gain - 1)
    loaded = check.max_torque > 1e-6
    share = check.rms_error[loaded] / check.max_torque[loaded]
    unseen = sorted({name for name, parameter in sensors.reasons if parameter == "gain"})
    items = [
        f"{run.bus.frames:,} CAN frames in {run.sim_s:.0f} s of the arm's time at {run.bus.rate_hz:.0f} Hz,"
        f" {run.bus.load:.0%} bus load, {run.bus.missed} missed; {run.wall_s:.0f} s on this machine.",
        f"Torque gains found to {np.nanmax(error):.2%} at worst"
        + (f"; not observable on {', '.join(unseen)}." if unseen else "."),
        f"Gravity torque of the identified model within {share.max():.2%} RMS of each joint's largest, at"
        f" {check.poses} random poses.",
        drift_line(run.names, result.drift) + ".",
        gap_line(run.gap) + ".",
    ]
    text = "The fit saw only what came over the bus. What is called true was opened after everything was estimated."
    return Section("In short", paragraph(text) + bullets(items))


def _calibration(result: DemoResult) -> Section:
    fit, truth = result.sensors, result.run.truth
    rows = []
    for j, name in enumerate(result.run.names):
        row = [name]
        for parameter, digits in SHOWN:
            value, (low, high) = fit.value(parameter)[j], fit.ci95(parameter)[j]
            estimate = f"{value:.{digits}f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{(high - low) / 2:.{digits}f}"
            row += [f"{getattr(truth, parameter)[j]:.{digits}f}", "not observable" if np.isnan(value) else estimate]
        rows.append(row)
    what = ("gain", "offset [N·m]", "position gain")
    header = ("joint", *(cell for name in what for cell in (f"{name}: true", "estimated ± 95 %")))
    reasons = [f"{joint}, {what.replace('_', ' ')}: {reason}" for (joint, what), reason in fit.reasons.items()]
    mass, point = max(fit.rows.masses), fit.fit.values.rho
    text = (
        f"Readings are gain · torque + offset; true angle is position gain · reading + position offset. The reference"
        f" mass of {mass:g} kg was found at ({', '.join(f'{x:.4f}' for x in point)}) m in the last link's frame;"
        f" it hung at ({', '.join(f'{x:.4f}' for x in truth.attachment)}) m."
    )
    html = paragraph(text) + paragraphs(reasons)
    return Section("Sensor calibration", html, [error_bars(fit, truth.gain)], [ReportTable(header, rows)])


def _sweeps(result: DemoResult) -> Section:
    text = (
        "One joint at a time turns through its range, up (▸) and down (◂), while the others are pressed on their stops."
        " Lines are the fit of all sweeps together: a sinusoid each, A sin(θ + Φ). A colour is a sweep;"
        " those with the reference mass are the larger ones."
    )
    return Section(
        "Sweeps and their sinusoids", paragraph(text), [sweep_figure(result.run.bench.described, result.sensors)]
    )


def _gravity(result: DemoResult) -> Section:
    check, verify = result.run.gravity_check, result.run.verify
    rows = [
        [name, *(f"{x:.4f}" for x in numbers)]
        for name, *numbers in zip(
            result.run.names, verify.rms, check.rms_error, check.max_abs_error, check.max_torque, strict=True
        )
    ]
    header = ("joint", "RMS, model to sensor", "RMS, model to truth", "largest error", "largest torque")
    text = f"Model torque and calibrated sensor torque at {len(verify.position)} poses that were not used for any fit."
    table = ReportTable(header, rows, f"N·m; the truth is the plant's own gravity at {check.poses} random poses.")
    return Section("Gravity model (the paper's Figure 6)", paragraph(text), [verify_figure(verify)], [table])


def _drift(result: DemoResult) -> Section:
    text = (
        "The arm went about ordinary work when one torque sensor changed. The observer compares gravity torque with the"
        " sensor at every stop, finds which joint changed and how, writes a new record and puts the controller right:"
        " no reference mass, no special motion. Estimates are against the calibration installed at that time."
    )
    line = paragraph(drift_line(result.run.names, result.drift) + ".")
    return Section("Drift and automatic recalibration", paragraph(text) + line, [drift_figure(result.drift)])
