"""Imperfections of an arm that MJCF cannot hold, for a MuJoCo simulation of it. Needs only numpy and mujoco.

    model = mujoco.MjModel.from_xml_path(MODEL)
    effects = Effects(model)
    mujoco.set_mjcb_passive(effects.passive)     # friction, ripple
    data = mujoco.MjData(model)
    while running:
        data.qfrc_applied[effects.dofs] = effects.made(command, data.time)   # drives: delay, lag, limit, gain
        mujoco.mj_step(model, data)
        q, tau = effects.read(model, data)       # readings of position and torque sensors

Many arms at once, in a simulator that takes no callback (MuJoCo Warp, MJX, mjlab): before each step give every world

    dry, lost = effects.resistance(q, v, carried, driven)    # (worlds, n) each

`dry` as its `dof_frictionloss` and subtract `lost` from its `qfrc_applied`; `carried` is the sum of passive, applied,
actuator and constraint forces of the last step less armature · acceleration, `driven` is applied and actuator force
less `carried`.

How far a simulation with these effects strays from a recording (rad, RMS per joint):

    stray = roll_out(model, effects, t, position, motor_torque)

Torques in N·m, angles in rad, times in s; arrays (n,) in the order of JOINTS, recordings (K,) and (K, n).
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from gcomp.arm.rigid_body import CREEP
from gcomp.arrays import Array
from sim_gap.effects.torque import GRADUAL

JointEffect = tuple[str, str, dict[str, Any]]
"""Effect, joint, parameters: a number each; of a law, its points `at`, the `torque` there, and whether it is `directed`
against the motion."""
MODEL = ""
"""File of the model that these effects belong to."""
JOINTS: tuple[str, ...] = ()
"""Base to tip."""
EFFECTS: tuple[JointEffect, ...] = ()
LAWS = ("law.position", "law.velocity", "law.load", "law.time", "law.temperature")
"""Torques that follow one quantity of their joint; what causes them is not known."""
PASSIVE = (
    "friction.bearing",
    "friction.stribeck",
    "friction.load",
    "friction.asymmetric",
    "transmission.ripple",
    *LAWS,
)
"""Effects that act on the joints themselves."""
HORIZON_S, WINDOWS, STEP_S = 0.5, 40, 0.002
"""Length of a forward simulation from a recorded state, number of them over a recording, largest time step, also of a
model whose actuators have delays."""
LOST, WILD = np.pi, 50.0
"""Limits of a joint's deviation [rad] and speed [rad/s]: without friction and rotor inertia a light joint would diverge
and the simulation with it."""


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
        self._plays: Array = np.zeros((len(GRADUAL), len(self.joints)))
        self._whole: Array = np.zeros(model.nv)
        self.temperature: Array | None = None
        """Of the joints [°C], (n,), for laws of temperature; None leaves those out."""

    def values(self, effect: str, parameter: str, otherwise: float = 0.0) -> Array:
        """One parameter of an effect for every joint, (n,); `otherwise` for joints without the effect."""
        if (effect, parameter) not in self._known:
            out = self._known[effect, parameter] = np.full(len(self.joints), otherwise)
            for name, joint, parameters in self._effects:
                if name == effect and parameter in parameters:
                    out[self.joints.index(joint)] = parameters[parameter]
        return self._known[effect, parameter]

    # ---- the transmission

    @property
    def resist(self) -> bool:
        """Whether any effect acts on the joints beside what the model holds."""
        return any(name in PASSIVE or "lost" in parameters for name, _, parameters in self._effects)

    def passive(self, model: Any, data: Any) -> None:
        """MuJoCo's passive-force callback: the ripple torque now, and the level of dry friction for the next step."""
        position, speed, carried = data.qpos[self.places], data.qvel[self.dofs], self.carried(model, data)
        driven = data.qfrc_applied[self.dofs] + data.qfrc_actuator[self.dofs] - carried
        level, lost = self.resistance(position, speed, carried, driven, float(data.time))
        model.dof_frictionloss[self.dofs] = level
        data.qfrc_passive[self.dofs] -= lost

    def resistance(
        self, position: Array, speed: Array, carried: Array, driven: Array, time: float = 0.0, xp: Any = np
    ) -> tuple[Array, Array]:
        """Dry friction, for `dof_frictionloss`, and torque that is lost besides [N·m], (…, n) each.

        Of any number of arms at once, without callback or state: arrays (…, n) of the joints' position and speed, of
        the torque that their links carry, and of what drives them beyond it. `xp` is the library of the arrays: numpy,
        or jax.numpy within a function that is compiled.
        """
        fade = xp.exp(-((speed / self.values("friction.stribeck", "velocity", 1.0)) ** 2))
        level = self.coulomb + self.values("friction.stribeck", "breakaway") * fade
        level = level + self.values("friction.load", "coefficient") * xp.abs(carried)
        heading = xp.where(xp.abs(speed) < 1e-4, xp.sign(driven), xp.sign(speed))  # at rest the motor sets it
        level = level * (1.0 + self.values("friction.asymmetric", "ratio") * heading)
        level = level + self.values("friction.bearing", "torque")
        angle = self.values("transmission.ripple", "cycles") * position
        ripple = xp.sin(angle + self.values("transmission.ripple", "phase"))
        lost = self.values("transmission.ripple", "amplitude") * ripple + self.values("torque.offset", "lost")
        lost = lost + self.values("friction.bearing", "damping") * speed
        return xp.maximum(level, 0.0), lost + self._lawful(position, speed, carried, time, xp)

    def _lawful(self, position: Array, speed: Array, carried: Array, time: float, xp: Any) -> Any:
        """Torque that the laws take now, (…, n)."""
        laws = [(name, self.joints.index(joint), law) for name, joint, law in self._effects if name in LAWS]
        if not laws:
            return 0.0
        everywhere = xp.zeros_like(speed)
        temperature = None if self.temperature is None else self.temperature + everywhere
        quantities = dict(zip(LAWS, (position, speed, carried, time + everywhere, temperature), strict=True))
        out = 0.0
        for name, k, law in laws:
            value = quantities[name]
            if value is None:
                continue
            amount = law["directed"] and name in ("law.velocity", "law.load")
            at, torque = np.array(law["at"]), np.array(law["torque"])
            taken = xp.interp(xp.abs(value[..., k]) if amount else value[..., k], at, torque)
            taken = taken * xp.clip(speed[..., k] / CREEP, -1.0, 1.0) if law["directed"] else taken
            out = out + taken[..., None] * np.eye(len(self.joints))[k]
        return out

    def carried(self, model: Any, data: Any) -> Array:
        """Torque on the links, M(q) a + C(q, v) v + gravity of the last step, (n,)."""
        mujoco.mj_rne(model, data, 1, self._whole)
        return np.array(self._whole[self.dofs])

    # ---- the drives

    def made(self, command: Array, time: float) -> Array:
        """Torque of the drives with `command` from now on: delayed, lagging, clipped, scaled.

        The model's own motors have all that in the file: their `ctrl` is the command as it is.
        """
        self._commands.append((time, np.array(command, float)))
        due = _past(self._commands, time, self.values("actuator.delay", "time"), held=True)
        before = self._commands[-2][0] if len(self._commands) > 1 else time
        lag = np.maximum(self.values("actuator.lag", "time"), 1e-12)
        share = 1.0 - np.exp(-(time - before) / lag)
        start = due if self._followed is None else self._followed
        self._followed = start + share * (due - start)
        limit = self.values("actuator.saturation", "limit", np.inf)
        return np.asarray(np.clip(self._followed, -limit, limit) * self.values("actuator.gain", "gain", 1.0))

    def drive(self, t: Array, torque: Array, source: str = "motor") -> Array:
        """Torque of the motors from a recorded channel (K, n): the drives' own estimate (`motor`), a command that they
        follow (`command`), or a torque sensor where no other channel is (`sensor`)."""
        if source == "command":
            self._commands, self._followed = [], None
            return np.array([self.made(now, time) for time, now in zip(t.tolist(), torque, strict=True)])
        if source == "sensor":
            drift = self.values("torque.drift", "rate") * t[:, None] + self.values("torque.offset", "offset")
            return np.asarray((torque - drift) / self.values("torque.gain", "gain", 1.0))
        return np.asarray(torque * self.values("actuator.gain", "gain", 1.0))

    # ---- the sensors

    def state(self, reading: Array, speed: Array, torque: Array) -> tuple[Array, Array]:
        """Angle and speed of the links from those of the position sensors and the torque through the joints."""
        phase = reading + self.values("position.eccentricity", "phase")
        amplitude, gain = self.values("position.eccentricity", "amplitude"), self.values("position.gain", "gain", 1.0)
        angle = gain * reading + self.values("position.offset", "offset") + amplitude * np.sin(phase)
        return angle - self._give(torque), (gain + amplitude * np.cos(phase)) * speed

    def _give(self, torque: Array) -> Array:
        """Angle by which the transmissions give [rad]."""
        give = torque / self.values("transmission.elasticity", "stiffness", np.inf)
        return np.asarray(give + 0.5 * self.values("transmission.backlash", "width") * np.sign(torque))

    def read(self, model: Any, data: Any) -> tuple[Array, Array]:
        """Readings of position [rad] and torque [N·m] sensors after a step, (n,) each.

        An elastic transmission or one with backlash shows in the position, whose sensor is at the motor; its
        oscillation is neglected.
        """
        rows = np.flatnonzero(data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
        pushed = data.qfrc_constraint.copy()  # by stops and contacts on the links
        pushed[data.efc_id[rows]] -= data.efc_force[rows]
        torque = self.carried(model, data) - pushed[self.dofs]
        give = self._give(torque)
        return self.angle(data.qpos[self.places] + give), self._torque(torque, float(data.time))

    @property
    def is_elastic(self) -> bool:
        """Whether the reading of a position depends on the torque."""
        return any(name in ("transmission.elasticity", "transmission.backlash") for name, _, _ in self._effects)

    def angle(self, true: Array) -> Array:
        """The reading φ with true = gain·φ + offset + amplitude·sin(φ + phase), (…, n)."""
        straight = true - self.values("position.offset", "offset")
        gain = self.values("position.gain", "gain", 1.0)
        amplitude, phase = (self.values("position.eccentricity", name) for name in ("amplitude", "phase"))
        reading = straight / gain
        for _ in range(8 if amplitude.any() else 0):  # contracts by amplitude / gain each time
            reading = (straight - amplitude * np.sin(reading + phase)) / gain
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
        gradual = self.values("torque.hysteresis", "gradual")
        halves = self.values("torque.hysteresis", "width") * (1.0 + gradual * (np.array(GRADUAL)[:, None] - 1.0))
        self._plays = np.clip(self._plays, mixed - halves, mixed + halves)
        held = self._plays.mean(axis=0)
        dead = np.maximum(np.abs(held) - self.values("torque.deadband", "width"), 0.0)
        limit = self.values("torque.saturation", "limit", np.inf)
        bent = np.clip(np.sign(held) * dead, -limit, limit)
        drift = self.values("torque.drift", "rate") * time + self.values("torque.offset", "offset")
        return np.asarray(self.values("torque.gain", "gain", 1.0) * bent + drift)


def roll_out(
    model: Any,
    effects: Effects,
    t: Array,
    position: Array,
    torque: Array,
    source: str = "motor",
    horizon: float = HORIZON_S,
    windows: int = WINDOWS,
) -> Array:
    """How far simulations from recorded states under the recorded torque stray from the recording [rad], RMS, (n,).

    `t` (K,) and readings (K, n) as recorded; `source` as in `Effects.drive`. NaN if the recording is shorter than a
    window. The model's contacts and limits are switched off; joints that the recording does not have are locked.
    """
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.dof_armature[np.setdiff1d(np.arange(model.nv), effects.dofs)] = 1e9  # locked: they stay at rest
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)
    q, tau = (_even(even, t, values) for values in (position, torque))
    drive = effects.drive(even - even[0], tau, source)
    # the state at the start is that of a parabola through the readings within 60 ms of it
    steps, beside = round(horizon / step), max(2, round(0.06 / step))
    last = len(even) - steps - beside - 1
    if last <= beside:
        return np.full(len(effects.joints), np.nan)
    starts = np.unique(np.linspace(beside, last, windows).astype(int))
    near = step * np.arange(-beside, beside + 1)
    fit = np.linalg.pinv(np.vander(near, 3, increasing=True))
    squares = np.zeros(len(effects.joints))
    mujoco.set_mjcb_passive(effects.passive if effects.resist else None)
    try:
        for start in starts.tolist():
            at = fit @ q[start - beside : start + beside + 1]
            state = effects.state(at[0], at[1], drive[start])
            rows = slice(start, start + steps + 1)
            stray = _window(model, effects, state, drive[rows], q[rows][1:], step, start * step)
            squares += np.mean(stray**2, axis=0)
    finally:
        mujoco.set_mjcb_passive(None)
        model.dof_frictionloss[effects.dofs] = effects.coulomb
    return np.asarray(np.sqrt(squares / len(starts)))


