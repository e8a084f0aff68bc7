"""Files of what positions have shown: the corrected model, draws of its parameters, and actuator entries."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armlink.errors import BadInput
from calib.arm.model_files import URDF, xml_comment
from gcomp.arrays import Array
from sim_gap.better_model.export import module_path, module_text, write_files
from sim_gap.better_model.training_files import Row, steps_of, write_entries, write_rows
from sim_gap.position_gap.choice import present
from sim_gap.position_gap.identify import Identified
from sim_gap.position_gap.training.bands import SHARE
from sim_gap.position_gap.training.export import BATCHED, NATIVE, Exported, effects_left_out, export_fit, native_fit
from sim_gap.position_gap.training.spread import draw

DELAY_DRAWS = 400
"""Draws of the parameters from which the range of a delay is taken."""


def write_samples(found: Identified, count: int, path: Path) -> None:
    """Write draws of all fitted parameters, one row each, columns `JOINT.PARAMETER` in SI units. Raises BadInput."""
    write_rows(draw(found.search, found.fit, found.spread, count, reach=found.band.reach), path)


def write_exported(found: Identified, path: Path) -> list[str]:
    """Write the corrected model as MJCF, or as URDF if the path ends so; a line per effect that it leaves out.

    If it needs PID actuators, which MuJoCo Warp does not run, `NAME_batch.xml` beside it does without. If it leaves out
    friction that a module can apply, `NAME_effects.py` is that module, for the model `NAME_effects.xml`.
    """
    import mujoco

    if found.export is None:
        raise BadInput("--out-model needs a model that came from a file: give MJCF, URDF or an arm file with --sim")
    xml, beside = found.export.xml, {} if path.suffix == URDF else _beside(found, path)
    return write_files(path, found.sim, xml, lambda: mujoco.MjModel.from_xml_string(xml), found.export.lines, beside)


def _beside(found: Identified, path: Path) -> dict[Path, str | None]:
    """Text of each file that may stand beside the corrected model; None for those that must not."""
    model, module, other, made = module_model(path), module_path(path), export_batched(found), found.beside
    out: dict[Path, str | None] = {batch_path(path): None if other is None else other.xml, model: None, module: None}
    if made is not None:
        told = [f"{effect} {joint}" for effect, joint, _ in made.effects]
        out[model] = xml_comment([f"Use this model with {module.name}, which applies:", *told]) + made.xml
        out[module] = module_text(found.sim, made.effects, model.name)
    return out


def export_batched(found: Identified) -> Exported | None:
    """The corrected model without PID actuators, fitted again without them; None if it has none."""
    native = found.native
    if not {effect for effect, _ in present(found.search, native)} & ({*NATIVE} - BATCHED):
        return None
    bare = native_fit(found.search, native, BATCHED)
    return export_fit(found.sim, found.search, found.fit, bare, BATCHED)


def batch_path(path: Path) -> Path:
    """File of the model without PID actuators beside that of the corrected model."""
    return path.with_name(f"{path.stem}_batch{path.suffix}")


def module_model(path: Path) -> Path:
    """File of the model that the module beside the corrected model belongs to."""
    return path.with_name(f"{path.stem}_effects.xml")


ABOUT = "Coulomb and viscous friction stand for all kinds of friction; slow creep of joints under friction is left out."


def write_actuators(found: Identified, path: Path, step: float = 0.005) -> None:
    """Write the entries for Isaac Lab and mjlab; delays are counted in `step` [s]. Raises BadInput."""
    drawn = draw(found.search, found.fit, found.spread, DELAY_DRAWS, reach=found.band.reach)
    rows = {name: _entry(found, j, step, drawn) for j, name in enumerate(found.sim.arm.names)}
    left = effects_left_out(found.search, found.fit) if found.sim.path is not None else ()
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
    """Ends of the range of a joint's delay [s], (2,): that of the SHARE of its draws, about the exported model's."""
    name = f"{found.sim.arm.names[j]}.delay"
    drawn = [row[name] for row in rows if name in row]
    about = (
        np.quantile(drawn, (0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE)) - found.fit.point["delay"][j]
        if drawn
        else np.zeros(2)
    )
    return np.asarray(found.native.point["delay"][j] + about)
