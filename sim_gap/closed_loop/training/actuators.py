"""Actuator entries for training frameworks: one per joint, as a Python file for Isaac Lab and mjlab."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armlink.errors import BadInput
from gcomp.arrays import Array
from sim_gap.closed_loop.identify import Identified
from sim_gap.closed_loop.judge import draw

ISAAC_LAB = {
    "stiffness": "stiffness",
    "damping": "damping",
    "armature": "armature",
    "friction": "friction",
    "dynamic_friction": "friction",
    "viscous_friction": "viscous",
    "effort_limit": "limit",
}
MJLAB = {
    "stiffness": "stiffness",
    "damping": "damping",
    "armature": "armature",
    "frictionloss": "friction",
    "viscous_damping": "viscous",
    "effort_limit": "limit",
}
"""Field of an entry → value of the joint that it takes."""
DRAWS = 400
"""Draws of the parameters from which the range of a delay is taken."""
RANGE = 0.05, 0.95
HEAD = '''"""Actuators of the corrected model, written by gap diagnose --out-actuators.

Gains in N·m/rad and N·m·s/rad, friction and limits in N·m, rotor inertia in kg·m²; delays in physics steps of
{step:g} s. Friction of other kinds is taken into Coulomb and viscous friction; the links of the model are not changed
by this file.
{left}"""

'''


def write_actuators(found: Identified, path: Path, step: float = 0.005) -> None:
    """Write `isaac_lab()` and `mjlab()`, functions that return the entries; delays are counted in `step` [s].

    Raises BadInput if the file cannot be written, or does not end in .py.
    """
    if path.suffix != ".py":
        raise BadInput(f"--out-actuators {path}: expected a name that ends in .py")
    if not step > 0.0:
        raise BadInput(f"--physics-step {step:g}: expected a time above 0 [s]")
    try:
        path.write_text(actuators_text(found, step), encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from None


def actuators_text(found: Identified, step: float) -> str:
    """The file's text."""
    drawn = draw(found.search, found.fit, found.spread, DRAWS)
    rows = [_entry(found, j, step, drawn) for j in range(found.sim.n)]
    left = found.export.lines if found.export is not None else ()
    note = f"Not in these entries: {', '.join(left)}.\n" if left else ""
    isaac = "\n".join(_isaac(name, row) for name, row in zip(found.sim.arm.names, rows, strict=True))
    mjlab = "\n".join(_mjlab(name, row) for name, row in zip(found.sim.arm.names, rows, strict=True))
    return (
        HEAD.format(step=step, left=note)
        + "\ndef isaac_lab():\n"
        + '    """Entries of `ArticulationCfg.actuators`."""\n'
        + "    from isaaclab.actuators import DelayedPDActuatorCfg\n\n"
        + f"    return {{\n{isaac}\n    }}\n\n\n"
        + "def mjlab():\n"
        + '    """Entries of `EntityArticulationInfoCfg.actuators`."""\n'
        + "    from mjlab.actuator import BuiltinPositionActuatorCfg\n\n"
        + f"    return (\n{mjlab}\n    )\n"
    )


def _entry(found: Identified, j: int, step: float, drawn: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Values of one joint, as the fit of what a simulator holds has them; None for no limit."""
    point = {name: float(values[j]) for name, values in found.native.point.items() if len(values) == found.sim.n}
    limit = point["limit"] if np.isfinite(point["limit"]) else None
    late = _delays(found, j, drawn) / step
    inside = min(point["kv"], point["viscous"])
    return {
        "stiffness": point["kp"] * point["gain"],
        "damping": inside + point["back_emf"],
        "armature": point["armature"],
        "friction": point["coulomb"],
        "viscous": point["viscous"] - inside,
        "limit": limit,
        "least": float(np.floor(max(late.min(), 0.0) + 0.5)),
        "most": float(np.floor(max(late.max(), 0.0) + 0.5)),
    }


def _delays(found: Identified, j: int, rows: Sequence[Mapping[str, float]]) -> Array:
    """Ends of the range of a joint's delay [s], (2,): that of 90 % of its draws, about the exported model's."""
    name = f"{found.sim.arm.names[j]}.delay"
    drawn = [row[name] for row in rows if name in row]
    about = np.quantile(drawn, RANGE) - found.fit.point["delay"][j] if drawn else np.zeros(2)
    return np.asarray(found.native.point["delay"][j] + about)


def _isaac(name: str, row: dict[str, float | None]) -> str:
    steps = f"min_delay={row['least']:.0f}, max_delay={row['most']:.0f}"
    entry = f'joint_names_expr=["{name}"], {_given(ISAAC_LAB, row)}, {steps}'
    return f'        "{name}": DelayedPDActuatorCfg(\n            {entry}\n        ),'


def _mjlab(name: str, row: dict[str, float | None]) -> str:
    steps = f"delay_min_lag={row['least']:.0f}, delay_max_lag={row['most']:.0f}"
    entry = f'target_names_expr=("{name}",), {_given(MJLAB, row)}, {steps}'
    return f"        BuiltinPositionActuatorCfg(\n            {entry}\n        ),"


def _given(fields: Mapping[str, str], row: Mapping[str, float | None]) -> str:
    values = {name: row[key] for name, key in fields.items()}
    return ", ".join(f"{name}={value:.6g}" for name, value in values.items() if value is not None)
