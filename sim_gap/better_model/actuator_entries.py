"""Actuator entries for training frameworks: a Python file with one entry per joint for Isaac Lab and mjlab."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.content.printable_text import printable_text
from armlink.errors import BadInput
from gcomp.arrays import Array

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
        + f"    return {{\n{isaac}\n    }}\n\n\n"
        + "def mjlab():\n"
        + '    """Entries of `EntityArticulationInfoCfg.actuators`."""\n'
        + f"    from mjlab.actuator import {kind}\n\n"
        + f"    return (\n{mjlab}\n    )\n"
    )
    try:
        write_whole(path, text)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from None


def steps_of(delay: Array, step: float) -> dict[str, float]:
    """Ends of a delay's range [s], (2,), in whole physics steps. Raises BadInput for a step that is none."""
    if not step > 0.0:
        raise BadInput(f"--physics-step {step:g}: expected a time above 0 [s]")
    least, most = np.floor(np.maximum(delay, 0.0) / step + 0.5)
    return {"least": float(least), "most": float(most)}


def _isaac(name: str, row: Row) -> str:
    steps = f"min_delay={row['least']:.0f}, max_delay={row['most']:.0f}"
    gains = "" if row.get("stiffness") is not None else "stiffness=None, damping=None, "
    entry = f"joint_names_expr=[{_pattern(name)}], {gains}{_given(ISAAC_LAB, row)}, {steps}"
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
