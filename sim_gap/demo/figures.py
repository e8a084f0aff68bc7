"""Figures of the demo's report: sweeps with their fits, Figure 6 of the paper, drift over time."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.fit.sensor_fit import SensorFit
from calib.report.figures import COLOURS, GREY, PANEL, add_sweeps
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from sim_gap.demo.drift import Drift

RED = "#a83248"


def sweep_figure(arm: Arm, fit: SensorFit) -> Any:
    """Per joint: readings of its sweeps over position with the fitted curve, and what the fit leaves."""
    n = len(fit.names)
    titles = [title for name in fit.names for title in (f"{name}: sensor [N·m]", f"{name}: residual [N·m]")]
    figure = make_subplots(rows=n, cols=2, column_widths=[0.62, 0.38], subplot_titles=titles, vertical_spacing=0.25 / n)
    for row in range(n):
        add_sweeps(figure, arm, fit, row, row=row + 1, intervals=False)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    return figure.update_layout(height=PANEL * n + 80, showlegend=False)


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
