"""Figures of a diagnosis: the gap in bars, residuals over what they may follow, causes, laws, and motion over time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from gcomp.arrays import Array, Mask
from sim_gap.attribution.causes import remainder
from sim_gap.attribution.diagnosis import Cause, Diagnosis, Rollout
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.position_gap.identify import Identified
from sim_gap.position_gap.training.export import WRITTEN
from sim_gap.position_gap.training.replay import (
    Simulated,
    commanded_rows,
    model_without,
    nominal,
    replay,
    simulated_model,
)
from sim_gap.report.effect_text import CHANNEL_WORDS
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square
from sim_gap.search.term import Term

GREY, ORANGE, BLUE, LIGHT = "#9aa7b3", "#d9622b", "#1f5fa8", "#cfd8e0"
BELOW_TITLE = {"orientation": "h", "y": 1.02, "x": 1, "xanchor": "right", "yanchor": "bottom"}
"""Place of a figure's legend."""
QUANTITIES = {
    "velocity": ("velocity [rad/s]", "v"),
    "position": ("position [rad]", "q"),
    "load": ("torque of the model [N·m]", "model"),
    "acceleration": ("acceleration [rad/s²]", "a"),
    "time": ("time [s]", ""),
    "temperature": ("temperature [°C]", ""),
}
"""Quantities that a residual may follow: label, and the signal that has it."""
AGAINST = {
    "friction": "velocity",
    "friction.load": "load",
    "transmission": "position",
    "transmission.elasticity": "load",
    "transmission.backlash": "load",
    "transmission.coupling": "velocity",
    "position": "position",
    "torque": "load",
    "torque.offset": "time",
    "torque.drift": "time",
    "actuator": "load",
    "actuator.rotor_inertia": "acceleration",
    "link.inertia": "acceleration",
}
"""Quantity that an effect or its family correlates with; the others follow the arm's pose and are shown over time."""
SHOWN_S = 15.0
"""Length of the data that are shown over time [s]."""
MOST_POINTS = 500
"""Points of a line over time, and samples of a residual: as many as a figure is wide, in pixels."""
COLOURS = ("#2e8b57", "#8e5ea2", "#b8860b", "#c2527a", "#3b9aa8", "#7a7a3a")
"""Of the corrected model without one effect; there are as many such lines."""
Line = tuple[str, Array, str, bool]
"""Name, values (K, n), colour, and whether it is shown before its name is clicked."""


def gap_bars(answer: Diagnosis) -> Any:
    """Bars per joint: RMS before and after on held-out data, noise floor as a line; logarithmic."""
    figure = _bars(answer.names, answer.heldout_before, answer.heldout_after, f"RMS [{answer.unit}]")
    marker = {"symbol": "line-ew-open", "size": 34, "color": ORANGE, "line": {"width": 2}}
    figure.add_scatter(name="noise floor", x=answer.names, y=answer.noise_floor, mode="markers", marker=marker)
    top = float(np.nanmax(answer.heldout_before)) * 2.0
    low = float(max(np.nanmin(np.concatenate([answer.noise_floor, answer.heldout_after])) / 3.0, top * 1e-6))
    figure.update_yaxes(range=[np.log10(low), np.log10(top)])
    return figure.update_layout(title="Gap on held-out data", height=380)


def rollout_bars(names: tuple[str, ...], rollout: Rollout) -> Any:
    title = f"Position gap of the forward simulation over {rollout.horizon_s:.2g} s"
    return _bars(names, rollout.before, rollout.after, "RMS [rad]").update_layout(title=title, height=340)


def _bars(names: tuple[str, ...], before: Array, after: Array, label: str) -> Any:
    figure = go.Figure()
    for name, values, colour in (("before", before, LIGHT), ("after", after, BLUE)):
        text = {"text": [f"{v:.3g}" for v in values], "textposition": "outside", "cliponaxis": False}
        figure.add_bar(name=name, x=names, y=values, marker_color=colour, **text)
    figure.update_yaxes(type="log", title=label, dtick=1)
    return figure.update_layout(barmode="group", legend=BELOW_TITLE)


