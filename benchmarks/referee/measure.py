"""How far a model is from a recording that no tool has seen: the same measures for every tool, on its MJCF alone.

With torques: *residual*, the measured torque minus MuJoCo's inverse dynamics of the model with its friction, as a share
of the measured torque; *roll-out*, the position after windows that start from the measured state and are driven by the
measured torque. Without: *residual*, the position within windows under the recorded commands; *roll-out*, the whole
recording running free. Each is one number over all joints.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.signal import butter, sosfiltfilt

STEP_S = 0.002
BAND_HZ = 6.0
"""Band of the torque residual, as in the blind check (sim_gap/blind/cases.py)."""
STATE_HZ = 15.0
"""Low pass of positions before they are differentiated (sim_gap/blind/cases.py)."""
LEAST_SPEED = 0.02
"""Speed below which friction is not determined, so that a row does not count [rad/s] (sim_gap/blind/scene.py)."""
TORQUE_WINDOW_S, POSITION_WINDOW_S = 0.25, 1.0
"""Length of a window [s]: under a recorded torque any arm strays with time."""
PAST_S = 0.5
"""Time before a window by which servos get their state."""
SETTLING_S = 1.0
"""Time at both ends that is not judged: filters settle, and a simulation from rest."""
FLOOR = {"share": 0.005, "position": 2e-4}
"""What readings leave of the best model: noise of a torque over the torque, and noise and counts of an encoder [rad].
It is added to every error, so that an arm that is like its model does not make ratios of noise."""
DIVERGED_RAD = np.pi
"""Error of a position that counts where a simulation diverges."""


@dataclass(frozen=True)
class Even:
    """A recording at STEP_S: positions, velocities and accelerations (K, n), and its other channels."""

    q: Any
    v: Any
    a: Any
    torque: Any | None
    command: Any | None


def even(recording: dict[str, Any]) -> Even:
    """Columns at even times: positions and torques along straight lines, commands held."""
    t, q = (np.asarray(recording[name], float) for name in ("t", "q"))
    clock = np.arange(t[0], t[-1], STEP_S)
    rate = 1.0 / float(np.median(np.diff(t)))
    low = butter(4, min(STATE_HZ, 0.4 * rate), fs=1.0 / STEP_S, output="sos")
    smooth = sosfiltfilt(low, _at(clock, t, q), axis=0)
    v = np.gradient(smooth, STEP_S, axis=0)
    torque = recording.get("tau_motor", recording.get("tau"))
    held = np.clip(np.searchsorted(t, clock + 1e-9, side="right") - 1, 0, len(t) - 1)
    command = None if "q_cmd" not in recording else np.asarray(recording["q_cmd"], float)[held]
    driven = None if torque is None else _at(clock, t, np.asarray(torque, float))
    return Even(smooth, v, np.gradient(v, STEP_S, axis=0), driven, command)


def _at(clock: Any, t: Any, values: Any) -> Any:
    return np.column_stack([np.interp(clock, t, column) for column in values.T])


def errors(xml: str, joints: tuple[str, ...], kind: str, recording: dict[str, Any]) -> dict[str, float]:
    """Residual and roll-out of a model. Raises ValueError if MuJoCo does not take it, a joint is missing, or the
    recording is shorter than three windows."""
    model, seen = mujoco.MjModel.from_xml_string(xml), even(recording)
    if len(seen.q) * STEP_S < 2.0 * SETTLING_S + 3.0 * POSITION_WINDOW_S:
        raise ValueError("the recording is too short")
    ids, servos = actuated(model, joints, kind)
    at, dof = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    if kind == "positions":
        window = round(POSITION_WINDOW_S / STEP_S)
        every = {"residual": window, "rollout": len(seen.q)}
        moved = {name: _driven_by_commands(model, ids, servos, seen, length) for name, length in every.items()}
        return {name: float(np.hypot(error, FLOOR["position"])) for name, error in moved.items()}
    return {
        "residual": float(np.hypot(_residual(model, at, dof, seen), FLOOR["share"])),
        "rollout": float(np.hypot(_driven_by_torque(model, at, dof, seen), FLOOR["position"])),
    }


def actuated(model: Any, joints: tuple[str, ...], kind: str) -> tuple[list[int], list[int]]:
    """Numbers of the joints, and with positions alone of their actuators. Raises ValueError where one is missing."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joints]
    if min(ids) < 0:
        raise ValueError(f"model: it lacks the joint {joints[ids.index(-1)]}")
    servos = []
    for name, joint in zip(joints, ids, strict=True) if kind == "positions" else ():
        found = np.flatnonzero((model.actuator_trntype == 0) & (model.actuator_trnid[:, 0] == joint))
        if not len(found):
            raise ValueError(f"model: it has no actuator at joint {name}")
        servos.append(int(found[0]))
    return ids, servos


