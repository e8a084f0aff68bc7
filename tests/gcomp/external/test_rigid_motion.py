"""Momentum and its rate against MuJoCo's inverse dynamics, and its regressors against itself."""

import mujoco
import numpy as np
import pytest

from gcomp.arm.load import bar_inertials, inertial_torque
from gcomp.arm.mass_moments import base_parameters
from gcomp.external.rigid_motion import (
    gravity_split,
    jacobian,
    momentum_regressors,
    momentum_terms,
    rigid_motion,
)
from gcomp.gravity.torque import gravity_torque


def moves(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    return random.uniform(-2, 2, (6, n)), random.normal(size=(6, n)), random.normal(size=(6, n))


def test_momentum_changes_as_lagrange_s_equation_says(placed):
    arm, links = placed.arm.arm, bar_inertials(placed)
    q, v, a = moves(arm.n)
    torque = inertial_torque(placed, q, v, a) + gravity_torque(arm, placed.arm.beta, q)
    step = 1e-5
    after, before = (
        momentum_terms(rigid_motion(arm, q + h * v + h * h / 2 * a, v + h * a), links)[0] for h in (step, -step)
    )
    _, rest, _ = momentum_terms(rigid_motion(arm, q, v), links)
    assert (after - before) / (2 * step) - rest == pytest.approx(torque, abs=1e-6)


def test_the_terms_are_linear_in_the_links_parameters(placed):
    arm, links = placed.arm.arm, bar_inertials(placed)
    q, v, _ = moves(arm.n)
    motion = rigid_motion(arm, q, v)
    for by_parameter, term in zip(momentum_regressors(motion), momentum_terms(motion, links)[:2], strict=True):
        assert by_parameter @ links.ravel() == pytest.approx(term, abs=1e-12)


def test_what_gravity_shows_is_parted_from_what_motion_alone_shows(placed):
    arm = placed.arm.arm
    columns = gravity_split(arm)
    assert np.linalg.matrix_rank(columns) == 10 * arm.n
    links = columns[:, 2 * arm.n :].T.reshape(-1, arm.n, 10)
    for each in links:
        assert base_parameters(arm, each[:, 0], each[:, 1:4]) == pytest.approx(np.zeros(2 * arm.n), abs=1e-12)


def test_a_force_on_a_link_turns_the_joints_as_in_mujoco(placed):
    arm, (q, v, _) = placed.arm.arm, moves(4)
    model, data = placed.model, mujoco.MjData(placed.model)
    link, point, force, moment = 2, np.array([0.1, -0.05, 0.2]), np.array([3.0, -1.0, 2.0]), np.array([0.2, 0.5, -0.4])
    base, here = placed.geometry, rigid_motion(arm, q, v)
    first = base.bar[0] @ _turn(-arm.theta_offset[0] - placed.reference[0])
    pushed = np.einsum("kdn,d->kn", jacobian(here, link, point), np.concatenate([first.T @ force, first.T @ moment]))
    for row, pose in enumerate(q):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        at = base.origins[0] + first @ (here.origin[row, link] + here.rotation[row, link] @ point)
        torque = np.zeros(model.nv)
        mujoco.mj_applyFT(model, data, force, moment, at, placed.bodies[link][0], torque)
        assert pushed[row] == pytest.approx(torque, abs=1e-9)


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