def _even(even: Array, t: Array, values: Array) -> Array:
    columns = [np.interp(even, t[there := np.isfinite(x)], x[there]) for x in values.T]
    return np.column_stack(columns)


def _window(
    model: Any,
    effects: Effects,
    state: tuple[Array, Array],
    drive: Array,
    reading: Array,
    step: float,
    time: float,
) -> Array:
    """Simulated minus recorded reading over one window that begins at `time`, (steps, n)."""
    each = max(1, int(np.ceil(step / STEP_S)))
    model.opt.timestep = step / each
    data = mujoco.MjData(model)
    data.qpos[effects.places], data.qvel[effects.dofs] = state
    data.time = time
    out, speed, elastic = np.empty_like(reading), data.qvel, effects.is_elastic
    for k, torque in enumerate(0.5 * (drive[:-1] + drive[1:])):
        data.qfrc_applied[effects.dofs] = torque
        for _ in range(each):
            mujoco.mj_step(model, data)
            np.minimum(np.maximum(speed, -WILD, out=speed), WILD, out=speed)
        out[k] = effects.read(model, data)[0] if elastic else data.qpos[effects.places]
    return np.clip((out if elastic else effects.angle(out)) - reading, -LOST, LOST)


def _past(history: list[tuple[float, Array]], now: float, delay: Array, *, held: bool) -> Array:
    """Value of each joint `delay` ago, held or interpolated between entries; drops entries no longer needed."""
    while len(history) > 2 and history[1][0] <= now - delay.max() - 1e-12:
        del history[0]
    times, values = np.array([time for time, _ in history]), np.array([value for _, value in history])
    if held:
        rows = np.clip(np.searchsorted(times, now - delay + 1e-9, side="right") - 1, 0, None)
        return np.asarray(values[rows, np.arange(len(delay))])
    return np.array([np.interp(now - late, times, column) for late, column in zip(delay, values.T, strict=True)])
