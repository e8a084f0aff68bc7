"""A figure per finding: what a cause has to explain, against what it goes with, and what it does explain."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.effects.registry import Row
from sim_gap.model.rigid_body import Array
from sim_gap.report.figures import GREY, ORANGE, stacked, thinned
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square
from sim_gap.search.estimate import Estimate
from sim_gap.search.normal_equations import ColumnStore, Term

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
"""What an effect, or its family, goes with; the others go with the pose of the whole arm, and are shown over time."""
LABELS = {
    "velocity": "velocity [rad/s]",
    "position": "position [rad]",
    "load": "torque of the model [N·m]",
    "acceleration": "acceleration [rad/s²]",
    "time": "time [s]",
}


def finding_figure(answer: Diagnosis, cause: Cause) -> Any:
    """The row on which the cause explains most: residual less all other causes, and this cause's share; or None."""
    data, estimate = answer.internals.heldout, answer.internals.estimate
    terms = tuple(term for term in estimate.terms if _is_of(term, cause, answer.names))
    store = ColumnStore(data)
    own, all_of_them = (_sums(data, estimate, store, some) for some in (terms, estimate.terms))
    sizes = {row: root_mean_square(own[row][data.valid[row]]) for row in data.rows if data.valid[row].sum() > 10}
    if not sizes or max(sizes.values()) == 0.0:
        return None
    row = max(sizes, key=lambda each: sizes[each])
    what = AGAINST.get(cause.effect, AGAINST.get(cause.effect.split(".")[0], "time"))
    chosen = thinned(data.valid[row])
    x = abscissa(data, row[1], what)[chosen]
    left = (data.values[row] - all_of_them[row] + own[row])[chosen]
    figure = go.Figure()
    for values, colour, size, name in (
        (left, GREY, 5, "residual less the other causes"),
        (own[row][chosen], ORANGE, 3.5, cause.effect),
    ):
        marker = {"color": colour, "size": size, "opacity": 0.75}
        figure.add_scatter(x=x.round(4), y=values.round(4), mode="markers", marker=marker, name=name)
    joint, channel = answer.names[row[1]], row[0]
    figure.update_xaxes(title=f"{LABELS[what]}" + ("" if what == "time" else f" of {joint}"))
    figure.update_yaxes(title=f"{channel} of {joint} [N·m]")
    figure.update_layout(
        title=f"{cause.effect}, at {joint} as an example" if len(cause.joints) > 1 else f"{cause.effect} of {joint}",
        height=340,
        legend={"orientation": "h", "y": 1.02, "x": 1, "xanchor": "right", "yanchor": "bottom"},
    )
    return figure


def abscissa(data: ResidualSet, joint: int, what: str) -> Array:
    """What a residual may go with, (K,) of one joint at the rate of the comparison."""
    if what == "time":
        return data.time
    names = {"velocity": "v", "position": "q", "load": "model", "acceleration": "a"}
    return stacked(data, names[what])[:, joint]


def _is_of(term: Term, cause: Cause, names: tuple[str, ...]) -> bool:
    return term.effect == cause.effect and ("arm" in cause.parameters or names[term.place] in cause.joints)


def _sums(data: ResidualSet, estimate: Estimate, store: ColumnStore, terms: tuple[Term, ...]) -> dict[Row, Array]:
    out: dict[Row, Array] = estimate.predict(data, store, terms)
    return {row: np.asarray(values) for row, values in out.items()}