def _residual(model: Any, at: Any, dof: Any, seen: Even) -> float:
    """RMS of the torque that the model lacks, as a share of the measured torque's RMS, over all joints."""
    _let_friction_alone_constrain(model)
    data, rows = mujoco.MjData(model), np.arange(0, len(seen.q), 2)
    nominal = np.empty((len(rows), len(dof)))
    for k, row in enumerate(rows):
        data.qpos[at], data.qvel[dof], data.qacc[dof] = seen.q[row], seen.v[row], seen.a[row]
        mujoco.mj_inverse(model, data)
        nominal[k] = data.qfrc_inverse[dof]
    speed = seen.v[rows]
    low = butter(4, BAND_HZ, fs=0.5 / STEP_S, output="sos")
    rest, torque = (sosfiltfilt(low, x, axis=0) for x in (seen.torque[rows] - nominal, seen.torque[rows]))
    ends = round(0.5 * SETTLING_S / STEP_S)
    moving = (np.abs(speed) > LEAST_SPEED)[ends:-ends]
    shares = [
        np.mean(rest[ends:-ends, j][moving[:, j]] ** 2) / np.mean(torque[ends:-ends, j] ** 2)
        for j in range(len(dof))
        if moving[:, j].any()
    ]
    return float(np.sqrt(np.mean(shares)))


def _let_friction_alone_constrain(model: Any) -> None:
    """Without actuators, limits and contacts; friction is MuJoCo's own, which the solver holds as a constraint."""
    off = mujoco.mjtDisableBit
    model.opt.disableflags &= ~int(off.mjDSBL_CONSTRAINT)
    model.opt.disableflags |= int(off.mjDSBL_ACTUATION | off.mjDSBL_LIMIT | off.mjDSBL_CONTACT)


def _driven_by_torque(model: Any, at: Any, dof: Any, seen: Even) -> float:
    """RMS over windows and joints of the position error under the measured torque [rad]."""
    _let_friction_alone_constrain(model)
    model.opt.timestep = STEP_S
    length, ends, squares = round(TORQUE_WINDOW_S / STEP_S), round(SETTLING_S / STEP_S), []
    data = mujoco.MjData(model)
    for start in range(ends, len(seen.q) - ends - length, length):
        mujoco.mj_resetData(model, data)
        data.qpos[at], data.qvel[dof] = seen.q[start], seen.v[start]
        made = np.empty((length, len(dof)))
        for k in range(length):
            data.qfrc_applied[dof] = seen.torque[start + k]
            mujoco.mj_step(model, data)
            made[k] = data.qpos[at]
        squares.append(_square(made, seen.q[start + 1 : start + 1 + length]))
    return float(np.sqrt(np.mean(squares)))


def _driven_by_commands(model: Any, ids: Any, servos: list[int], seen: Even, length: int) -> float:
    """RMS over windows of this length and joints of the position error under the recorded commands [rad]."""
    at, dof = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    model.opt.timestep = STEP_S
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT)
    settling, squares, data = round(SETTLING_S / STEP_S), [], mujoco.MjData(model)
    whole = length >= len(seen.q)
    for start in [0] if whole else range(settling, len(seen.q) - settling - length, length):
        mujoco.mj_resetData(model, data)
        _with_past_commands(model, data, at, dof, servos, seen, start)
        data.qpos[at], data.qvel[dof] = seen.q[start], 0.0 if whole else seen.v[start]
        end = min(start + length, len(seen.q) - 1)
        made = np.empty((end - start, len(dof)))
        for k in range(start, end):
            data.ctrl[servos] = seen.command[k]
            mujoco.mj_step(model, data)
            made[k - start] = data.qpos[at]
        skip = settling if whole else 0
        squares.append(_square(made[skip:], seen.q[start + 1 + skip : end + 1]))
    return float(np.sqrt(np.mean(squares)))


def _with_past_commands(model: Any, data: Any, at: Any, dof: Any, servos: list[int], seen: Even, start: int) -> None:
    """Let servos have the state that the commands and the motion before a window leave them in: filters, delays and
    limits of their speed. Before the recording its first row holds."""
    for row in np.maximum(np.arange(start - round(PAST_S / STEP_S), start), 0):
        data.qpos[at], data.qvel[dof], data.ctrl[servos] = seen.q[row], seen.v[row] * (row > 0), seen.command[row]
        mujoco.mj_step(model, data)


def _square(made: Any, seen: Any) -> float:
    """Mean square of the error, at most that of a simulation that diverged."""
    wrong = np.nan_to_num(made - seen, nan=DIVERGED_RAD, posinf=DIVERGED_RAD, neginf=-DIVERGED_RAD)
    return float(np.mean(np.clip(wrong, -DIVERGED_RAD, DIVERGED_RAD) ** 2))