def residual_panels(answer: Diagnosis, channel: str) -> Any:
    """One row per joint: residual of `channel` over velocity, position, load and time; None without valid samples."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    explained = estimate.predict(data)
    joints = [j for j in range(data.layout.n) if data.valid[channel, j].sum() > 10]
    if not joints:
        return None
    columns = ("velocity", "position", "load", "time")
    figure = make_subplots(
        rows=len(joints),
        cols=len(columns),
        subplot_titles=[name for j in joints for name in (answer.names[j], *[""] * (len(columns) - 1))],
        vertical_spacing=0.32 / len(joints),
        horizontal_spacing=0.04,
        shared_yaxes=True,
    )
    sides = {quantity: along(data, quantity) for quantity in columns}
    for row, j in enumerate(joints, start=1):
        chosen = _drawn_samples(data.valid[channel, j], MOST_POINTS // 2)
        for col, quantity in enumerate(columns, start=1):
            x, place = sides[quantity][chosen, j], {"row": row, "col": col}
            _add_points(figure, x, data.values[channel, j][chosen], GREY, "residual", **place)
            if estimate.terms:
                _add_points(figure, x, explained[channel, j][chosen], ORANGE, "explained", **place)
    for col, quantity in enumerate(columns, start=1):
        figure.update_xaxes(title_text=QUANTITIES[quantity][0], row=len(joints), col=col)
    figure.update_yaxes(title_text="N·m", col=1)
    figure.update_annotations(font_size=13, x=0, xanchor="left")
    return figure.update_layout(height=90 + 210 * len(joints), showlegend=False)


def _add_points(figure: Any, x: Array, y: Array, colour: str, name: str, **place: int) -> None:
    marker = {"color": colour, "size": 4 if colour == GREY else 3, "opacity": 0.75}
    figure.add_scatter(x=x, y=y, mode="markers", marker=marker, name=name, **place)


def along(data: ResidualSet, quantity: str) -> Array:
    """A quantity that a residual may follow, at the rate of the comparison, (K, n)."""
    if quantity == "time":
        return np.repeat(data.time[:, None], data.layout.n, axis=1)
    return np.concatenate([s.filtered(getattr(s, QUANTITIES[quantity][1])) for s in data.signals])


def _drawn_samples(valid: Mask, most: int = MOST_POINTS) -> Array:
    """Indices of the samples that are drawn, evenly spread over the valid ones."""
    rows = np.flatnonzero(valid)
    return np.asarray(rows[:: max(1, -(-len(rows) // most))])


# ---- causes and laws


def is_of(term: Term, cause: Cause, names: tuple[str, ...]) -> bool:
    return term.effect == cause.effect and ("arm" in cause.parameters or names[term.place] in cause.joints)


def cause_figure(answer: Diagnosis, cause: Cause) -> Any:
    """Residual less all other causes, and this cause's share, on the row where it is largest; None without one."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    whole = estimate.predict(data, terms=estimate.terms)
    own = estimate.predict(data, terms=tuple(term for term in estimate.terms if is_of(term, cause, answer.names)))
    sizes = {row: root_mean_square(own[row][data.valid[row]]) for row in data.rows if data.valid[row].sum() > 10}
    if not sizes or max(sizes.values()) == 0.0:
        return None
    channel, j = row = max(sizes, key=lambda each: sizes[each])
    quantity = AGAINST.get(cause.effect, AGAINST.get(cause.effect.split(".")[0], "time"))
    chosen = _drawn_samples(data.valid[row])
    x, figure = along(data, quantity)[chosen, j], go.Figure()
    left = (data.values[row] - whole[row] + own[row])[chosen]
    _add_points(figure, x, left, GREY, "residual minus the other causes")
    _add_points(figure, x, own[row][chosen], ORANGE, cause.effect)
    title = f"{cause.effect} at {answer.names[j]}" + (" (example)" if len(cause.joints) > 1 else "")
    return _labelled(figure, title, quantity, channel, answer.names[j])


