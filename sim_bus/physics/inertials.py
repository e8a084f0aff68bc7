"""Frames and inertial parameters of the links in the physics: nominal, with effects and attached masses."""

from typing import Any

import mujoco
import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections
from sim_bus.physics.mjcf import TINY_INERTIA


class ModelBodies:
    """Keeps the nominal frames and inertials of a compiled model and writes changed ones into it."""

    def __init__(self, model: Any, bodies: list[int], payload_body: int) -> None:
        """`bodies` carry the links, base to tip; `payload_body` the attached mass."""
        self._model, self._bodies, self._payload = model, bodies, payload_body
        self._mass: Array = model.body_mass.copy()
        self._com: Array = model.body_ipos.copy()
        self._inertia = _full_inertia(model)
        self._place: Array = model.body_pos[bodies].copy()
        self._turn: Array = model.body_quat[bodies].copy()

    def turn_frames(self, state: Imperfections) -> None:
        """Set the nominal frames, changed by `frame_turn` and `frame_shift`; `weigh` comes after it."""
        shift, turn = np.empty(3), np.empty(4)
        for row, body in enumerate(self._bodies):
            mujoco.mju_rotVecQuat(shift, state.frame_shift[row], self._turn[row])
            self._model.body_pos[body] = self._place[row] + shift
            angle = float(np.linalg.norm(state.frame_turn[row]))
            mujoco.mju_axisAngle2Quat(turn, state.frame_turn[row] / angle if angle else np.array([0, 0, 1.0]), angle)
            mujoco.mju_mulQuat(self._model.body_quat[body], self._turn[row], turn)

    def weigh(self, state: Imperfections, attached: Array) -> None:
        """Set the nominal inertials plus effects plus `attached` (mass [kg], point in the last bar frame [m])."""
        model, bodies = self._model, self._bodies
        mass, com, inertia = self._mass.copy(), self._com.copy(), self._inertia.copy()
        com[bodies] += state.mass_moment / mass[bodies, None]
        inertia[bodies] += state.inertia
        points = [item for item in (state.payload, attached) if item[0] != 0.0]
        load = TINY_INERTIA + sum(item[0] for item in points)
        mass[self._payload] = load
        com[self._payload] = sum((item[0] * item[1:] for item in points), np.zeros(3)) / load
        inertia[self._payload] = np.array([1, 1, 1, 0, 0, 0]) * TINY_INERTIA
        for item in points:
            inertia[self._payload] += item[0] * _point_inertia(item[1:] - com[self._payload])
        model.body_mass[:], model.body_ipos[:] = mass, com
        for body in (*bodies, self._payload):
            model.body_inertia[body], model.body_iquat[body] = _principal(inertia[body])
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _full_inertia(model: mujoco.MjModel) -> Array:
    """Inertias about the centres of mass along the bodies' axes (bodies, 6): xx, yy, zz, xy, xz, yz."""
    full, turn = np.empty((model.nbody, 6)), np.empty(9)
    for body in range(model.nbody):
        mujoco.mju_quat2Mat(turn, model.body_iquat[body])
        axes = turn.reshape(3, 3)
        matrix = axes @ np.diag(model.body_inertia[body]) @ axes.T
        full[body] = matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return full


def _principal(inertia: Array) -> tuple[Array, Array]:
    """Principal moments and the quaternion of the principal axes."""
    xx, yy, zz, xy, xz, yz = inertia
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return moments, quaternion


def _point_inertia(arm: Array) -> Array:
    x, y, z = arm
    return np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
