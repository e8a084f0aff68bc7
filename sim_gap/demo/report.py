"""The demo's report as one self-contained HTML page."""

from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.creep.fit import CreepFit
from calib.creep.record import HEADINGS
from calib.fit.sensor_fit import SensorFit
from calib.report.figures import COLOURS, GREY, PANEL, add_sweeps, verify_figure
from calib.report.page import ReportSection as Section
from calib.report.page import ReportTable, bullets, paragraph, paragraphs, render
from gcomp.arrays import Array
from sim_gap.demo.drift import DriftCourse
from sim_gap.demo.result import DemoResult
from sim_gap.demo.tables import ABSENT, CREEP_DIGITS, SENSOR_DIGITS, creep_cell
from sim_gap.report.effect_text import sentence
from sim_gap.report.page import sections as gap_sections


def write_report(result: DemoResult, path: Path) -> None:
    """Write the page; raises OSError."""
    if isinstance(result.sensors, SensorFit):
        parts = [_sensor_calibration(result, result.sensors), _sweeps(result, result.sensors)]
    else:
        parts = [_drive_calibration(result, result.sensors.fit), _creeps(result, result.sensors.fit)]
    parts = [_overview(result), *parts, _gravity(result)]
    if result.drift is not None:
        parts.append(_drift(result.names, result.drift))
    subtitle = f"simulated arm {result.bench.arm.name}, hidden truth of seed {result.seed}"
    render(path, "armlink demo", [*parts, *gap_sections(result.gap)], subtitle)


def _overview(result: DemoResult) -> Section:
    check, bus, sensors, sag = result.gravity_check, result.bus, result.sensors, result.sag
    loaded = check.max_torque > 1e-6
    share = check.rms_error[loaded] / check.max_torque[loaded]
    text = "The fit saw only what came over the bus. What is called true was opened after everything was estimated."
    frames = f"{bus.frames:,} CAN frames in {result.sim_s:.0f} s of the arm's time at {bus.rate_hz:.0f} Hz"
    within = f"within {share.max():.2%} RMS of each joint's largest, at {check.poses}"
    if isinstance(sensors, SensorFit):
        error = np.abs(sensors.value("gain") / result.truth.gain - 1)
        unseen = sorted({name for name, parameter in sensors.reasons if parameter == "gain"})
        items = [
            f"{frames}, {bus.load:.0%} bus load, {bus.missed} missed; {result.wall_s:.0f} s on this machine.",
            f"Torque gains found to {np.nanmax(error):.2%} at worst",
            f"Gravity torque of the identified model {within} random poses.",
        ]
    else:
        text = (
            "This arm has no torque sensors: each drive reports current times a torque constant that is wrong. " + text
        )
        seen = sensors.fit.found("gain")
        error = np.abs(sensors.fit.value("gain") / result.truth.gain - 1)[seen]
        unseen = [name for name, found in zip(result.names, seen, strict=True) if not found]
        items = [
            f"{frames}; {result.wall_s:.0f} s on this machine.",
            f"Torque constants found to {float(error.max(initial=0.0)):.2%} at worst",
            f"Gravity torque in true N·m {within} poses.",
        ]
    items[1] += f"; {ABSENT} on {', '.join(unseen)}." if unseen else "."
    if sag is not None:
        before, after = (np.degrees(each.max()) for each in (sag.nominal, sag.calibrated))
        items.append(f"Held by a tenth of the gains, the worst joint sags by {after:.1f}° instead of {before:.1f}°.")
    if result.drift is not None:
        items.append(result.drift.sentence(result.names) + ".")
    items.append(sentence(result.gap) + ".")
    return Section("In short", paragraph(text) + bullets(items))


def _sensor_calibration(result: DemoResult, fit: SensorFit) -> Section:
    truth, rows = result.truth, []
    for j, name in enumerate(result.names):
        row = [name]
        for parameter, digits in SENSOR_DIGITS.items():
            value, (low, high) = fit.value(parameter)[j], fit.ci95(parameter)[j]
            estimate = f"{value:.{digits}f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{(high - low) / 2:.{digits}f}"
            row += [f"{getattr(truth, parameter)[j]:.{digits}f}", ABSENT if np.isnan(value) else estimate]
        rows.append(row)
    names = ("gain", "offset [N·m]", "position gain")
    header = ("joint", *(cell for name in names for cell in (f"{name}: true", "estimated ± 95 %")))
    mass, point = max(fit.rows.masses), fit.fit.values.rho
    text = (
        f"Readings are gain · torque + offset; true angle is position gain · reading + position offset. The reference"
        f" mass of {mass:g} kg was found at ({', '.join(f'{x:.4f}' for x in point)}) m in the last link's frame;"
        f" it hung at ({', '.join(f'{x:.4f}' for x in truth.attachment)}) m."
    )
    html = paragraph(text) + paragraphs(_reasons(result))
    return Section("Sensor calibration", html, [_error_bars(fit, truth.gain)], [ReportTable(header, rows)])