def law_figure(answer: Diagnosis, law: ResidualLaw) -> Any:
    """Residual that the effects leave of the law's row on held-out data, over its quantity; the law with its band."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    row, joint = (law.channel, law.joint), answer.names[law.joint]
    left = remainder(data, estimate.predict(data))[row]
    if law.directed:
        left = left * np.sign(np.concatenate([s.filtered(s.direction) for s in data.signals])[:, law.joint])
    figure = go.Figure()
    if law.quantity != "temperature":
        chosen = _drawn_samples(data.valid[row])
        x = along(data, law.quantity)[chosen, law.joint]
        x = np.abs(x) if law.directed and law.quantity in ("velocity", "load") else x
        _add_points(figure, x, left[chosen], GREY, "what is left")
    ends = np.concatenate([law.at, law.at[::-1]])
    band = np.concatenate([law.torque + law.band, (law.torque - law.band)[::-1]])
    figure.add_scatter(x=ends, y=band, fill="toself", line={"width": 0}, opacity=0.3, fillcolor=ORANGE, name="band")
    figure.add_scatter(x=law.at, y=law.torque, mode="lines", line={"color": ORANGE}, name=f"law of {law.quantity}")
    against = ", against the motion" if law.directed else ""
    return _labelled(figure, f"Law of {law.quantity} of {joint}", law.quantity, law.channel, joint, against)


def _labelled(figure: Any, title: str, quantity: str, channel: str, joint: str, against: str = "") -> Any:
    figure.update_xaxes(title=QUANTITIES[quantity][0] + ("" if quantity == "time" else f" of {joint}"))
    figure.update_yaxes(title=f"{CHANNEL_WORDS[channel]} of {joint} [N·m]{against}")
    return figure.update_layout(title=title, height=340, legend=BELOW_TITLE)


# ---- over time


def _over_time(t: Array, names: Sequence[str], lines: Sequence[Line], without: Mapping[str, Array], unit: str) -> Any:
    """A figure with one row a joint: lines over `t` (K,) [s], and hidden at first the corrected model without one
    effect each."""
    rows = len(names)
    figure = make_subplots(
        rows=rows, cols=1, shared_xaxes=True, subplot_titles=list(names), vertical_spacing=0.2 / rows
    )
    hidden = [(f"without {name}", x, paint, False) for (name, x), paint in zip(without.items(), COLOURS, strict=False)]
    even = np.linspace(t[0], t[-1], min(len(t), MOST_POINTS))
    for label, values, colour, shown in (*lines, *hidden):
        for j, column in enumerate(np.asarray(values).T):
            figure.add_scatter(
                x0=0.0,
                dx=float(even[-1] - even[0]) / max(len(even) - 1, 1),
                y=np.interp(even, t, column),
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
    return figure.update_layout(height=120 + 190 * rows, legend=BELOW_TITLE)


def torque_over_time(answer: Diagnosis, channel: str) -> Any:
    """A torque channel along the first held-out recording; None if no joint has valid samples."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    first, count = data.signals[0], data.lengths[0]
    rows = [(channel, j) for j in range(data.layout.n) if data.valid[channel, j][:count].sum() > 10]
    shown = np.flatnonzero(data.time[:count] <= data.time[0] + SHOWN_S)
    if not rows:
        return None

    def stacked(values: Mapping[tuple[str, int], Array]) -> Array:
        return np.stack([values[row][shown] for row in rows], axis=1)

    measured = first.filtered(first.reading[channel])[shown][:, [j for _, j in rows]]
    predicted = measured - stacked(data.values)
    lines: list[Line] = [("measured", measured, "black", True), ("nominal", predicted, ORANGE, True)]
    without: dict[str, Array] = {}
    if estimate.terms:
        corrected = predicted + stacked(estimate.predict(data))
        lines.append(("corrected", corrected, BLUE, True))
        for cause in answer.causes[: len(COLOURS)]:
            own = tuple(term for term in estimate.terms if is_of(term, cause, answer.names))
            share = stacked(estimate.predict(data, terms=own))
            without[cause.effect] = without.get(cause.effect, corrected) - share
    return _over_time(data.time[shown], [answer.names[j] for _, j in rows], lines, without, "N·m")


def motion_figure(found: Identified, causes: Sequence[Cause] = ()) -> Any:
    """Motion along the first held-out recording's commands: measured, nominal, corrected, and without each cause; None
    without a model's file or without a command."""
    made = found.beside or found.export
    if made is None:
        return None
    recording, gain = found.recordings[0], found.gains[0]

    def moved(arm: Simulated) -> tuple[Array, Array, Array]:
        return replay(arm.with_gain(gain), recording, SHOWN_S)

    t, after, measured = moved(simulated_model(found.sim, made))
    if not len(t):
        return None
    assert recording.position_command is not None
    command = np.concatenate([recording.position_command[rows] for rows in commanded_rows(recording, SHOWN_S)])
    lines: list[Line] = [("command", command, GREY, True), ("measured", measured, "black", True)]
    if not found.search.open_controller:
        lines.append(("nominal model", moved(nominal(found.sim))[1], ORANGE, True))
    lines.append(("corrected model", after, BLUE, True))
    without = {}
    for effect in list(dict.fromkeys(c.effect for c in causes if c.effect in WRITTEN))[: len(COLOURS)]:
        own = [stage.group for stage in found.stages if stage.group[0].partition("@")[0] == effect]
        without[effect] = moved(model_without(found.sim, found.search, made, own))[1]
    return _over_time(t, found.sim.arm.names, lines, without, "rad")
