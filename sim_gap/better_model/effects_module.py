"""The module written beside an exported MJCF: the source of `forward_effects` with one arm's effects filled in."""

import re
from collections.abc import Sequence
from pathlib import Path

from sim_gap.better_model import forward_effects as forward
from sim_gap.better_model.corrected_model import offsets
from sim_gap.effects.torque import is_gradual
from sim_gap.model.load import SimModel
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term


def module_path(model: Path) -> Path:
    """Path of the module of a written model: `closed.xml` → `closed_effects.py`."""
    return model.with_name(f"{model.stem}_effects.py")


def joint_effects(
    sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term], held: Sequence[Term] = ()
) -> list[forward.JointEffect]:
    """The terms in the module's form, beside a model with those `held`; without those present in one recording alone.

    Without a torque sensor, an offset of the motor's torque is torque lost. A ripple follows the position as the model
    has it: as it is read, if the model holds an offset of that.
    """
    out: list[forward.JointEffect] = []
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


def module_text(sim: SimModel, effects: Sequence[forward.JointEffect], model: str) -> str:
    """Source of the module with the effects that the MJCF file `model` cannot hold; it imports none of ours."""
    rows = "".join(f"    {each!r},\n" for each in effects)
    text = Path(forward.__file__).read_text(encoding="utf-8")
    values = {
        "from gcomp.arrays import Array": "Array = np.ndarray",
        'MODEL = ""': f"MODEL = {model!r}",
        "JOINTS: tuple[str, ...] = ()": f"JOINTS = {sim.arm.names!r}",
        "EFFECTS: tuple[JointEffect, ...] = ()": f"EFFECTS = (\n{rows})",
    }
    declared = "|".join(map(re.escape, values))  # in one pass: what is filled in is not searched
    return re.sub(f"^(?:{declared})$", lambda found: values[found[0]], text, flags=re.MULTILINE)
