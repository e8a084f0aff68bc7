"""Actuator entries of position controllers, from a diagnosis of positions alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gcomp.arrays import Array
from sim_gap.better_model.actuator_entries import Row, steps_of, write_entries
from sim_gap.closed_loop.identify import Identified
from sim_gap.closed_loop.training.draws import draw

DRAWS = 400
"""Draws of the parameters from which the range of a delay is taken."""
RANGE = 0.05, 0.95
ABOUT = "Friction of other kinds is taken into Coulomb and viscous friction; that joints creep under it is left out."


def write_actuators(found: Identified, path: Path, step: float = 0.005) -> None:
    """Write the entries for Isaac Lab and mjlab; delays are counted in `step` [s]. Raises BadInput."""
    drawn = draw(found.search, found.fit, found.spread, DRAWS, reach=found.band.reach)
    rows = {name: _entry(found, j, step, drawn) for j, name in enumerate(found.sim.arm.names)}
    left = found.export.lines if found.export is not None else ()
    write_entries(rows, path, step, about=ABOUT, left=left)


def _entry(found: Identified, j: int, step: float, drawn: Sequence[Mapping[str, float]]) -> Row:
    """Values of one joint, as the fit of what a simulator holds has them; None for no limit."""
    point = {name: float(values[j]) for name, values in found.native.point.items() if len(values) == found.sim.n}
    limit = point["limit"] if np.isfinite(point["limit"]) else None
    inside = min(point["kv"], point["viscous"])
    return {
        "stiffness": point["kp"] * point["gain"],
        "damping": inside + point["back_emf"],
        "armature": point["armature"],
        "friction": point["coulomb"],
        "viscous": point["viscous"] - inside,
        "limit": limit,
        **steps_of(_delays(found, j, drawn), step),
    }


def _delays(found: Identified, j: int, rows: Sequence[Mapping[str, float]]) -> Array:
    """Ends of the range of a joint's delay [s], (2,): that of 90 % of its draws, about the exported model's."""
    name = f"{found.sim.arm.names[j]}.delay"
    drawn = [row[name] for row in rows if name in row]
    about = np.quantile(drawn, RANGE) - found.fit.point["delay"][j] if drawn else np.zeros(2)
    return np.asarray(found.native.point["delay"][j] + about)
