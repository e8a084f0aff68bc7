"""Free-running simulation of a MuJoCo model with its own actuators along recorded commands."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array

OPENING_S = 1.0
"""Time at the start that is not judged [s]."""
LONGEST_S = 60.0
"""Longest part of a recording that is replayed [s]."""


def replay(model: Any, joints: Sequence[int], recording: Recording) -> tuple[Array, Array, Array]:
    """Times (K,), simulated and measured positions (K, n) of one recording while it is commanded.

    The model starts at the measured position at rest; each joint's actuator gets the command held from row to row.
    """
    import mujoco

    given = recording.position_command
    assert given is not None
    rows = _commanded(recording)
    data = mujoco.MjData(model)
    adr = model.jnt_qposadr[list(joints)]
    data.qpos[adr] = recording.position[0]
    drive = [_actuator(model, joint) for joint in joints]
    dt = float(model.opt.timestep)
    times, out = recording.t[:rows], np.empty((rows, len(joints)))
    at = 0
    for k in range(int((times[-1] - times[0]) / dt) + 1):
        now = times[0] + k * dt
        while at + 1 < rows and times[at + 1] <= now + 1e-9:
            out[at + 1] = data.qpos[adr]
            at += 1
        data.ctrl[drive] = given[at]
        mujoco.mj_step(model, data)
    out[0], out[at + 1 :] = recording.position[0], data.qpos[adr]
    return times, out, recording.position[:rows]


def replay_rms(model: Any, joints: Sequence[int], recordings: Sequence[Recording]) -> Array:
    """RMS of simulated minus measured positions over recordings [rad], (n,); NaN if none is commanded long enough."""
    total, count = np.zeros(len(joints)), np.zeros(len(joints))
    for recording in recordings:
        if recording.t[_commanded(recording) - 1] - recording.t[0] < 2.0 * OPENING_S:
            continue
        t, simulated, measured = replay(model, joints, recording)
        gap = (simulated - measured)[t >= t[0] + OPENING_S]
        total += np.nansum(gap**2, axis=0)
        count += np.isfinite(gap).sum(0)
    return np.asarray(np.sqrt(total / np.where(count > 0, count, np.nan)))


def _commanded(recording: Recording) -> int:
    """Number of rows from the first that are commanded, at most `LONGEST_S`."""
    assert recording.position_command is not None
    missing = ~np.isfinite(recording.position_command).all(axis=1) | (recording.t > recording.t[0] + LONGEST_S)
    return int(np.argmax(missing)) if missing.any() else len(recording.t)


def _actuator(model: Any, joint: int) -> int:
    """Place in `ctrl` of the position command of the actuator that drives a joint."""
    import mujoco

    own = (model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    index = int(np.flatnonzero(own)[0])
    return int(np.reshape(getattr(model, "actuator_ctrladr", np.arange(model.nu)), -1)[index])
