"""Files for training frameworks: actuator entries for Isaac Lab and mjlab, and draws of all fitted parameters, so that
a run randomises over what the recordings leave open."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import open_whole, write_whole, writing
from armlink.content.printable_text import printable_text
from armlink.errors import BadInput
from gcomp.arm.model_file import linear_part
from gcomp.arrays import Array
from sim_bus.effects.registry import effects as simulated
from sim_gap.better_model.export import with_effects
from sim_gap.model.load import SimModel
from sim_gap.search.estimate import EffectEstimate, Value
from sim_gap.search.term import Term

ISAAC_LAB = {
    "stiffness": "stiffness",
    "damping": "damping",
    "armature": "armature",
    "friction": "friction",
    "dynamic_friction": "friction",
    "viscous_friction": "viscous",
}
MJLAB = {
    "stiffness": "stiffness",
    "damping": "damping",
    "gear": "gain",
    "armature": "armature",
    "frictionloss": "friction",
    "viscous_damping": "viscous",
    "effort_limit": "limit",
}
"""Field of an entry → value of the joint that it takes."""
POSITION, MOTOR = "BuiltinPositionActuatorCfg", "BuiltinMotorActuatorCfg"
"""mjlab's entries of position controllers, and of motors that take torques."""
Row = Mapping[str, float | None]
"""Values of one joint; None for what the entry does not give."""
LIMIT_OF_ISAAC_LAB = """    limit = "actuator_effort_limit"
    if limit not in getattr(DelayedPDActuatorCfg, "__dataclass_fields__", {limit}):
        limit = "effort_limit"  # before Isaac Lab 3
"""
HEAD = '''"""Actuators of the corrected model, written by gap diagnose --out-actuators.

Gains in N·m/rad and N·m·s/rad, friction and limits in N·m, rotor inertia in kg·m²; delays in physics steps of
{step:g} s.{about} The links of the model are not changed by this file.
{left}"""

'''


def write_entries(
    rows: Mapping[str, Row], path: Path, step: float, *, kind: str = POSITION, about: str = "", left: Sequence[str] = ()
) -> None:
    """Write `isaac_lab()` and `mjlab()`, functions that return the entries of the joints in `rows`, by their names.

    Their delays are counted in `step` [s]. Raises BadInput if the file cannot be written, or does not end in .py.
    """
    if path.suffix != ".py":
        raise BadInput(f"--out-actuators {path}: expected a name that ends in .py")
    note = f"Not in these entries: {', '.join(left)}.\n" if left else ""
    isaac = "\n".join(_isaac(name, row) for name, row in rows.items())
    mjlab = "\n".join(_mjlab(name, row, kind) for name, row in rows.items())
    text = (
        HEAD.format(step=step, about=_in_docstring(about and f" {about}"), left=_in_docstring(note))
        + "\ndef isaac_lab():\n"
        + '    """Entries of `ArticulationCfg.actuators`."""\n'
        + "    from isaaclab.actuators import DelayedPDActuatorCfg\n\n"
        + LIMIT_OF_ISAAC_LAB
        + f"    return {{\n{isaac}\n    }}\n\n\n"
        + "def mjlab():\n"
        + '    """Entries of `EntityArticulationInfoCfg.actuators`."""\n'
        + f"    from mjlab.actuator import {kind}\n\n"
        + f"    return (\n{mjlab}\n    )\n"
    )
    with writing(path):
        write_whole(path, text)


def steps_of(delay: Array, step: float) -> dict[str, float]:
    """Ends of a delay's range [s], (2,), in whole physics steps. Raises BadInput for a step that is none."""
    if not step > 0.0:
        raise BadInput(f"--physics-step {step:g}: expected a time above 0 [s]")
    least, most = np.floor(np.maximum(delay, 0.0) / step + 0.5)
    return {"least": float(least), "most": float(most)}


def _isaac(name: str, row: Row) -> str:
    steps = f"min_delay={row['least']:.0f}, max_delay={row['most']:.0f}"
    gains = "" if row.get("stiffness") is not None else "stiffness=None, damping=None, "
    limit = "" if row.get("limit") is None else f", **{{limit: {row['limit']:.6g}}}"
    entry = f"joint_names_expr=[{_pattern(name)}], {gains}{_given(ISAAC_LAB, row)}, {steps}{limit}"
    return f"        {_literal(name)}: DelayedPDActuatorCfg(\n            {entry}\n        ),"


