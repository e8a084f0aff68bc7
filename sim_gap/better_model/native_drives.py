"""Gain, limit, lag and delay of drives in the motors that a model has: MuJoCo's own fields, which run in batch."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import SHORTEST_DELAY

DRIVE = {"actuator.gain": "gain", "actuator.saturation": "limit", "actuator.lag": "time", "actuator.delay": "time"}
"""Effects that a motor holds → their parameter."""
MOST_SAMPLES, LEAST_STEP_S = 1000, 0.0005
"""A delay is kept by commands, one per step of the simulation: so many at most, and enough for steps this short [s]."""


def motors_of(spec: Any) -> dict[str, Any]:
    """The actuators of a `mujoco.MjSpec` that make a torque in proportion to their control, by joint name."""
    plain = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE)
    return {
        each.target: each
        for each in spec.actuators
        if each.trntype == mujoco.mjtTrn.mjTRN_JOINT and (each.dyntype, each.gaintype, each.biastype) == plain
    }


def put_drive(motor: Any, found: Mapping[str, float]) -> None:
    """Give a motor what was found of its drive, effect → value: N·m, s, or the ratio of torque to command."""
    gear = np.array(motor.gear)
    if (limit := found.get("actuator.saturation")) is not None:
        most = limit / abs(gear[0])
        known = motor.forcerange[1] if motor.forcerange[0] < motor.forcerange[1] else np.inf
        motor.forcelimited, motor.forcerange = 1, [-min(most, known), min(most, known)]
    if (lag := found.get("actuator.lag", 0.0)) > 0.0:
        motor.dyntype, motor.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, lag
    put_delay(motor, found.get("actuator.delay", 0.0))
    motor.gear = [gear[0] * found.get("actuator.gain", 1.0), *gear[1:]]


def put_delay(actuator: Any, delay: float) -> None:
    """Let an actuator follow its control so much later [s]; less than a millisecond is none."""
    if delay >= SHORTEST_DELAY:
        actuator.delay = delay
        actuator.nsample = min(MOST_SAMPLES, int(np.ceil(delay / LEAST_STEP_S)) + 2)


def resting_command(
    command: Array | float,
    position: Array | float,
    asked: Array | float,
    friction: Array | float,
    stiffness: Array | float,
) -> Array:
    """The nearest to a command under which a joint at rest stays at its position.

    `asked` is the torque that a servo of this stiffness has to hold, `friction` what holds by itself (theory.md,
    section 13).
    """
    low, high = (position + (asked + side * friction) / stiffness for side in (-1.0, 1.0))
    return np.asarray(np.clip(command, low, high))


def hold(model: Any, data: Any, actuators: Sequence[int], commands: Array) -> None:
    """Let actuators be as they are at joints that rest where they are: as if each had been given its command (n,) for
    long, or the nearest to it under which friction keeps the joint where it is.

    A simulation that begins takes every earlier command for 0: with a delay, a lag or a slew limit it first drives the
    joint there. The integral part of a PID holds what gravity and springs ask for. `data` has its positions; the
    commands are written to `ctrl`.
    """
    mujoco.mj_forward(model, data)
    asked_for = data.qfrc_bias - data.qfrc_passive
    pid, lags = mujoco.mjtDyn.mjDYN_PID, (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    for i, command in zip(actuators, commands.tolist(), strict=True):
        data.ctrl[model.actuator_ctrladr[i]] = command
        gear, joint, kp = model.actuator_gear[i, 0], model.actuator_trnid[i, 0], -model.actuator_biasprm[i, 1]
        length, dof = gear * data.qpos[model.jnt_qposadr[joint]], model.jnt_dofadr[joint]
        asked, friction = asked_for[dof] / gear, model.dof_frictionloss[dof] / abs(gear)
        ki = model.actuator_gainprm[i, 0] if model.actuator_dyntype[i] == pid else 0.0
        if kp > 0.0:
            command = float(resting_command(command, length, 0.0 if ki > 0.0 else asked, friction, kp))
        if count := int(model.actuator_history[i, 0]):
            mujoco.mj_initCtrlHistory(model, data, i, None, np.full((count, 1), command))
        state = data.act[model.actuator_actadr[i] : model.actuator_actadr[i] + model.actuator_actnum[i]]
        kind = mujoco.mjtDyn(int(model.actuator_dyntype[i]))
        if kind in lags or (kind == pid and model.actuator_dynprm[i, 1] > 0.0):
            state[0] = command
        if ki > 0.0:
            state[-1] = (asked - kp * (command - length)) / ki
