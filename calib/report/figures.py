"""Figures of the calibration reports: sweeps with their fits, before and after, the paper's Figure 6, the observer."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.fit.calibration import rms
from calib.fit.creep_fit import CreepFit
from calib.fit.sensor_fit import SensorFit
from calib.observer.watch_loop import WatchHistory
from calib.report.page import COLOURS
from calib.sweep.verify import Verification
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

Indices = npt.NDArray[np.intp]

GREY, MARK, CURVE = "#9aa7b3", "#d9622b", "#1f5fa8"
CURVE_POINTS = 60
PANEL = 230
"""Height of a row of panels [px]."""


def sweeps_of(fit: SensorFit, joint: int) -> list[str]:
    """Names of a joint's sweeps, as PASS/sweep, in the order of measurement."""
    series = fit.rows.readings.series[fit.rows.swept == joint]
    return [fit.rows.sweeps[sweep] for sweep in dict.fromkeys(series.tolist())]


def sweep_rows(fit: SensorFit, joint: int, sweep: str) -> Indices:
    at = np.flatnonzero((fit.rows.swept == joint) & (fit.rows.readings.series == fit.rows.sweeps.index(sweep)))
    return at[np.argsort(fit.rows.readings.position[at, joint])]


def joint_figure(arm: Arm, fit: SensorFit, joint: int) -> Any:
    """One joint's sweeps, up (▸) and down (◂): readings with the fitted curve, and residuals with 95 % intervals."""
    titles, readings = ("sensor reading [N·m]", "reading minus fit [N·m]"), fit.rows.readings
    figure = make_subplots(rows=1, cols=2, column_widths=[0.58, 0.42], subplot_titles=titles, horizontal_spacing=0.1)
    for colour, sweep in enumerate(sweeps_of(fit, joint)):
        at = sweep_rows(fit, joint, sweep)
        x, y, left = readings.position[at, joint], readings.torque[at, joint], fit.fit.residual[at, joint]
        place = {"name": sweep, "legendgroup": sweep, "row": 1}
        paint = COLOURS[colour % len(COLOURS)]
        symbol = np.where(readings.direction[at, joint] > 0, "triangle-right", "triangle-left")
        marker = {"color": paint, "size": 7, "symbol": symbol}
        angle, reading = curve(arm, fit, at, joint)
        line = {"color": paint, "width": 1.5}
        figure.add_scatter(x=angle, y=reading, mode="lines", line=line, col=1, showlegend=False, **place)
        figure.add_scatter(x=x, y=y, mode="markers", marker=marker, col=1, **place)
        half = 1.96 * readings.sigma[at, joint] * fit.noise_factor[joint]
        bars = {"type": "data", "array": half, "thickness": 1, "width": 2}
        figure.add_scatter(x=x, y=left, error_y=bars, mode="markers", marker=marker, col=2, showlegend=False, **place)
    figure.update_xaxes(title_text="position reading [rad]")
    return figure.update_layout(height=330, legend={"orientation": "h", "y": -0.28, "x": 0}, margin={"t": 40})


def curve(arm: Arm, fit: SensorFit, rows: Indices, joint: int) -> tuple[Array, Array]:
    """(Position, reading) of the fitted model over the range of one sweep's rows."""
    readings = fit.rows.readings
    position = np.repeat(readings.position[rows].mean(axis=0)[None], CURVE_POINTS, axis=0)
    position[:, joint] = np.linspace(
        readings.position[rows[0], joint], readings.position[rows[-1], joint], CURVE_POINTS
    )
    asked = StaticReadings.of(position, np.zeros_like(position), 1.0, readings.load[rows[0]])
    return position[:, joint], predict(arm, fit.fit.complete, asked)[:, joint]


def creep_figure(fit: CreepFit) -> Any:
    """Creeps of each joint, up (▸) and down (◂), a colour a sweep of one pass: readings over position with the fit."""
    n, rows = len(fit.names), fit.rows
    figure = make_subplots(rows=n, cols=1, subplot_titles=[f"{name}: reading [N·m]" for name in fit.names])
    for joint in range(n):
        own, place = np.flatnonzero(rows.swept == joint), {"row": joint + 1, "col": 1, "showlegend": False}
        for number, sweep in enumerate(np.unique(rows.readings.series[own])):
            paint = COLOURS[number % len(COLOURS)]
            for side, symbol in ((1.0, "triangle-right"), (-1.0, "triangle-left")):
                at = own[(rows.readings.series[own] == sweep) & (rows.side[own] == side)]
                at = at[np.argsort(rows.readings.position[at, joint])]
                x, y, marker = rows.readings.position[at, joint], rows.reading[at], {"symbol": symbol, "color": paint}
                figure.add_scatter(x=x, y=y, mode="markers", marker=marker, **place)
                figure.add_scatter(x=x, y=y - fit.solution.residual[at], mode="lines", line={"color": GREY}, **place)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    return figure.update_layout(height=PANEL * n + 80)