def _mjlab(name: str, row: Row, kind: str) -> str:
    steps = f"delay_min_lag={row['least']:.0f}, delay_max_lag={row['most']:.0f}"
    entry = f"target_names_expr=({_pattern(name)},), {_given(MJLAB, row)}, {steps}"
    return f"        {kind}(\n            {entry}\n        ),"


def _in_docstring(text: str) -> str:
    return printable_text(text, keep="\n").replace("\\", "\\\\").replace('"', '\\"')


def _literal(text: str) -> str:
    """A text as Python source, in double quotes."""
    return '"' + printable_text(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'


def _pattern(name: str) -> str:
    """The regular expression of a joint's name as Python source; that of a plain name is the name."""
    return _literal(re.sub(r"[\\^$.|?*+()\[\]{}]", r"\\\g<0>", name))


def _given(fields: Mapping[str, str], row: Row) -> str:
    values = {name: row.get(key) for name, key in fields.items()}
    return ", ".join(f"{name}={value:.6g}" for name, value in values.items() if value is not None)


ABOUT = "The controllers stay those of the asset, since these recordings show torques and no controller."
IN_ENTRY = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia", "actuator.delay", "actuator.saturation")
LINKS = ("link.", "base.")
"""Effects whose names begin so are of links, which the corrected model has."""


def write_motor_entries(sim: SimModel, estimate: EffectEstimate, path: Path, step: float = 0.005) -> None:
    """Write the entries for Isaac Lab and mjlab; delays are counted in `step` [s]. Raises BadInput.

    Friction, damping and armature are those of the corrected model. A gain of the drive is mjlab's `gear`; Isaac Lab
    has no field for it. What acts in one recording alone is left out.
    """
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


SUFFIXES = (".csv", ".json", ".parquet")


def drawn_parameters(estimate: EffectEstimate, names: Sequence[str], count: int) -> list[dict[str, float]]:
    """Draws of what the arm has in all recordings, `JOINT.EFFECT.PARAMETER` → value in SI units; effects on the whole
    arm are `arm.…`."""
    terms = [term for term in estimate.terms if not term.bound]
    best = {term: {name: each.value for name, each in estimate.parameters(term).items()} for term in terms}

    def label(term: Term) -> str:
        return f"{'arm' if term.form.signature.whole_arm else names[term.place]}.{term.effect}"

    return [
        {
            f"{label(term)}.{name}": _accepted(term.effect, name, value, best[term][name])
            for term, values in row.items()
            for name, value in values.items()
        }
        for row in estimate.draws(terms, count, seed=0)
    ]


def _accepted(effect: str, name: str, value: float, best: float) -> float:
    """A value within the bounds that the simulated arm has for it: no friction, rotor or play is below zero, and what
    must be above it is 1 % of its estimate or more."""
    known = simulated().get(effect)
    one = next((each for each in known.parameters if each.name == name), None) if known else None
    if one is None or not one.accepts(best):
        return value
    least, above = one.domain.least, one.domain.above
    value = value if least is None else max(value, least)
    return value if above is None else max(value, above + 0.01 * (best - above))


def write_rows(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Write draws, one row each, as CSV, JSON or Parquet. Raises BadInput."""
    if path.suffix not in SUFFIXES:
        raise BadInput(f"--out-samples {path}: expected a name that ends in {', '.join(SUFFIXES)}")
    names = list(rows[0]) if rows else []
    with writing(path):
        if path.suffix == ".json":
            text = json.dumps({"schema": "armlink.samples/1", "samples": [dict(row) for row in rows]}, indent=1)
            write_whole(path, text)
        elif path.suffix == ".csv":
            lines = [",".join(names), *(",".join(f"{row[name]:.9g}" for name in names) for row in rows)]
            write_whole(path, "\n".join(lines) + "\n")
        else:
            write_parquet(rows, path)


def write_parquet(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a table of rows that have the same columns; raises BadInput."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    with writing(path), open_whole(path) as stream:
        write_table(pa.Table.from_pylist(list(rows)), stream)
