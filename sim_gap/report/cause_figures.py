"""A figure per cause and per law outside the library: what it has to explain, and its own share, over one quantity."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from gcomp.arrays import Array
from sim_gap.attribution.causes import remainder
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.report.effect_text import CHANNEL_WORDS
from sim_gap.report.figures import BELOW_TITLE, GREY, ORANGE, drawn_samples, stack
from sim_gap.residuals.layout import Row
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

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
LABELS = {
    "velocity": "velocity [rad/s]",
    "position": "position [rad]",
    "load": "torque of the model [N·m]",
    "acceleration": "acceleration [rad/s²]",
    "time": "time [s]",
}


def cause_figure(answer: Diagnosis, cause: Cause) -> Any:
    """Residual less all other causes, and this cause's share, on the row where it is largest; None without one."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    terms = tuple(term for term in estimate.terms if is_of(term, cause, answer.names))
    own, all_of_them = (_sums(data, estimate, some) for some in (terms, estimate.terms))
    sizes = {row: root_mean_square(own[row][data.valid[row]]) for row in data.rows if data.valid[row].sum() > 10}
    if not sizes or max(sizes.values()) == 0.0:
        return None
    row = max(sizes, key=lambda each: sizes[each])
    quantity = AGAINST.get(cause.effect, AGAINST.get(cause.effect.split(".")[0], "time"))
    chosen = drawn_samples(data.valid[row])
    x = abscissa(data, row[1], quantity)[chosen]
    left = (data.values[row] - all_of_them[row] + own[row])[chosen]
    figure = go.Figure()
    for values, colour, size, name in (
        (left, GREY, 5, "residual less the other causes"),
        (own[row][chosen], ORANGE, 3.5, cause.effect),
    ):
        marker = {"color": colour, "size": size, "opacity": 0.75}
        figure.add_scatter(x=x.round(4), y=values.round(4), mode="markers", marker=marker, name=name)
    joint, channel = answer.names[row[1]], row[0]
    figure.update_xaxes(title=f"{LABELS[quantity]}" + ("" if quantity == "time" else f" of {joint}"))
    figure.update_yaxes(title=f"{CHANNEL_WORDS[channel]} of {joint} [N·m]")
    figure.update_layout(
        title=f"{cause.effect} at {joint}" + (" (example)" if len(cause.joints) > 1 else ""),
        height=340,
        legend=BELOW_TITLE,
    )
    return figure


def abscissa(data: ResidualSet, joint: int, quantity: str) -> Array:
    """A quantity that a residual may correlate with, (K,) of one joint at the rate of the comparison."""
    if quantity == "time":
        return data.time
    names = {"velocity": "v", "position": "q", "load": "model", "acceleration": "a"}
    return stack(data, names[quantity])[:, joint]


def is_of(term: Term, cause: Cause, names: tuple[str, ...]) -> bool:
    return term.effect == cause.effect and ("arm" in cause.parameters or names[term.place] in cause.joints)


def _sums(data: ResidualSet, estimate: EffectEstimate, terms: tuple[Term, ...]) -> dict[Row, Array]:
    out: dict[Row, Array] = estimate.predict(data, terms=terms)
    return {row: np.asarray(values) for row, values in out.items()}


def law_figure(answer: Diagnosis, law: ResidualLaw) -> Any:
    """Residual that the effects leave of the law's row on held-out data, over its quantity; the law with its band."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    row, joint = (law.channel, law.joint), answer.names[law.joint]
    left = (data.values if estimate is None else remainder(data, estimate.predict(data)))[row]
    if law.directed:
        left = left * np.sign(stack(data, "direction")[:, law.joint])
    figure = go.Figure()
    if law.quantity != "temperature":
        chosen = drawn_samples(data.valid[row])
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
