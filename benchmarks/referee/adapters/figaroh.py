"""FIGAROH: base parameters, friction, rotor inertia and offset by its regressor, double QR and relative deviations.

It writes no model: friction and rotor inertia, which stay parameters of their own, are put into the nominal MJCF.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
from figaroh.identification.identification_tools import relative_stdev
from figaroh.tools.qrdecomposition import QRDecomposer
from figaroh.tools.regressor import build_regressor_basic, get_index_eliminate
from referee import mjcf
from referee.interface import Answer, Case, NotOffered, Parameter
from referee.signals import motion

LEAST_SPEED = 0.02
"""Speed from which friction is determined [rad/s]."""
WORDS = {"fs": "frictionloss", "fv": "damping", "Ia": "armature", "off": ""}
INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


def solve(case: Case) -> Answer:
    if case.kind == "positions":
        raise NotOffered("needs torques")
    model, n, spec = pin.buildModelFromMJCF(str(case.model)), len(case.joints), mjcf.spec_of(case)
    model.gravity.linear = np.array(spec.option.gravity)
    q, v, a, torque = motion(case)
    config = {f"has_{name}": True for name in ("friction", "actuator_inertia", "joint_offset")}
    config |= {"is_joint_torques": True, "act_idxv": list(range(n))}
    full = build_regressor_basic(SimpleNamespace(model=model, data=model.createData()), q, v, a, config)
    names = [f"{word}{i}" for i in range(n) for word in INERTIAL]
    names += [f"{block} {joint}" for block in blocks(full, v, a, n) for joint in case.joints]
    allowed = mjcf.allowed(case, WORDS.values())
    full[:, [WORDS.get(name.partition(" ")[0], "") not in allowed for name in names]] = 0.0  # withheld
    dropped, kept = get_index_eliminate(full, dict.fromkeys(names))
    moving = (np.abs(v) > LEAST_SPEED).T.ravel()
    side, reduced = torque.T.ravel()[moving], np.delete(full, dropped, axis=1)[moving]
    base, _, labels, phi = QRDecomposer().double_decomposition(side, reduced, kept)
    values, parameters = {}, []
    for label, value, percent in zip(labels, phi.tolist(), relative_stdev(base, phi, side), strict=True):
        block, _, joint = label.partition(" ")
        if block in WORDS and joint in case.joints:
            half, word = 1.96 * abs(value) * percent / 100.0, WORDS[block]
            nominal = mjcf.value_of(spec, word, joint) if word else 0.0
            parameters.append(Parameter(block, joint, value, value - half, value + half, nominal))
            values |= {(word, joint): max(value, 0.0)} if word else {}
    return Answer("figaroh", None, parameters, mjcf.corrected(case, values))


def blocks(full: Any, v: Any, a: Any, n: int) -> list[str]:
    """The order of the blocks beyond the inertial columns, read off the first joint's columns."""
    known = {"fv": v[:, 0], "fs": np.sign(v[:, 0]), "Ia": a[:, 0], "off": np.ones(len(v))}
    columns = full[: len(v), 10 * n :: n].T
    return [next(name for name, x in known.items() if np.allclose(x, column)) for column in columns]
