"""Ranges of joints: a model that stops where the arm was seen to go on cannot follow it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.model.load import SimModel

BEYOND = 0.02
"""Distance beyond the end of its range from which a joint of the model would have to go on [rad]; stops are soft."""
BESIDE = 0.01
"""Room beside the positions and commands that were seen [rad]."""


def wide_enough(sim: SimModel, recordings: Sequence[Recording]) -> SimModel:
    """The model with `arm.range` widened to the recorded positions, where they leave it."""
    ranges = sim.arm.range.copy()
    seen = np.concatenate([recording.position for recording in recordings])
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    ranges[:, 0] = np.where(low < ranges[:, 0] - BEYOND, low - BESIDE, ranges[:, 0])
    ranges[:, 1] = np.where(high > ranges[:, 1] + BEYOND, high + BESIDE, ranges[:, 1])
    return replace(sim, arm=replace(sim.arm, range=ranges))


def widened(sim: SimModel) -> list[int]:
    """Joints whose range is wider than the model's."""
    own = sim.mujoco_model.jnt_range[list(sim.joints)]
    limited = sim.mujoco_model.jnt_limited[list(sim.joints)].astype(bool)
    wider = (sim.arm.range[:, 0] < own[:, 0]) | (sim.arm.range[:, 1] > own[:, 1])
    return [int(j) for j in np.flatnonzero(limited & wider)]


def write_range(joint: Any, actuator: Any, ends: Array, unit: float) -> None:
    """Let a joint of a file, and commands to it, go as far as the ends (2,) [rad]; a joint's angles in its `unit`."""
    low, high = ends.tolist()
    joint.range = [unit * low, unit * high]
    if actuator.ctrllimited and actuator.ctrlrange[0] < actuator.ctrlrange[1]:
        actuator.ctrlrange = [min(actuator.ctrlrange[0], low), max(actuator.ctrlrange[1], high)]
