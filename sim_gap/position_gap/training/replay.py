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
from sim_gap.model.load import SimModel
from sim_gap.position_gap.search import Group, LoopSearch, without_group
from sim_gap.position_gap.training.export import Exported, export_beside_module

OPENING_S = 1.0
"""Time at the start that is not judged [s]."""
LONGEST_S, SHORT_S = 60.0, 15.0
"""Longest part of a recording that is replayed [s], and that is for an effect alone or left out."""


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


def simulated_model(sim: SimModel, made: Exported) -> Simulated:
    """A written model with what its module applies."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(made.xml)
    return Simulated(model, tuple(sim.joints), Effects(model, made.effects, sim.arm.names) if made.effects else None)


def without_groups(sim: SimModel, search: LoopSearch, made: Exported, groups: Sequence[Group]) -> Simulated:
    """The written model less some effects, the others as they are."""
    fit = made.fit
    for group in groups:
        fit = without_group(search, fit, group)
    return simulated_model(sim, export_beside_module(sim, search, fit, fit))


def replay(arm: Simulated, recording: Recording, longest: float = LONGEST_S) -> tuple[Array, Array, Array]:
    """Times (K,), simulated and measured positions (K, n) of one recording from its first command to the first that
    is missing; nothing of one without commands.

    The model starts at the measured position at rest, as if the first command had been there for long; each joint's
    actuator gets the command held from row to row, for at most `longest` [s].
    """
    import mujoco

    model, joints = arm.model, list(arm.joints)
    recording = slice_rows(recording, commanded_rows(recording, longest))
    given, rows = recording.position_command, len(recording.t)
    assert given is not None
    if not rows:
        return recording.t, recording.position, recording.position
    data = mujoco.MjData(model)
    adr = model.jnt_qposadr[joints]
    data.qpos[adr] = recording.position[0]
    drives = [actuator_of(model, joint) for joint in joints]
    hold(model, data, drives, given[0])
    controls = model.actuator_ctrladr[drives]
    dt = float(model.opt.timestep)
    times, out = recording.t, np.empty((rows, len(joints)))
    at = 0
    mujoco.set_mjcb_passive(None if arm.effects is None else arm.effects.passive)
    try:
        for k in range(int((times[-1] - times[0]) / dt) + 1):
            now = times[0] + k * dt
            while at + 1 < rows and times[at + 1] <= now + 1e-9:
                out[at + 1] = data.qpos[adr]
                at += 1
            data.ctrl[controls] = given[at]
            mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
        if arm.effects is not None:
            model.dof_frictionloss[arm.effects.dofs] = arm.effects.coulomb
    out[0], out[at + 1 :] = recording.position[0], data.qpos[adr]
    return times, out, recording.position


def replay_rms(
    arm: Simulated,
    recordings: Sequence[Recording],
    gains: Sequence[float] = (),
    longest: float = LONGEST_S,
    apart: Sequence[Mask] = (),
) -> Array:
    """RMS of simulated minus measured positions over recordings [rad], (n,); NaN if none is commanded long enough.

    `gains` are those of the controller in each recording over the model's, by default 1; rows of each recording that
    are set `apart` (K,) are not judged.
    """
    total, count = np.zeros(len(arm.joints)), np.zeros(len(arm.joints))
    gains = gains or [1.0] * len(recordings)
    apart = apart or [np.zeros(len(recording.t), bool) for recording in recordings]
    for recording, gain, left_out in zip(recordings, gains, apart, strict=True):
        part = commanded_rows(recording, longest)
        if np.diff(recording.t[part]).sum() < 2.0 * OPENING_S:
            continue
        t, positions, measured = replay(arm.with_gain(gain), recording, longest)
        gap = (positions - measured)[judged_rows(t, left_out[part])]
        total += np.nansum(gap**2, axis=0)
        count += np.isfinite(gap).sum(0)
    return np.asarray(np.sqrt(total / np.where(count > 0, count, np.nan)))


def judged_rows(t: Array, left_out: Mask) -> Mask:
    """Replayed rows that are judged, (K,): those after the opening that are not left out."""
    return np.asarray(t - t.min(initial=np.inf) >= OPENING_S) & ~left_out


def commanded_rows(recording: Recording, longest: float = LONGEST_S) -> slice:
    """Rows of a recording from the first at which all joints are commanded to the first at which one is not, at most
    `longest` [s] later."""
    assert recording.position_command is not None
    given = np.flatnonzero(np.isfinite(recording.position_command).all(axis=1))
    if not given.size:
        return slice(0, 0)
    first, last = int(given[0]), int(given[0]) + int(np.argmax(np.diff(given, append=-1) != 1))
    return slice(first, min(last + 1, int(np.searchsorted(recording.t, recording.t[first] + longest, side="right"))))


def actuator_of(model: Any, joint: int) -> int:
    """Number of the actuator that drives a joint."""
    import mujoco

    own = (model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    return int(np.flatnonzero(own)[0])
