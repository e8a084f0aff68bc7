"""Free-running simulation of a MuJoCo model with its own actuators along recorded commands."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlink.recording.recording import Recording, slice_rows
from gcomp.arrays import Array, Mask
from sim_gap.better_model.forward_effects import Effects
from sim_gap.better_model.native_drives import hold
from sim_gap.model.load import SimModel, silent
from sim_gap.position_gap.choice import without_groups
from sim_gap.position_gap.fit import Group, LoopSearch
from sim_gap.position_gap.plant import HeldParts, held_model
from sim_gap.position_gap.training.export import Exported, export_beside_module
from sim_gap.position_gap.windows import LEAST_S, WARM_S, WINDOW_S, pieces_of

LONGEST_S = 60.0
"""Longest part of a recording that is replayed [s]."""
SHORT_S, EACH_S = 15.0, 5.0
"""Part of all recordings that is replayed for an effect alone or left out, and least part of each [s]."""


@dataclass(frozen=True)
class Simulated:
    """A compiled model to replay, its joints, and the module's effects on it, if any."""

    model: Any
    joints: tuple[int, ...]
    effects: Effects | None = None

    def with_gain(self, gain: float) -> "Simulated":
        """The same with the gains of the joints' position actuators times `gain`."""
        if gain == 1.0:
            return self
        model = copy(self.model)
        drives = [actuator_of(model, joint) for joint in self.joints]
        model.actuator_gainprm[drives, 0] *= gain  # of a PID actuator the integral part
        model.actuator_biasprm[drives, 1] *= gain
        return replace(self, model=model)


def nominal(sim: SimModel) -> Simulated:
    """The nominal model; all but the arm is held."""
    return Simulated(held_model(sim), tuple(sim.joints))


def simulated_model(sim: SimModel, made: Exported) -> Simulated:
    """A written model with what its module applies; all but the arm is held."""
    import mujoco

    model = held_model(replace(sim, mujoco_model=mujoco.MjModel.from_xml_string(made.xml)))
    return Simulated(model, tuple(sim.joints), Effects(model, made.effects, sim.arm.names) if made.effects else None)


def model_without(sim: SimModel, search: LoopSearch, made: Exported, groups: Sequence[Group]) -> Simulated:
    """The written model less some effects, the others as they are."""
    fit = without_groups(search, made.fit, *groups)
    return simulated_model(sim, export_beside_module(sim, search, fit, fit))


def replay(arm: Simulated, recording: Recording, longest: float = LONGEST_S) -> tuple[Array, Array, Array]:
    """Times (K,), simulated and measured positions (K, n) of the parts of a recording that are commanded without a
    break, for at most `longest` [s] in all.

    Each part begins at its first measured position at rest, under a command that keeps it there (`hold`).
    """
    none = recording.position[:0]
    parts = [(recording.t[:0], none, none)]
    for rows in commanded_rows(recording, longest):
        part = slice_rows(recording, rows)
        parts.append((part.t, _replay(arm, part), part.position))
    t, moved, measured = (np.concatenate(each) for each in zip(*parts, strict=True))
    return t, moved, measured


def _replay(arm: Simulated, recording: Recording) -> Array:
    """Simulated positions of one part, (K, n)."""
    import mujoco

    model, joints = arm.model, list(arm.joints)
    assert recording.position_command is not None
    data, rows = mujoco.MjData(model), len(recording.t)
    adr = model.jnt_qposadr[joints]
    data.qpos[adr] = recording.position[0]
    drives = [actuator_of(model, joint) for joint in joints]
    given = recording.position_command * model.actuator_gear[drives, 0]
    hold(model, data, drives, given[0])
    controls = model.actuator_ctrladr[drives]
    dt, held = float(model.opt.timestep), HeldParts.of(model, joints)
    times, out = recording.t, np.empty((rows, len(joints)))
    mujoco.set_mjcb_passive(None if arm.effects is None else arm.effects.passive)
    try:
        with silent():
            # each row is read, and acts, at the first step that is not before it
            counts = np.diff(np.ceil((times - times[0] - 1e-9) / dt).astype(int), append=0)
            for row in range(rows):
                out[row] = data.qpos[adr]
                data.ctrl[controls] = given[row]
                if not held.places.size and counts[row] > 0:
                    mujoco.mj_step(model, data, counts[row])
                    continue
                for _ in range(counts[row]):
                    mujoco.mj_step(model, data)
                    held.put_back(data)
    finally:
        mujoco.set_mjcb_passive(None)
        if arm.effects is not None:
            model.dof_frictionloss[arm.effects.dofs] = arm.effects.coulomb
    return out


def replay_rms(
    arm: Simulated, recordings: Sequence[Recording], gains: Sequence[float] = (), longest: float = LONGEST_S
) -> Array:
    """RMS of simulated minus measured positions over recordings [rad], (n,); NaN if none is commanded long enough.

    `gains` are those of the controller in each recording over the model's, by default 1.
    """
    total, count = np.zeros(len(arm.joints)), np.zeros(len(arm.joints))
    for recording, gain in zip(recordings, gains or [1.0] * len(recordings), strict=True):
        scaled = arm.with_gain(gain)
        for part in commanded_rows(recording, longest):
            rows = slice_rows(recording, part)
            gap = (_replay(scaled, rows) - rows.position)[judged_rows(rows.t)]
            total += np.nansum(gap**2, axis=0)
            count += np.isfinite(gap).sum(0)
    return np.asarray(np.sqrt(total / np.where(count > 0, count, np.nan)))


def judged_rows(t: Array) -> Mask:
    """Replayed rows that are judged, (K,): those after the opening, or of a short part all but the first."""
    opening = WARM_S if t[-1] - t[0] >= WINDOW_S else 0.0
    return np.asarray(t - t[0] > opening - 1e-9) & (np.arange(len(t)) > 0)


def commanded_rows(recording: Recording, longest: float = LONGEST_S) -> list[slice]:
    """Rows of the parts of a recording in which all joints are commanded and read without a break, for at most
    `longest` [s] in all."""
    assert recording.position_command is not None
    out, left = [], longest
    for piece in pieces_of(recording):
        there = np.isfinite(recording.position_command[piece]).all(axis=1)
        ends = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
        for first, last in (ends + piece.start).reshape(-1, 2).tolist():
            last = min(last, int(np.searchsorted(recording.t, recording.t[first] + left, side="right")))
            if last - first > 1 and recording.t[last - 1] - recording.t[first] >= LEAST_S:
                out.append(slice(first, last))
                left -= float(recording.t[last - 1] - recording.t[first])
    return out


def actuator_of(model: Any, joint: int) -> int:
    import mujoco

    own = (model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    return int(np.flatnonzero(own)[0])
