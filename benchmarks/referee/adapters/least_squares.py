"""Plain least squares on Pinocchio's regressor, with dry and viscous friction and rotor inertia of each joint.

Masses stay nominal where the data cannot tell them: the change of least norm is taken. The intervals are the textbook
ones, of independent errors.
"""

import numpy as np
import pinocchio as pin
from referee import mjcf
from referee.interface import Answer, Case, NotOffered
from referee.signals import motion

LEAST_SPEED, SMALLEST = 0.02, 1e-3
"""Speed from which friction is determined [rad/s], and the least singular value that counts, over the largest."""


def solve(case: Case) -> Answer:
    if case.kind == "positions":
        raise NotOffered("needs torques")
    model, n = pin.buildModelFromMJCF(str(case.model)), len(case.joints)
    model.gravity.linear, data = np.array(mjcf.spec_of(case).option.gravity), model.createData()
    q, v, a, torque = motion(case)
    rows = np.array([pin.computeJointTorqueRegressor(model, data, *each) for each in zip(q, v, a, strict=True)])
    causes = {"frictionloss": np.sign(v), "damping": v, "armature": a}
    sought = mjcf.allowed(case, causes)
    own = [np.einsum("kj,ij->kij", causes[quantity], np.eye(n)) for quantity in sought]
    nominal = np.concatenate([inertia.toDynamicParameters() for inertia in model.inertias[1 : n + 1]])
    left = torque - rows @ nominal
    weight = 1.0 / left.std(0)
    moving = (np.abs(v) > LEAST_SPEED).ravel()
    design = (np.concatenate([rows, *own], axis=2) * weight[:, None]).reshape(left.size, -1)[moving]
    scale, side = np.linalg.norm(design, axis=0) + 1e-9, (left * weight).ravel()[moving]
    solution, _, rank, _ = np.linalg.lstsq(design / scale, side, rcond=SMALLEST)
    variance = np.sum((side - design / scale @ solution) ** 2) / (side.size - rank)
    spread = variance * np.linalg.pinv((design / scale).T @ (design / scale), rcond=SMALLEST**2)
    half = 1.96 * np.sqrt(np.clip(np.diag(spread), 0.0, None)) / scale
    keys = [(quantity, name) for quantity in sought for name in case.joints]
    found = dict(zip(keys, np.maximum(solution / scale, 0.0)[10 * n :].tolist(), strict=True))
    widths = dict(zip(keys, half[10 * n :].tolist(), strict=True))
    moved = nominal + (solution / scale)[: 10 * n]
    return Answer("mujoco", None, mjcf.parameters(case, found, widths), mjcf.corrected(case, found, moved))