def before_after_figure(names: tuple[str, ...], before: Array, after: Array, label: str) -> Any:
    """RMS of calibrated minus model torque per joint (n,) [N·m], with the old and with the new calibration."""
    figure = go.Figure()
    figure.add_bar(x=list(names), y=before, name=label, marker_color=GREY)
    figure.add_bar(x=list(names), y=after, name="this calibration", marker_color=COLOURS[0])
    figure.update_yaxes(title_text="RMS [N·m], logarithmic", type="log", dtick=1, exponentformat="none")
    return figure.update_layout(
        barmode="group", height=330, legend={"orientation": "h", "y": 1.12, "x": 0}, margin={"t": 40}
    )


def left_out_figure(names: tuple[str, ...], sensor: Array, model: Array) -> Any:
    """As the paper's Figure 6: torque (K, n) [N·m] over the number of the reading; NaN is left out."""
    error = sensor - model
    return _panels(
        [f"{name}, RMS {value:.3g} N·m" for name, value in zip(names, rms(error), strict=True)],
        [(model[keep, j], sensor[keep, j]) for j, keep in enumerate(np.isfinite(error.T))],
        "number of the reading",
    )


def verify_figure(check: Verification) -> Any:
    """The paper's Figure 6: torque over pose number, model solid, sensor dashed, one panel per joint."""
    return _panels(
        [f"{name}, RMS {value:.3g} N·m" for name, value in zip(check.names, check.rms, strict=True)],
        [(check.model[:, j], check.sensor[:, j]) for j in range(len(check.names))],
        "pose number",
    )


def watch_figure(
    history: WatchHistory, joint: int, truth: tuple[Sequence[float], Array], marks: Sequence[tuple[float, str]]
) -> Any:
    """The observer's gain and offset of a joint over time with 95 % bands, and what happened when.

    `truth` is times (K,) and true values (2, K).
    """
    t, figure = np.array(history.t), make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    for row, (name, title) in enumerate((("gain", "gain"), ("offset", "offset [N·m]"))):
        value, std = (np.array(getattr(history, key))[:, joint] for key in (name, f"{name}_std"))
        place = {"showlegend": row == 0, "row": row + 1, "col": 1}
        band = np.concatenate([value + 1.96 * std, (value - 1.96 * std)[::-1]])
        paint = {"fill": "toself", "fillcolor": "rgba(31,95,168,0.18)", "line": {"width": 0}, "hoverinfo": "skip"}
        figure.add_scatter(x=np.concatenate([t, t[::-1]]), y=band, name="95 % interval", **paint, **place)
        figure.add_scatter(x=t, y=value, name="observer", line={"color": CURVE}, **place)
        figure.add_scatter(x=truth[0], y=truth[1][row], name="truth", line={"color": GREY, "dash": "dot"}, **place)
        figure.update_yaxes(title_text=title, row=row + 1, col=1)
    anchor = {"showarrow": False, "xanchor": "left", "yanchor": "bottom", "y": 1.0, "yref": "y domain"}
    for when, text in marks:
        figure.add_vline(x=when, line={"color": MARK, "width": 1}, row="all", col=1)
        figure.add_annotation(x=when, text=text, **anchor)
    figure.update_xaxes(title_text="link time [s]", row=2)
    return figure.update_layout(height=520, legend={"orientation": "h", "y": 1.1, "x": 0})


def _panels(titles: list[str], pairs: list[tuple[Array, Array]], along: str) -> Any:
    rows = (len(pairs) + 1) // 2
    figure = make_subplots(rows=rows, cols=2, subplot_titles=titles, vertical_spacing=0.3 / rows)
    for joint, pair in enumerate(pairs):
        place = {"row": joint // 2 + 1, "col": joint % 2 + 1}
        for name, y, dash, colour in zip(("model", "sensor"), pair, ("solid", "dash"), COLOURS, strict=False):
            line = {"color": colour, "width": 2, "dash": dash}
            first = {"legendgroup": name, "showlegend": joint == 0}
            number = np.arange(1, len(y) + 1)
            figure.add_scatter(x=number, y=y, mode="lines", name=name, line=line, **first, **place)
    figure.update_xaxes(title_text=along, row=rows)
    figure.update_yaxes(title_text="N·m", col=1)
    above = 1 + 55 / (PANEL * rows)  # over the first row's titles
    return figure.update_layout(
        height=PANEL * rows + 120, legend={"orientation": "h", "y": above, "x": 0}, margin={"t": 80}
    )
