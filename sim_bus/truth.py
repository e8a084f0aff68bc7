"""Hidden truth of a simulated arm: true sensor parameters, which a fit must find without seeing them."""

from dataclasses import dataclass

import mujoco
import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.model_file import read_model
from sim_bus.effects.quasi_direct import QuasiDirect
from sim_bus.sim_section import sim_section

GAIN_RANGE = (0.9, 1.1)
OFFSET_SHARE = 0.05
"""Largest torque offset as a share of rated torque."""
POSITION_GAIN_RANGE = (0.99, 1.01)
ATTACHMENT_RANGE = 0.15
"""Largest lateral distance of the reference mass from the last axis [m]."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Sensors `v = gain·τ + offset`, `θ = position_gain·φ + position_offset`, (n,) each; arrays are read-only."""

    gain: Array
    offset: Array
    """[N·m]."""
    position_gain: Array
    position_offset: Array
    """[rad]."""
    attachment: Array
    """Attachment point of a reference mass in the last link's bar frame [m] (3,)."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            array = np.array(getattr(self, name), float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, arm: ArmFile) -> "Truth":
        """The truth stated in the arm file's `sim.sensors`. Raises BadInput."""
        n, section = len(arm.joint_names), sim_section(arm)
        sensors = section.sensors
        if section.quasi_direct is not None:
            return cls._of_drives(arm, section.quasi_direct, section.quasi_direct.seed)

        def values(given: tuple[float, ...] | None, default: float) -> Array:
            return np.full(n, default) if given is None else np.array(given)

        return cls(
            gain=values(sensors.gain, 1.0),
            offset=values(sensors.offset, 0.0),
            position_gain=values(sensors.position_gain, 1.0),
            position_offset=values(sensors.position_offset, 0.0),
            attachment=flange(arm),
        )

    @classmethod
    def draw(cls, arm: ArmFile, seed: int) -> "Truth":
        """Draw a truth from uniform distributions.

        Gains 0.9 to 1.1, offsets ±5 % of rated torque, position gains 0.99 to 1.01. The reference mass
        is up to 0.15 m to the side of the flange. With `sim.quasi_direct` its ranges count. Raises BadInput.
        """
        random, stated = np.random.default_rng(seed), cls.of(arm)
        rated, drives = arm.require_link().rated_torques, sim_section(arm).quasi_direct
        n = len(rated)
        lateral = random.uniform(-ATTACHMENT_RANGE, ATTACHMENT_RANGE, 2)
        if drives is not None:
            return cls._of_drives(arm, drives, seed)
        return cls(
            gain=random.uniform(*GAIN_RANGE, n),
            offset=random.uniform(-OFFSET_SHARE, OFFSET_SHARE, n) * rated,
            position_gain=random.uniform(*POSITION_GAIN_RANGE, n),
            position_offset=stated.position_offset,
            attachment=stated.attachment + across_last_axis(arm) @ lateral,
        )

    @classmethod
    def _of_drives(cls, arm: ArmFile, drives: QuasiDirect, seed: int) -> "Truth":
        """The truth of quasi-direct drives, drawn; the reference mass is up to 0.15 m to the side of the flange."""
        rated = arm.require_link().rated_torques
        n = len(rated)
        lateral = np.random.default_rng([seed, 55]).uniform(-ATTACHMENT_RANGE, ATTACHMENT_RANGE, 2)
        place = flange(arm) + across_last_axis(arm) @ lateral
        return cls(drives.gains(n, seed), drives.offsets(rated, seed), np.ones(n), drives.zeros(n, seed), place)


def flange(arm: ArmFile) -> Array:
    """Origin of the arm's last frame in the last link's bar frame, `(a, 0, d)`; a model's tip body origin is 0 [m]."""
    if not arm.kinematics.joints:
        return np.zeros(3)
    last = arm.kinematics.joints[-1]
    return np.array([last.a, 0.0, last.d])


def across_last_axis(arm: ArmFile) -> Array:
    """Two directions (3, 2) in the last link's bar frame, at right angles to the last joint's axis and each other."""
    turn, axes = np.array([1.0, 0.0, 0.0, 0.0]), np.empty(9)
    if arm.model_path is not None:
        axis = read_model(arm.model_path, arm.kinematics.locked).spec.joint(arm.joint_names[-1]).axis
        mujoco.mju_quatZ2Vec(turn, axis / np.linalg.norm(axis))
    mujoco.mju_quat2Mat(axes, turn)
    return axes.reshape(3, 3)[:, :2]
