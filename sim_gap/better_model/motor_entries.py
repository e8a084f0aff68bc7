"""Actuator entries of motors that take torques, from a diagnosis with a torque channel."""

from pathlib import Path
from typing import Any

import numpy as np

from sim_gap.better_model.actuator_entries import MOTOR, Row, steps_of, write_entries
from sim_gap.better_model.with_effects import with_effects
from sim_gap.model.load import SimModel, linear_part
from sim_gap.search.estimate import Estimate, Value

ABOUT = "Controllers are the asset's own: these recordings say what torques do."
IN_ENTRY = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia", "actuator.delay", "actuator.saturation")
LINKS = ("link.", "base.")
"""Effects whose names begin so are of links, which the corrected model has."""


def write_motor_entries(sim: SimModel, estimate: Estimate | None, path: Path, step: float = 0.005) -> None:
    """Write the entries for Isaac Lab and mjlab; delays are counted in `step` [s]. Raises BadInput.

    Friction, damping and armature are those of the corrected model. A gain of the drive is mjlab's `gear`; Isaac Lab
    has no field for it. What acts in one recording alone is left out.
    """
    found: dict[tuple[str, int], dict[str, Value]] = {}
    if estimate is not None:
        found = {term.key: estimate.parameters(term) for term in estimate.terms if not term.bound}
    model = with_effects(sim, estimate).model
    rows = {name: _entry(model, sim, j, found, step) for j, name in enumerate(sim.arm.names)}
    left = [
        f"{effect} {sim.arm.names[place]}" + (" (Isaac Lab)" if effect == "actuator.gain" else "")
        for effect, place in found
        if effect not in IN_ENTRY and not effect.startswith(LINKS)
    ]
    write_entries(rows, path, step, kind=MOTOR, about=ABOUT, left=left)


def _entry(model: Any, sim: SimModel, j: int, found: dict[tuple[str, int], dict[str, Value]], step: float) -> Row:
    """Values of one joint; None for no limit, no known delay is none."""
    dof = sim.mujoco_model.jnt_dofadr[sim.joints[j]]
    delay = found.get(("actuator.delay", j), {}).get("time")
    limit = found.get(("actuator.saturation", j), {}).get("limit")
    gain = found.get(("actuator.gain", j), {}).get("gain")
    return {
        "gain": None if gain is None else gain.value,
        "armature": float(model.dof_armature[dof]),
        "friction": float(model.dof_frictionloss[dof]),
        "viscous": float(linear_part(model.dof_damping, model.nv)[dof]),
        "limit": None if limit is None else limit.value,
        **steps_of(np.zeros(2) if delay is None else np.array([delay.low, delay.high]), step),
    }
