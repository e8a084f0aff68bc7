"""Arms with quasi-direct drives as users have them: OpenArm's model, hidden drives, recorded as motor torque alone.

Recordings are made by MuJoCo's inverse dynamics on smooth random motion; nothing of them is shared with the diagnosis.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files

import mujoco
import numpy as np
from scipy.signal import butter, sosfiltfilt

from armlink.recording.recording import Recording

Array = np.ndarray
Arrays = tuple[Array, ...]
RATED = np.array([20.0, 20.0, 9.0, 9.0, 3.0, 3.0, 3.0])
"""Rated torque of the drives [N·m]."""
QUANTA = np.array([26e-3, 26e-3, 14e-3, 14e-3, 5e-3, 5e-3, 5e-3])
"""Step of the torque that the drives report [N·m]."""
POSITION_STEP = 3.8e-4
"""Step of the position that they report [rad]."""
AVERAGED_S = 0.01
"""Time over which a drive averages the torque that it reports [s]."""
FASTEST = 1.0
"""Fastest motion of a joint [rad/s]."""
SUBSTEPS = 5
"""Steps of the truth a row of the recording."""


@dataclass(frozen=True)
class Drawn:
    """What is hidden in one arm, (7,) each: what a user wants to know, then what no effect of the library holds."""

    constant: Array
    """k: torque that a drive makes for each newton metre that it takes itself to make."""
    coulomb: Array
    viscous: Array
    load: Array
    rotor: Array
    """Rotor inertia beyond the model's [kg·m²]."""
    lag: Array
    """From command to torque [s]."""
    offset: Array
    """Of the current reading [N·m]."""
    zero: Array
    """Error of the position zeros [rad]."""
    mass: Array
    """Mass of each link as a share of the model's."""
    uneven: Array
    phase: Array
    """Friction over position: share of the Coulomb friction, and where it is largest [rad]."""
    leaning: Array
    """Half the difference of the directions' friction, as a share of it."""


def draw(seed: int, *, zeros: float = 0.002, masses: float = 0.01) -> Drawn:
    """The hidden truth of one arm: levels as users report them (docs/no-torque-sensors.md)."""
    random = np.random.default_rng([seed, 77])
    n = len(RATED)
    return Drawn(
        constant=random.uniform(0.65, 1.35, n),
        coulomb=RATED * random.uniform(0.015, 0.045, n),
        viscous=RATED * random.uniform(0.008, 0.025, n),
        load=random.uniform(0.0, 0.1, n),
        rotor=RATED * random.uniform(0.001, 0.006, n),
        lag=random.uniform(0.005, 0.03, n),
        offset=RATED * random.uniform(-0.01, 0.01, n),
        zero=zeros * np.clip(random.standard_normal(n), -2.0, 2.0),
        mass=1.0 + masses * random.standard_normal(n),
        uneven=random.uniform(0.05, 0.2, n),
        phase=random.uniform(0.0, 2.0 * np.pi, n),
        leaning=random.uniform(-0.1, 0.1, n),
    )


def nominal() -> mujoco.MjModel:
    """The arm as its maker describes it."""
    with as_file(files("sim_bus.arms") / "openarm.xml") as path:
        return mujoco.MjModel.from_xml_path(str(path))


def names_of_joints() -> tuple[str, ...]:
    """Names of the joints, base to tip."""
    model = nominal()
    return tuple(model.joint(j).name for j in range(model.njnt))


def truths(truth: Drawn) -> dict[str, Array]:
    """First parameter of each effect that has to be named, (7,): the lag is that of the torque that is reported."""
    return {
        "actuator.gain": truth.constant,
        "friction.coulomb": truth.coulomb,
        "friction.viscous": truth.viscous,
        "friction.load": truth.load,
        "actuator.rotor_inertia": truth.rotor,
        "actuator.lag": truth.lag + 0.5 * AVERAGED_S,
    }


def shares(truth: Drawn, seed: int, seconds: float) -> dict[str, Array]:
    """RMS that each effect adds to the reported or commanded torque in a motion [N·m], (7,)."""
    parts = _chain(truth, seed, seconds, 100.0)
    low = butter(4, 6.0, fs=100.0 * SUBSTEPS, output="sos")
    moving = np.abs(parts.v) > 0.03
    alone = {
        "actuator.gain": parts.current - parts.motor,
        "friction.coulomb": parts.coulomb / truth.constant,
        "friction.viscous": truth.viscous * parts.v / truth.constant,
        "friction.load": parts.load / truth.constant,
        "actuator.rotor_inertia": truth.rotor * parts.a / truth.constant,
        "actuator.lag": parts.ahead - parts.current,
    }
    smooth = {name: sosfiltfilt(low, x, axis=0) for name, x in alone.items()}
    return {name: np.sqrt(np.sum(x**2 * moving, axis=0) / moving.sum(0)) for name, x in smooth.items()}


