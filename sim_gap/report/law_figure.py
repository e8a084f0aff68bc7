"""A figure per law outside the library: what is left of its row, and the law with its band."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from sim_gap.attribution.causes import left_over
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.report.cause_figures import LABELS, abscissa
from sim_gap.report.effect_text import CHANNEL_WORDS
from sim_gap.report.figures import BELOW_TITLE, GREY, ORANGE, stacked, thinned


def law_figure(answer: Diagnosis, law: ResidualLaw) -> Any:
    """What the effects leave of the law's row on held-out data, over its quantity; the law with its band."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    row, joint = (law.channel, law.joint), answer.names[law.joint]
    left = (data.values if estimate is None else left_over(data, estimate.predict(data)))[row]
    if law.directed:
        left = left * np.sign(stacked(data, "direction")[:, law.joint])
    figure = go.Figure()
    if law.quantity != "temperature":
        chosen = thinned(data.valid[row])
        x = abscissa(data, law.joint, law.quantity)[chosen]
        x = np.abs(x) if law.directed and law.quantity in ("velocity", "load") else x
        marker = {"color": GREY, "size": 5, "opacity": 0.75}
        figure.add_scatter(x=x.round(4), y=left[chosen].round(4), mode="markers", marker=marker, name="what is left")
    ends = np.concatenate([law.at, law.at[::-1]])
    band = np.concatenate([law.torque + law.band, (law.torque - law.band)[::-1]])
    figure.add_scatter(x=ends, y=band, fill="toself", line={"width": 0}, opacity=0.3, fillcolor=ORANGE, name="band")
    figure.add_scatter(x=law.at, y=law.torque, mode="lines", line={"color": ORANGE}, name=f"law of {law.quantity}")
    figure.update_xaxes(title=f"{LABELS.get(law.quantity, 'temperature [°C]')} of {joint}")
    figure.update_yaxes(
        title=f"{CHANNEL_WORDS[law.channel]} of {joint} [N·m]" + (", against the motion" if law.directed else "")
    )
    figure.update_layout(title=f"Law of {law.quantity} of {joint}", height=340, legend=BELOW_TITLE)
    return figure
