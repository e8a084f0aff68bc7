"""Held-out data over time, a row a joint: measured, nominal and corrected, each effect left out; a drift over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from plotly.subplots import make_subplots

from calib.observer.watch_loop import WatchHistory
from calib.report.figures import GREY
from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.report.cause_figures import is_of
from sim_gap.report.figures import BELOW_TITLE, BLUE, ORANGE

SHOWN_S = 15.0
"""Length of the data that are shown [s]."""
MOST_LEFT_OUT = 6
"""Causes without which the corrected model is drawn too."""
COLOURS = ("#2e8b57", "#8e5ea2", "#b8860b", "#c2527a", "#3b9aa8", "#7a7a3a")
"""Of the lines without one effect."""

Line = tuple[str, Array, str, bool]
"""Name, values (K, n), colour, and whether it is shown before its name is clicked."""


def lines_without_each(names: Sequence[str], values: Sequence[Array]) -> list[Line]:
    """Lines of the corrected model without one effect each, hidden at first."""
    return [
        (f"without {name}", each, colour, False) for name, each, colour in zip(names, values, COLOURS, strict=False)
    ]


def lines_over_time(t: Array, names: Sequence[str], lines: Sequence[Line], unit: str) -> Any:
    """A figure with one row a joint; `t` from 0 (K,), of which some hundred points are drawn."""
    rows = len(names)
    figure = make_subplots(
        rows=rows, cols=1, shared_xaxes=True, subplot_titles=list(names), vertical_spacing=0.2 / rows
    )
    every = max(1, len(t) // 750)
    for label, values, colour, shown in lines:
        for j in range(rows):
            figure.add_scatter(
                x=t[::every].round(3),
                y=np.asarray(values)[::every, j].round(5),
                name=label,
                legendgroup=label,
                showlegend=j == 0,
                visible=True if shown else "legendonly",
                line={"color": colour, "width": 1.4},
                row=j + 1,
                col=1,
            )
    figure.update_yaxes(title=unit)
    figure.update_xaxes(title="time [s]", row=rows, col=1)
    figure.update_layout(height=120 + 190 * rows, legend=BELOW_TITLE)
    return figure


def torque_over_time(answer: Diagnosis, channel: str) -> Any:
    """A torque channel along the first held-out recording; None if no joint has valid samples."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    first, count = data.signals[0], data.lengths[0]
    rows = [(channel, j) for j in range(data.layout.n) if data.valid[channel, j][:count].sum() > 10]
    shown = np.flatnonzero(data.time[:count] <= data.time[0] + SHOWN_S)
    if not rows:
        return None

    def stacked(values: dict[tuple[str, int], Array]) -> Array:
        return np.stack([values[row][shown] for row in rows], axis=1)

    measured = first.filtered(first.reading[channel])[shown][:, [j for _, j in rows]]
    nominal = measured - stacked(data.values)
    lines: list[Line] = [("measured", measured, "black", True), ("nominal", nominal, ORANGE, True)]
    if estimate is not None:
        corrected = nominal + stacked(estimate.predict(data))
        lines.append(("corrected", corrected, BLUE, True))
        kept: dict[str, Array] = {}
        for cause in answer.causes[:MOST_LEFT_OUT]:
            own = tuple(term for term in estimate.terms if is_of(term, cause, answer.names))
            share = stacked(estimate.predict(data, terms=own))
            kept[cause.effect] = kept.get(cause.effect, corrected) - share
        lines += lines_without_each(list(kept), list(kept.values()))
    t = data.time[shown] - data.time[0]
    return lines_over_time(t, [answer.names[j] for _, j in rows], lines, "N·m")


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
        figure.add_scatter(x=t, y=value, name="observer", line={"color": BLUE}, **place)
        figure.add_scatter(x=truth[0], y=truth[1][row], name="truth", line={"color": GREY, "dash": "dot"}, **place)
        figure.update_yaxes(title_text=title, row=row + 1, col=1)
    anchor = {"showarrow": False, "xanchor": "left", "yanchor": "bottom", "y": 1.0, "yref": "y domain"}
    for when, text in marks:
        figure.add_vline(x=when, line={"color": ORANGE, "width": 1}, row="all", col=1)
        figure.add_annotation(x=when, text=text, **anchor)
    figure.update_xaxes(title_text="link time [s]", row=2)
    return figure.update_layout(height=520, legend={"orientation": "h", "y": 1.1, "x": 0})