@dataclass(frozen=True)
class _Chain:
    """From motion to current and command, (K, 7) each."""

    t: Array
    q: Array
    v: Array
    a: Array
    coulomb: Array
    load: Array
    motor: Array
    current: Array
    ahead: Array


@cache
def _links(
    masses: tuple[float, ...], zeros: tuple[float, ...], seed: int, seconds: float, rate: float
) -> tuple[Array, ...]:
    """Motion, and the torque of links of these masses."""
    model = nominal()
    t, v, a, q = _motion(model, seconds, rate, seed)
    _reweigh(model, masses)
    return t, q, v, a, _inverse(model, q + np.array(zeros), v, a)


def _chain(truth: Drawn, seed: int, seconds: float, rate: float) -> _Chain:
    t, q, v, a, link = _links(tuple(truth.mass), tuple(truth.zero), seed, seconds, rate * SUBSTEPS)
    sign = np.tanh(v / 2e-3)
    coulomb = truth.coulomb * (1.0 + truth.uneven * np.sin(q + truth.phase)) * sign
    load = truth.load * np.abs(link) * sign
    motor = link + (coulomb + load) * (1.0 + truth.leaning * np.sign(v)) + truth.viscous * v
    motor = motor + (truth.rotor + nominal().dof_armature) * a
    current = motor / truth.constant
    ahead = current + truth.lag * np.gradient(current, t, axis=0)
    return _Chain(t, q, v, a, coulomb, load, motor, current, ahead)


def recording(truth: Drawn, seed: int, seconds: float = 60.0, rate: float = 100.0, command: bool = True) -> Recording:
    """One motion of all joints, as positions, motor torque and, on demand, commands."""
    parts = _chain(truth, seed, seconds, rate)
    random = np.random.default_rng([seed, 78])
    size, n = max(1, round(AVERAGED_S * rate * SUBSTEPS)), len(RATED)
    sums = np.cumsum(np.vstack([np.zeros((size, n)), parts.current]), axis=0)
    mean = (sums[size:] - sums[:-size]) / size
    mean[:size] = parts.current[:size]
    rows = slice(None, None, SUBSTEPS)
    noise = 0.3 * QUANTA * random.standard_normal(parts.q[rows].shape)
    return Recording(
        t=parts.t[rows],
        position=POSITION_STEP * np.round(parts.q[rows] / POSITION_STEP),
        motor_torque=QUANTA * np.round((mean[rows] + truth.offset + noise) / QUANTA),
        torque_command=parts.ahead[rows] + truth.offset if command else None,
        names=names_of_joints(),
    )


def _motion(model: mujoco.MjModel, seconds: float, rate: float, seed: int) -> tuple[Array, Array, Array, Array]:
    """Time (K,), then velocity, acceleration and position (K, n): sums of sines within range and speed."""
    random = np.random.default_rng([seed, 79])
    t = np.arange(0.0, seconds, 1.0 / rate)
    low, high = model.jnt_range.T
    q, v, a = (np.zeros((len(t), model.nv)) for _ in range(3))
    for j in range(model.nv):
        for frequency in random.uniform(0.04, 0.4, 4):
            w, phase = 2 * np.pi * frequency, random.uniform(0, 2 * np.pi)
            size = min(0.4 * (high[j] - low[j]) / 4, FASTEST / 4 / w)
            q[:, j] += size * np.sin(w * t + phase)
            v[:, j] += size * w * np.cos(w * t + phase)
            a[:, j] -= size * w**2 * np.sin(w * t + phase)
    return t, v, a, q + (low + high) / 2


def _reweigh(model: mujoco.MjModel, masses: tuple[float, ...]) -> None:
    """The links' masses as they truly are."""
    for body in range(model.nbody):
        joint = next((j for j in range(model.njnt) if model.jnt_bodyid[j] == body), None)
        if joint is not None:
            model.body_mass[body] *= masses[joint]
            model.body_inertia[body] *= masses[joint]


def _inverse(model: mujoco.MjModel, q: Array, v: Array, a: Array) -> Array:
    """Torque of the links, without rotors."""
    data, out = mujoco.MjData(model), np.empty_like(q)
    bare = model.dof_armature.copy()
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse - bare * a[k]
    return out