def _drive_calibration(result: DemoResult, fit: CreepFit) -> Section:
    rows = [
        [name, f"{result.truth.gain[j]:.4f}", *(creep_cell(fit, family, j) for family in CREEP_DIGITS)]
        for j, name in enumerate(result.names)
    ]
    header = ("joint", "true reading per N·m", *(HEADINGS[family] for family in CREEP_DIGITS))
    text = "Estimated ± half of the 95 % interval. The host keeps these values and corrects readings and commands."
    html = paragraph(text) + paragraphs([*_reasons(result), *fit.findings])
    return Section("Torque constants, zeros and friction", html, [], [ReportTable(header, rows)])


def _reasons(result: DemoResult) -> list[str]:
    reasons = result.sensors.reasons.items()
    return [f"{joint}, {parameter.replace('_', ' ')}: {reason}" for (joint, parameter), reason in reasons]


def _sweeps(result: DemoResult, fit: SensorFit) -> Section:
    """Of each joint: readings over position with the fitted curve, and what the fit leaves."""
    text = (
        "One joint at a time turns through its range, up (▸) and down (◂), while the others are pressed on their stops."
        " Lines are the fit of all sweeps together: a sinusoid each, A sin(θ + Φ). A colour is a sweep;"
        " those with the reference mass are the larger ones."
    )
    n = len(fit.names)
    titles = [title for name in fit.names for title in (f"{name}: sensor [N·m]", f"{name}: residual [N·m]")]
    figure = make_subplots(rows=n, cols=2, column_widths=[0.62, 0.38], subplot_titles=titles, vertical_spacing=0.25 / n)
    for row in range(n):
        add_sweeps(figure, result.bench.described, fit, row, row=row + 1, intervals=False)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    figure.update_layout(height=PANEL * n + 80, showlegend=False)
    return Section("Sweeps and their sinusoids", paragraph(text), [figure])


def _creeps(result: DemoResult, fit: CreepFit) -> Section:
    text = (
        "One joint at a time creeps through its range, up (▸) and down (◂). Half the sum of both ways is gravity, half"
        " the difference friction. Lines are the fit of all sweeps together; a colour is a sweep of one pass."
    )
    n, rows, residual = len(result.names), fit.rows, fit.solution.residual
    figure = make_subplots(rows=n, cols=1, subplot_titles=[f"{name}: reading [N·m]" for name in result.names])
    for joint in range(n):
        own = np.flatnonzero(rows.joint == joint)
        place = {"row": joint + 1, "col": 1, "showlegend": False}
        for number, sweep in enumerate(np.unique(rows.sweep[own])):
            colour = COLOURS[number % len(COLOURS)]
            for side, symbol in ((1.0, "triangle-right"), (-1.0, "triangle-left")):
                each = own[(rows.sweep[own] == sweep) & (rows.side[own] == side)]
                each = each[np.argsort(rows.position[each, joint])]
                x, y, marker = rows.position[each, joint], rows.reading[each], {"symbol": symbol, "color": colour}
                figure.add_scatter(x=x, y=y, mode="markers", marker=marker, **place)
                line = {"color": GREY, "width": 1}
                figure.add_scatter(x=x, y=y - residual[each], mode="lines", line=line, **place)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    return Section("Creep sweeps", paragraph(text), [figure.update_layout(height=PANEL * n + 80)])


