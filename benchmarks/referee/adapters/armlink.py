"""armlink: `armlink.diagnose`, and the model that `armlink gap diagnose --out-model` writes."""

from math import isfinite
from pathlib import Path
from typing import Any

from referee.interface import Answer, Case, Cause, Parameter
from referee.mjcf import mujoco, spec_of, value_of

from armlink import diagnose, load_recording
from sim_gap.attribution.diagnose import diagnose as diagnose_without
from sim_gap.better_model.export import write_model
from sim_gap.position_gap.training.position_files import write_exported

JOINT_VALUES = {
    "friction.coulomb:torque": "frictionloss",
    "friction.viscous:damping": "damping",
    "actuator.rotor_inertia:inertia": "armature",
    "controller.stiffness:kp": "kp",
}
"""Where MJCF has them. With a torque channel the first three are reported as what the model lacks."""


def solve(case: Case) -> Answer:
    train = [each.path for each in case.train]
    if case.withheld:
        made = diagnose_without(str(case.model), [load_recording(path) for path in train], [], withhold=case.withheld)
    else:
        made = diagnose(case.model, train)
    spec, parameters = spec_of(case), []
    names = dict(zip(made.names, case.joints, strict=True))
    for cause in (*made.causes, *made.minor):
        for joint, values in cause.parameters.items():
            for quantity, each in values.items():
                if not isfinite(each.value):  # a limit that is not there
                    continue
                name = f"{cause.effect}:{quantity}"
                where = names.get(joint, "")
                nominal = value_of(spec, JOINT_VALUES[name], where) if name in JOINT_VALUES else None
                more = nominal if nominal is not None and made.unit == "N·m" else 0.0
                low, high = (None if end is None else end + more for end in (each.low, each.high))
                parameters.append(Parameter(name, where, each.value + more, low, high, nominal))
    causes = [Cause(each.effect, tuple(names.get(j, j) for j in each.joints), each.confidence) for each in made.causes]
    return Answer("armlink", causes, parameters, written(made, case), made.verdict)


def written(made: Any, case: Case) -> str:
    """The corrected model; the nominal one where the diagnosis ended before a fit."""
    inside, path = made.internals, Path("corrected.xml")
    if inside is None:
        return case.model.read_text(encoding="utf-8")
    if made.unit == "rad":
        write_exported(inside, path)
    else:
        write_model(inside.model, inside.estimate, path)
    return str(mujoco.MjSpec.from_file(str(path)).to_xml())
