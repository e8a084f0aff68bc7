"""Gravity torque and regressor of a seven-joint arm against Pinocchio, one thread each."""

import numpy as np
import pinocchio as pin
from side_by_side import Case, seconds

from armlink.arm_file import load_arm
from calib.arm.kinematics import gcomp_arm
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.batch import GravityModel
from gcomp.gravity.torque import gravity_regressor, gravity_torque
from sim_bus.sim_section import sim_section

POSES = 10_000


def cases() -> list[Case]:
    """The cases, after a check that both give the same torque."""
    arm_file = load_arm("sarcos")
    arm, links = gcomp_arm(arm_file), sim_section(arm_file).links
    mass = np.array([link.mass for link in links])
    com = np.array([link.com for link in links])
    beta = base_parameters(arm, mass, mass[:, None] * com)
    model = pinocchio_model(arm, mass, com)
    data, pool = model.createData(), pin.ModelPool(model, 1)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (POSES, arm.n))
    columns, still = np.asfortranarray(q.T), np.zeros((arm.n, POSES), order="F")
    one, none, prepared = q[0].copy(), np.zeros(arm.n), GravityModel(arm, beta)

    def loop() -> np.ndarray:
        return np.array([pin.computeGeneralizedGravity(model, data, pose) for pose in q])

    assert np.abs(gravity_torque(arm, beta, q) - loop()).max() < 1e-9
    assert np.abs(prepared.one(one) - loop()[0]).max() < 1e-9
    return [
        Case(
            "gravity_10k_vs_pinocchio_loop",
            "ms",
            seconds(lambda: gravity_torque(arm, beta, q), 1, 1e3),
            seconds(loop, 1, 1e3),
            "loop over pinocchio.computeGeneralizedGravity",
        ),
        Case(
            "gravity_10k_vs_rnea_in_parallel",
            "ms",
            seconds(lambda: gravity_torque(arm, beta, q), 1, 1e3),
            seconds(lambda: pin.rneaInParallel(1, pool, columns, still, still), 1, 1e3),
            "pinocchio.rneaInParallel(1, …)",
        ),
        Case(
            "gravity_single_vs_pinocchio",
            "µs",
            seconds(lambda: prepared.one(one), 200, 1e6),
            seconds(lambda: pin.computeGeneralizedGravity(model, data, one), 200, 1e6),
            "pinocchio.computeGeneralizedGravity",
        ),
        Case(
            "regressor_10k_vs_pinocchio_loop",
            "ms",
            seconds(lambda: gravity_regressor(arm, q), 1, 1e3),
            seconds(
                lambda: np.array([pin.computeJointTorqueRegressor(model, data, pose, none, none) for pose in q]), 1, 1e3
            ),
            "loop over pinocchio.computeJointTorqueRegressor",
            runs=7,
        ),
    ]


def pinocchio_model(arm: Arm, mass: np.ndarray, com: np.ndarray) -> pin.Model:
    """The same arm for Pinocchio: its body frames are the bar frames."""
    model, parent = pin.Model(), 0
    model.gravity.linear = arm.gravity
    placement = pin.SE3.Identity()
    for i in range(arm.n):
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, arm.names[i])
        model.appendBodyToJoint(parent, pin.Inertia(mass[i], com[i], np.eye(3)), pin.SE3.Identity())
        turn = pin.utils.rotate("x", arm.alpha[i])
        placement = pin.SE3(turn, np.array([arm.a[i], 0.0, arm.d[i]]))
    return model