def _gravity(result: DemoResult) -> Section:
    check, verify, sag, poses = result.gravity_check, result.verify, result.sag, len(result.verify.position)
    if result.creep is None:
        title = "Gravity model (the paper's Figure 6)"
        text = (
            f"Model torque and calibrated sensor torque at {len(verify.position)} poses that were not used for any fit."
        )
        header = ["joint", "RMS, model to sensor", "RMS, model to truth", "largest error", "largest torque"]
        columns = [verify.rms, check.rms_error, check.max_abs_error, check.max_torque]
    else:
        title = "Gravity model"
        text = f"Model torque and half sums of short creeps at {poses} poses that were not used for any fit."
        header = ["joint", "RMS, model to half sums", "RMS, model to truth", "largest torque"]
        columns = [verify.rms, check.rms_error, check.max_torque]
    if sag is not None:
        columns += [np.degrees(sag.nominal), np.degrees(sag.calibrated)]
        header += ["sag, nominal model [°]", "sag, calibrated [°]"]
    rows = [[name, *(f"{column[j]:.4f}" for column in columns)] for j, name in enumerate(result.names)]
    table = ReportTable(header, rows, f"N·m; the truth is the plant's own gravity at {check.poses} random poses.")
    return Section(title, paragraph(text), [verify_figure(verify)], [table])


def _drift(names: tuple[str, ...], drift: DriftCourse) -> Section:
    text = (
        "The arm went about ordinary work when one torque sensor changed. The observer compares gravity torque with the"
        " sensor at every stop, finds which joint changed and how, writes a new record and puts the controller right:"
        " no reference mass, no special motion. Estimates are against the calibration installed at that time."
    )
    html = paragraph(text) + paragraph(drift.sentence(names) + ".")
    return Section("Drift and automatic recalibration", html, [_drift_figure(drift)])


def _drift_figure(drift: DriftCourse) -> Any:
    """Estimated gain and offset of the drifting joint over time with 95 % bands, the truth, and what happened when."""
    history, joint, red = drift.history, drift.joint, "#a83248"
    t = np.array(history.t)
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    put_right = drift.recalibrated or t[-1]
    ends = [t[0], drift.began, drift.began, put_right, put_right, t[-1]]
    for row, (name, unit, nominal) in enumerate((("gain", "gain", 1.0), ("offset", "offset [N·m]", 0.0)), start=1):
        value = np.array(getattr(history, name))[:, joint]
        half = 1.96 * np.array(getattr(history, f"{name}_std"))[:, joint]
        true = nominal + np.repeat([0.0, drift.error_before[row - 1], drift.error_after[row - 1]], 2)
        place = {"showlegend": row == 1, "row": row, "col": 1}
        band = np.concatenate([value + half, (value - half)[::-1]])
        paint = {"fill": "toself", "fillcolor": "rgba(31,95,168,0.18)", "line": {"width": 0}, "hoverinfo": "skip"}
        figure.add_scatter(x=np.concatenate([t, t[::-1]]), y=band, name="95 % interval", **paint, **place)
        figure.add_scatter(x=t, y=value, name="observer", line={"color": COLOURS[0]}, **place)
        figure.add_scatter(x=ends, y=true, name="truth", line={"color": GREY, "dash": "dot"}, **place)
        figure.update_yaxes(title_text=unit, row=row, col=1)
    noticed = "not noticed" if drift.detected is None else f"noticed {drift.detected - drift.began:.1f} s later"
    marks = [(drift.began, f"drifts, {noticed}")]
    marks += [] if drift.recalibrated is None else [(drift.recalibrated, "recalibrated")]
    for when, text in marks:
        figure.add_vline(x=when, line={"color": red, "width": 1}, row="all", col=1)
        anchor = {"showarrow": False, "xanchor": "left", "yanchor": "bottom"}
        figure.add_annotation(x=when, y=1.0, yref="y domain", text=text, **anchor)
    figure.update_xaxes(title_text="link time [s]", row=2)
    return figure.update_layout(height=520, legend={"orientation": "h", "y": 1.1, "x": 0})


def _error_bars(fit: SensorFit, truth: Array) -> Any:
    """Gain error of each joint with its 95 % interval, in per cent."""
    value, interval = fit.value("gain"), fit.ci95("gain")
    marker, error = {"size": 9, "color": COLOURS[0]}, 100 * (interval[:, 1] - value) / np.abs(truth)
    figure = go.Figure()
    figure.add_scatter(
        x=list(fit.names),
        y=100 * (value / truth - 1),
        mode="markers",
        marker=marker,
        error_y={"array": error, "width": 6},
    )
    figure.add_hline(y=0, line={"color": GREY})
    figure.update_yaxes(title_text="gain error [%]")
    return figure.update_layout(height=300, title="Torque gain: estimate against the truth, with 95 % interval")
