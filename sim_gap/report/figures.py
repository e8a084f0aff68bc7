"""Figures of a diagnosis: gap before and after; residual and fit over velocity, position, load and time."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from gcomp.arrays import Array, Mask
from sim_gap.attribution.diagnosis import Diagnosis, Rollout
from sim_gap.residuals.residual_set import ResidualSet

GREY, ORANGE, BLUE, LIGHT = "#9aa7b3", "#d9622b", "#1f5fa8", "#cfd8e0"
BELOW_TITLE = {"orientation": "h", "y": 1.02, "x": 1, "xanchor": "right", "yanchor": "bottom"}
"""Place of a figure's legend."""


def gap_bars(answer: Diagnosis) -> Any:
    """Bars per joint: RMS before and after on held-out data, noise floor as a line; logarithmic."""
    figure = go.Figure()
    names = list(answer.names)
    for label, values, colour in (("before", answer.heldout_before, LIGHT), ("after", answer.heldout_after, BLUE)):
        text = [f"{v:.3g}" for v in values]
        figure.add_bar(
            name=label, x=names, y=values, marker_color=colour, text=text, textposition="outside", cliponaxis=False
        )
    marker = {"symbol": "line-ew-open", "size": 34, "color": ORANGE, "line": {"width": 2}}
    figure.add_scatter(name="noise floor", x=names, y=answer.noise_floor, mode="markers", marker=marker)
    top = float(np.nanmax(answer.heldout_before)) * 2.0
    low = float(max(np.nanmin(np.concatenate([answer.noise_floor, answer.heldout_after])) / 3.0, top * 1e-6))
    figure.update_yaxes(type="log", title=f"RMS [{answer.unit}]", range=[np.log10(low), np.log10(top)], dtick=1)
    figure.update_layout(title="Gap on held-out data", barmode="group", height=380, legend=BELOW_TITLE)
    return figure


def rollout_bars(names: tuple[str, ...], rollout: Rollout) -> Any:
    """Bars per joint: position gap of the forward simulation before and after."""
    figure = go.Figure()
    for label, values, colour in (("before", rollout.before, LIGHT), ("after", rollout.after, BLUE)):
        figure.add_bar(
            name=label,
            x=list(names),
            y=values,
            marker_color=colour,
            text=[f"{v:.2g}" for v in values],
            textposition="outside",
            cliponaxis=False,
        )
    figure.update_yaxes(title="RMS [rad]", type="log", dtick=1)
    figure.update_layout(
        title=f"Position gap of the forward simulation over {rollout.horizon_s:.2g} s",
        height=340,
        barmode="group",
        legend=BELOW_TITLE,
    )
    return figure


def residual_panels(answer: Diagnosis, channel: str) -> Any:
    """One row per joint: residual of `channel` over velocity, position, load and time; None without valid samples."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    explained = estimate.predict(data) if estimate is not None else None
    joints = [j for j in range(data.layout.n) if data.valid[channel, j].sum() > 10]
    if not joints:
        return None
    columns = [("velocity [rad/s]", "v"), ("position [rad]", "q"), ("model torque [N·m]", "model")]
    titles = [name for j in joints for name in (answer.names[j], *[""] * len(columns))]
    figure = make_subplots(
        rows=len(joints),
        cols=len(columns) + 1,
        subplot_titles=titles,
        vertical_spacing=0.32 / len(joints),
        horizontal_spacing=0.04,
        shared_yaxes=True,
    )
    sides = [stack(data, name) for _, name in columns]
    for line, j in enumerate(joints, start=1):
        chosen = drawn_samples(data.valid[channel, j])
        left, fit = data.values[channel, j][chosen], None if explained is None else explained[channel, j][chosen]
        for column, x in enumerate((*(side[:, j] for side in sides), data.time), start=1):
            _panel(figure, line, column, x[chosen], left, fit)
    for column, label in enumerate((*(label for label, _ in columns), "time [s]"), start=1):
        figure.update_xaxes(title_text=label, row=len(joints), col=column)
    figure.update_yaxes(title_text="N·m", col=1)
    figure.update_annotations(font_size=13, x=0, xanchor="left")
    figure.update_layout(height=90 + 210 * len(joints), showlegend=False)
    return figure


def stack(data: ResidualSet, name: str) -> Array:
    """A quantity of the signals (`v`, `q`, `a`, `model`) at the rate of the comparison, concatenated, (K, n)."""
    return np.concatenate([s.filtered(getattr(s, name)) for s in data.signals])


def drawn_samples(valid: Mask) -> NDArray[np.intp]:
    """Indices of the samples that are drawn: some hundreds of the valid ones."""
    rows = np.flatnonzero(valid)
    return rows[:: max(1, len(rows) // 600)]


def _panel(figure: Any, row: int, column: int, x: Array, residual: Array, explained: Array | None) -> None:
    for values, colour, size, name in ((residual, GREY, 4, "residual"), (explained, ORANGE, 3, "explained")):
        if values is not None:
            marker = {"color": colour, "size": size, "opacity": 0.75}
            figure.add_trace(
                go.Scatter(x=x.round(4), y=values.round(4), mode="markers", marker=marker, name=name),
                row=row,
                col=column,
            )
