"""Export of the corrected model (`--out-model`): MJCF, and a module for the effects that MJCF cannot hold."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlink.content.atomic_file import write_whole, writing
from calib.arm.model_files import URDF, urdf_of, xml_comment
from gcomp.arm.rigid_body import CREEP
from sim_gap.better_model import forward_effects
from sim_gap.better_model.corrected_model import (
    add_motors,
    offsets,
    with_effects,
    write_changes,
)
from sim_gap.better_model.forward_effects import STEP_S, JointEffect
from sim_gap.better_model.native_drives import DRIVE, motors_of, put_drive
from sim_gap.effects.torque import GRADUAL, is_gradual
from sim_gap.model.load import SimModel, named_spec, urdf_behind
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term


@dataclass(frozen=True)
class CorrectedText:
    xml: str
    lines: tuple[str, ...]
    """A line per effect that it cannot hold, and per link that is not as fitted."""
    effects: tuple[JointEffect, ...] = ()
    """Those that a module applies beside it."""
    spec: Any = None
    """`mujoco.MjSpec` of the model, if it may refer to files beside it."""


def model_files(
    sim: SimModel,
    estimate: EffectEstimate,
    name: str,
    terms: Sequence[Term] | None = None,
    number: int = 0,
    laws: Sequence[JointEffect] = (),
    spec: Any = None,
    mount: float = 0.0,
) -> CorrectedText:
    """The text of the model as `with_effects` makes it; `name` is the MJCF's. `laws` are torques without a known cause;
    `spec` is the nominal model's if it has been read before."""
    chosen = estimate.terms if terms is None else tuple(terms)
    if spec is None:
        spec = named_spec(sim)
    else:
        spec = spec.copy()
        spec.compile()  # which numbers its elements
    corrected = with_effects(sim, estimate, chosen, number, mount)
    write_changes(spec, sim, corrected.model)
    add_motors(spec, sim, estimate, chosen)
    motors, drives = motors_of(spec), _drives(sim, estimate, chosen)
    for joint, drive in drives.items():
        if joint in motors:
            put_drive(motors[joint], drive)
    if any("actuator.delay" in drive and joint in motors for joint, drive in drives.items()):
        spec.option.timestep = min(float(spec.option.timestep), STEP_S)
    spec.compile()
    left = [t for t in corrected.not_held if t.effect not in DRIVE or sim.arm.names[t.place] not in motors]
    lines = [_line(sim, estimate, term) for term in left]
    lines += [
        f"{name}: no body can have the fitted inertia of its link, so the file has the nearest possible inertia"
        for name in corrected.changed
    ]
    lines += [f"{law} {joint}: a torque without a known cause" for law, joint, _ in laws]
    module = module_path(Path(name)).name
    comment = xml_comment([f"Effects that MJCF cannot represent ({module} applies them):", *lines]) if lines else ""
    effects = joint_effects(sim, estimate, corrected.not_held, corrected.held)
    return CorrectedText(comment + spec.to_xml(), tuple(lines), (*effects, *laws), spec)


def write_model(sim: SimModel, estimate: EffectEstimate, path: Path, laws: Sequence[JointEffect] = ()) -> list[str]:
    """Write the model with the effects, and beside it a module for those that MJCF cannot hold and for laws; a line for
    each of them. Raises BadInput if the nominal model did not come from a file, or as `write_files`."""
    files = model_files(sim, estimate, path.name, laws=laws)
    beside = {module_path(path): module_text(sim, files.effects, path.name) if files.effects else None}
    return write_files(path, sim, files.xml, files.spec.compile, files.lines, beside)


def write_files(
    path: Path,
    sim: SimModel,
    xml: str,
    compiled: Callable[[], Any],
    lines: Sequence[str],
    beside: Mapping[Path, str | None],
) -> list[str]:
    """Write a corrected model, its MJCF or if the path ends so URDF, and texts beside it; None removes a file of an
    earlier model. Returns a line for all that the file cannot hold, `lines` first. Raises BadInput."""
    if path.suffix == URDF:
        xml, lines = urdf_of(compiled(), urdf_behind(sim.path), lines)
    with writing(path):
        for file, text in {path: xml, **beside}.items():
            if text is None:
                file.unlink(missing_ok=True)
            else:
                write_whole(file, text)
    return list(lines)


def module_path(model: Path) -> Path:
    """Path of the module of a written model: `closed.xml` → `closed_effects.py`."""
    return model.with_name(f"{model.stem}_effects.py")


def joint_effects(
    sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term], held: Sequence[Term] = ()
) -> list[JointEffect]:
    """The terms in the module's form, beside a model with those `held`; without those present in one recording alone.

    Without a torque sensor, an offset of the motor's torque is torque lost. A ripple follows the position as the model
    has it: as it is read, if the model holds an offset of that.
    """
    out: list[JointEffect] = []
    zeros = offsets(estimate, held)
    for term in terms:
        if term.bound:
            continue
        values = {name: each.value for name, each in estimate.parameters(term).items()}
        if term.effect == "torque.offset" and estimate.store.data.layout.sensor is None:
            values = {"lost": values["offset"]}
        if term.effect == "torque.hysteresis" and is_gradual(term.shape):
            values["gradual"] = 1.0
        if term.effect == "transmission.ripple":
            values["phase"] += values["cycles"] * zeros.get(term.place, 0.0)
        out.append((term.effect, sim.arm.names[term.place], values))
    return out


def module_text(sim: SimModel, effects: Sequence[JointEffect], model: str) -> str:
    """Source of the module with the effects that the MJCF file `model` cannot hold; it imports none of ours."""
    rows = "".join(f"    {each!r},\n" for each in effects)
    text = Path(forward_effects.__file__).read_text(encoding="utf-8")
    values = {
        "from gcomp.arm.rigid_body import CREEP": f"CREEP = {CREEP}  # [rad/s], below which motion has no direction",
        "from gcomp.arrays import Array": "Array = np.ndarray",
        "from sim_gap.effects.torque import GRADUAL": f"GRADUAL = {GRADUAL}  # half widths of plays over their mean",
        'MODEL = ""': f"MODEL = {model!r}",
        "JOINTS: tuple[str, ...] = ()": f"JOINTS = {sim.arm.names!r}",
        "EFFECTS: tuple[JointEffect, ...] = ()": f"EFFECTS = (\n{rows})",
    }
    declared = "|".join(map(re.escape, values))  # in one pass: what is filled in is not searched
    return re.sub(f"^(?:{declared})$", lambda found: values[found[0]], text, flags=re.MULTILINE)


def _drives(sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term]) -> dict[str, dict[str, float]]:
    """Found values of the drives, joint → effect → value."""
    out: dict[str, dict[str, float]] = {}
    for term in terms:
        if term.effect in DRIVE:
            value = estimate.parameters(term)[DRIVE[term.effect]].value
            out.setdefault(sim.arm.names[term.place], {})[term.effect] = value
    return out


def _line(sim: SimModel, estimate: EffectEstimate, term: Term) -> str:
    values = estimate.parameters(term)
    where = f"in recording {', '.join(map(str, term.bound))}" if term.bound else sim.arm.names[term.place]
    listed = (f"{name} {v.value:.6g}" + (f" {v.unit}" if v.unit != "1" else "") for name, v in values.items())
    return f"{term.effect} {where} " + ", ".join(listed)
