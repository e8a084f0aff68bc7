"""Imperfections of an arm that MJCF cannot hold, for a MuJoCo simulation of it. Needs only numpy and mujoco.

    model = mujoco.MjModel.from_xml_path(MODEL)
    effects = Effects(model)
    mujoco.set_mjcb_passive(effects.passive)     # friction, ripple
    data = mujoco.MjData(model)
    while running:
        data.qfrc_applied[effects.dofs] = effects.made(command, data.time)   # drives: delay, lag, limit, gain
        mujoco.mj_step(model, data)
        q, tau = effects.read(model, data)       # readings of position and torque sensors

Torques in N·m, angles in rad, times in s; arrays (n,) in the order of JOINTS.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from gcomp.arrays import Array

JointEffect = tuple[str, str, dict[str, float]]
"""Effect, joint, parameters."""
MODEL = ""
"""File of the model that these effects belong to."""
JOINTS: tuple[str, ...] = ()
"""Base to tip."""
EFFECTS: tuple[JointEffect, ...] = ()
RESTING = 1e-4
"""Speed below which a joint is at rest [rad/s], and its motor torque sets the direction of friction."""


class Effects:
    """The effects on one simulated arm, with the state of drives and sensors."""

    def __init__(self, model: Any, effects: Sequence[JointEffect] = EFFECTS, joints: Sequence[str] = JOINTS) -> None:
        """For a compiled model with joints of these names; its friction loss is the Coulomb friction."""
        self.joints, self._effects = tuple(joints), tuple(effects)
        ids = [model.joint(name).id for name in joints]
        self.dofs, self.places = model.jnt_dofadr[ids], model.jnt_qposadr[ids]
        self.coulomb: Array = model.dof_frictionloss[self.dofs].copy()
        self._known: dict[tuple[str, str], Array] = {}
        self._commands: list[tuple[float, Array]] = []
        self._followed: Array | None = None
        self._passed: list[tuple[float, Array]] = []
        self._play: Array = np.zeros(len(self.joints))
        self._whole: Array = np.zeros(model.nv)

    def values(self, effect: str, parameter: str, otherwise: float = 0.0) -> Array:
        """One parameter of an effect for every joint, (n,); `otherwise` for joints without the effect."""
        if (effect, parameter) not in self._known:
            out = self._known[effect, parameter] = np.full(len(self.joints), otherwise)
            for name, joint, parameters in self._effects:
                if name == effect and parameter in parameters:
                    out[self.joints.index(joint)] = parameters[parameter]
        return self._known[effect, parameter]

    # ---- the transmission

    def passive(self, model: Any, data: Any) -> None:
        """MuJoCo's passive-force callback: the ripple torque now, and the level of dry friction for the next step."""
        speed, carried = data.qvel[self.dofs], self.carried(model, data)
        fade = np.exp(-((speed / self.values("friction.stribeck", "velocity", 1.0)) ** 2))
        level = self.coulomb + self.values("friction.stribeck", "breakaway") * fade
        level = level + self.values("friction.load", "coefficient") * np.abs(carried)
        driven = data.qfrc_applied[self.dofs] + data.qfrc_actuator[self.dofs] - carried
        heading = np.where(np.abs(speed) < RESTING, np.sign(driven), np.sign(speed))
        level = level * (1.0 + self.values("friction.asymmetric", "ratio") * heading)
        model.dof_frictionloss[self.dofs] = np.maximum(level, 0.0)
        angle = self.values("transmission.ripple", "cycles") * data.qpos[self.places]
        ripple = np.sin(angle + self.values("transmission.ripple", "phase"))
        lost = self.values("transmission.ripple", "amplitude") * ripple + self.values("torque.offset", "lost")
        data.qfrc_passive[self.dofs] -= lost

    def carried(self, model: Any, data: Any) -> Array:
        """Torque on the links, M(q) a + C(q, v) v + gravity of the last step, (n,)."""
        mujoco.mj_rne(model, data, 1, self._whole)
        return np.array(self._whole[self.dofs])

    # ---- the drives

    def made(self, command: Array, time: float) -> Array:
        """Torque of the drives with `command` from now on: delayed, lagging, clipped, scaled."""
        self._commands.append((time, np.array(command, float)))
        due = _past(self._commands, time, self.values("actuator.delay", "time"), held=True)
        before = self._commands[-2][0] if len(self._commands) > 1 else time
        lag = np.maximum(self.values("actuator.lag", "time"), 1e-12)
        share = 1.0 - np.exp(-(time - before) / lag)
        start = due if self._followed is None else self._followed
        self._followed = start + share * (due - start)
        limit = self.values("actuator.saturation", "limit", np.inf)
        return np.asarray(np.clip(self._followed, -limit, limit) * self.values("actuator.gain", "gain", 1.0))

    # ---- the sensors

    def read(self, model: Any, data: Any) -> tuple[Array, Array]:
        """Readings of position [rad] and torque [N·m] sensors after a step, (n,) each.

        An elastic transmission or one with backlash shows in the position, whose sensor is at the motor; its
        oscillation is neglected.
        """
        torque = self.carried(model, data) - self._pushed(model, data)
        give = torque / self.values("transmission.elasticity", "stiffness", np.inf)
        give = give + 0.5 * self.values("transmission.backlash", "width") * np.sign(torque)
        return self._angle(data.qpos[self.places] + give), self._torque(torque, float(data.time))

    def _pushed(self, model: Any, data: Any) -> Array:
        """Torque of stops and contacts on the links, (n,)."""
        rows = np.flatnonzero(data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        push = data.qfrc_constraint.copy()
        push[data.efc_id[rows]] -= data.efc_force[rows]
        return np.asarray(push[self.dofs])

    def _angle(self, true: Array) -> Array:
        """The reading φ with true = gain·φ + offset + amplitude·sin(φ + phase)."""
        straight = true - self.values("position.offset", "offset")
        gain = self.values("position.gain", "gain", 1.0)
        reading = straight / gain
        for _ in range(8):  # contracts by amplitude / gain each time
            bent = np.sin(reading + self.values("position.eccentricity", "phase"))
            reading = (straight - self.values("position.eccentricity", "amplitude") * bent) / gain
        return np.asarray(reading)

    def _torque(self, true: Array, time: float) -> Array:
        """The reading of a torque [N·m]: delay, crosstalk, play, dead band, limit, then gain, offset and drift."""
        self._passed.append((time, true))
        torque = _past(self._passed, time, self.values("timing.delay", "delay"), held=False)
        mixed = torque.copy()
        for name, joint, parameters in self._effects:
            if name == "torque.crosstalk":
                source = torque[int(parameters["source"]) - 1]
                mixed[self.joints.index(joint)] += parameters["coefficient"] * source
        width = self.values("torque.hysteresis", "width")
        self._play = np.clip(self._play, mixed - width, mixed + width)
        dead = np.maximum(np.abs(self._play) - self.values("torque.deadband", "width"), 0.0)
        limit = self.values("torque.saturation", "limit", np.inf)
        bent = np.clip(np.sign(self._play) * dead, -limit, limit)
        drift = self.values("torque.drift", "rate") * time + self.values("torque.offset", "offset")
        return np.asarray(self.values("torque.gain", "gain", 1.0) * bent + drift)


def _past(history: list[tuple[float, Array]], now: float, delay: Array, *, held: bool) -> Array:
    """Value of each joint `delay` ago, held or interpolated between entries; drops entries no longer needed."""
    while len(history) > 2 and history[1][0] <= now - delay.max() - 1e-12:
        del history[0]
    times, values = np.array([time for time, _ in history]), np.array([value for _, value in history])
    if held:
        rows = np.clip(np.searchsorted(times, now - delay + 1e-9, side="right") - 1, 0, None)
        return np.asarray(values[rows, np.arange(len(delay))])
    return np.array([np.interp(now - late, times, column) for late, column in zip(delay, values.T, strict=True)])
