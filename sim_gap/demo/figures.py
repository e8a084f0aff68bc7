"""Figures of the demo's report: sweeps with their fits, Figure 6 of the paper, drift over time."""

from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.sensors import SensorFit
from calib.verify import Verification
from gcomp.arm import Arm
from gcomp.readings import Readings
from gcomp.sensor_model import predict
from sim_gap.demo.drift import Drift

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

COLOURS = ("#1f5fa8", "#d9622b", "#3c8d5a", "#8a4fa3", "#b8912b", "#4f7f95", "#a83248", "#5b6b7a")
GREY, RED = "#9aa7b3", "#a83248"
CURVE_POINTS = 60
PANEL = 230
"""Height of a row of panels [px]."""


def sweep_figure(arm: Arm, fit: SensorFit) -> Any:
    """Per joint: readings of its sweeps over position with the fitted curve, and what the fit leaves."""
    n = len(fit.names)
    titles = [title for name in fit.names for title in (f"{name}: sensor [N·m]", f"{name}: residual [N·m]")]
    figure = make_subplots(rows=n, cols=2, column_widths=[0.62, 0.38], subplot_titles=titles, vertical_spacing=0.25 / n)
    for row in range(n):
        _sweeps_of_joint(figure, arm, fit, row)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    return figure.update_layout(height=PANEL * n + 80, showlegend=False)


def _sweeps_of_joint(figure: Any, arm: Arm, fit: SensorFit, joint: int) -> None:
    rows = fit.rows
    for colour, sweep in enumerate(dict.fromkeys(np.array(rows.sweep)[rows.swept == joint].tolist())):
        at = np.flatnonzero((rows.swept == joint) & (np.array(rows.sweep) == sweep))
        at = at[np.argsort(rows.readings.position[at, joint])]
        x, y = rows.readings.position[at, joint], rows.readings.torque[at, joint]
        left, up = fit.fit.residual[at, joint], rows.direction[at] > 0
        place = {"name": sweep, "row": joint + 1}
        paint = COLOURS[colour % len(COLOURS)]
        marker = {"color": paint, "size": 7, "symbol": np.where(up, "triangle-right", "triangle-left")}
        angle, reading = _curve(arm, fit, at, joint)
        figure.add_scatter(x=angle, y=reading, mode="lines", line={"color": paint, "width": 1.5}, col=1, **place)
        figure.add_scatter(x=x, y=y, mode="markers", marker=marker, col=1, **place)
        figure.add_scatter(x=x, y=left, mode="markers", marker=marker, col=2, **place)


def _curve(arm: Arm, fit: SensorFit, rows: Indices, joint: int) -> tuple[Array, Array]:
    """(Position, reading) of the fitted model between the first and the last of one sweep's rows."""
    readings = fit.rows.readings
    position = np.repeat(readings.position[rows].mean(axis=0)[None], CURVE_POINTS, axis=0)
    position[:, joint] = np.linspace(
        readings.position[rows[0], joint], readings.position[rows[-1], joint], CURVE_POINTS
    )
    asked = Readings.of(position, np.zeros_like(position), 1.0, readings.load[rows[0]])
    return position[:, joint], predict(arm, fit.fit.complete, asked)[:, joint]


def verify_figure(check: Verification) -> Any:
    """The paper's Figure 6: pose number against torque, model solid, sensor dashed, a panel a joint."""
    n = len(check.names)
    titles = [f"{name}, RMS {rms:.3f} N·m" for name, rms in zip(check.names, check.rms, strict=True)]
    rows = (n + 1) // 2
    figure = make_subplots(rows=rows, cols=2, subplot_titles=titles, vertical_spacing=0.3 / rows)
    number = np.arange(1, len(check.position) + 1)
    for joint in range(n):
        place = {"row": joint // 2 + 1, "col": joint % 2 + 1}
        for name, y, dash, colour in (
            ("model", check.model, "solid", COLOURS[0]),
            ("sensor", check.sensor, "dash", COLOURS[1]),
        ):
            line = {"color": colour, "width": 2, "dash": dash}
            first = {"legendgroup": name, "showlegend": joint == 0}
            figure.add_scatter(x=number, y=y[:, joint], name=name, line=line, **first, **place)
    figure.update_xaxes(title_text="pose number", row=rows)
    figure.update_yaxes(title_text="N·m", col=1)
    return figure.update_layout(height=PANEL * rows + 90, legend={"orientation": "h", "y": 1.06, "x": 0})


def drift_figure(drift: Drift) -> Any:
    """Estimated gain and offset of the drifting joint over time with 95 % bands, the truth, and what happened when."""
    history, joint = drift.history, drift.joint
    t = np.array(history.t)
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    put_right = drift.recalibrated or t[-1]
    ends = [t[0], drift.began, drift.began, put_right, put_right, t[-1]]
    for row, (name, unit, nominal) in enumerate((("gain", "gain", 1.0), ("offset", "offset [N·m]", 0.0)), start=1):
        value = np.array(getattr(history, name))[:, joint]
        half = 1.96 * np.array(getattr(history, f"{name}_std"))[:, joint]
        true = nominal + np.repeat([0.0, drift.error_before[row - 1], drift.error_after[row - 1]], 2)
        place = {"showlegend": row == 1, "row": row, "col": 1}
        figure.add_scatter(
            x=np.concatenate([t, t[::-1]]),
            y=np.concatenate([value + half, (value - half)[::-1]]),
            fill="toself",
            fillcolor="rgba(31,95,168,0.18)",
            line={"width": 0},
            hoverinfo="skip",
            name="95 % interval",
            **place,
        )
        figure.add_scatter(x=t, y=value, name="observer", line={"color": COLOURS[0]}, **place)
        figure.add_scatter(x=ends, y=true, name="truth", line={"color": GREY, "dash": "dot"}, **place)
        figure.update_yaxes(title_text=unit, row=row, col=1)
    noticed = "not noticed" if drift.detected is None else f"noticed {drift.detected - drift.began:.1f} s later"
    marks = [(drift.began, f"drifts, {noticed}")]
    if drift.recalibrated is not None:
        marks.append((drift.recalibrated, "recalibrated"))
    for when, what in marks:
        figure.add_vline(x=when, line={"color": RED, "width": 1}, row="all", col=1)
        figure.add_annotation(
            x=when, y=1.0, yref="y domain", text=what, showarrow=False, xanchor="left", yanchor="bottom"
        )
    figure.update_xaxes(title_text="link time [s]", row=2)
    return figure.update_layout(height=520, legend={"orientation": "h", "y": 1.1, "x": 0})


def error_bars(fit: SensorFit, truth: Array) -> Any:
    """Gain error of each joint with its 95 % interval, in per cent."""
    value, interval = fit.value("gain"), fit.ci95("gain")
    figure = go.Figure()
    figure.add_scatter(
        x=list(fit.names),
        y=100 * (value / truth - 1),
        mode="markers",
        marker={"size": 9, "color": COLOURS[0]},
        error_y={"array": 100 * (interval[:, 1] - value) / np.abs(truth), "width": 6},
    )
    figure.add_hline(y=0, line={"color": GREY})
    figure.update_yaxes(title_text="gain error [%]")
    return figure.update_layout(height=300, title="Torque gain: estimate against the truth, with 95 % interval")
