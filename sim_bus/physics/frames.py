"""Kinematics that differ from the drawing: each joint's frame turned and shifted a little."""

from typing import Any

import mujoco
import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections


class ModelFrames:
    """Keeps the nominal frames of a compiled model and writes changed ones into it."""

    def __init__(self, model: Any, bodies: list[int]) -> None:
        """`bodies` carry the links, base to tip."""
        self._model, self._bodies = model, bodies
        self._place: Array = model.body_pos[bodies].copy()
        self._turn: Array = model.body_quat[bodies].copy()

    def apply(self, state: Imperfections) -> None:
        """Set the nominal frames, changed by `frame_turn` and `frame_shift`; mj_setConst is the caller's."""
        shift, turn = np.empty(3), np.empty(4)
        for row, body in enumerate(self._bodies):
            mujoco.mju_rotVecQuat(shift, state.frame_shift[row], self._turn[row])
            self._model.body_pos[body] = self._place[row] + shift
            angle = float(np.linalg.norm(state.frame_turn[row]))
            mujoco.mju_axisAngle2Quat(turn, state.frame_turn[row] / angle if angle else np.array([0, 0, 1.0]), angle)
            mujoco.mju_mulQuat(self._model.body_quat[body], self._turn[row], turn)
