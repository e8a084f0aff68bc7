"""Recordings of an arm that is wrong in a known way, made by MuJoCo's inverse dynamics on smooth random motion."""

from copy import copy
from dataclasses import dataclass, field

import mujoco
import numpy as np

from armlink.recording.recording import Recording

THREE = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
<body name="link_1" pos="0 0 0.3"><joint name="joint_1" axis="0 1 0"/>
 <inertial pos="0.02 0.01 0.15" mass="5" diaginertia="0.06 0.06 0.02"/>
 <body name="link_2" pos="0 0 0.35"><joint name="joint_2" axis="1 0 0"/>
  <inertial pos="0.01 0.03 0.14" mass="3" diaginertia="0.03 0.03 0.01"/>
  <body name="link_3" pos="0 0 0.3"><joint name="joint_3" axis="0 1 0"/>
   <inertial pos="0.04 0.01 0.10" mass="1.5" diaginertia="0.01 0.01 0.004"/>
  </body></body></body>
</worldbody></mujoco>
"""

LANDS = 0.3
"""Torque at which the play of a gear is crossed [N·m]."""


@dataclass
class Wrong:
    """What is wrong with the real arm; all zero is the nominal arm. Per joint (n,) unless said otherwise."""

    coulomb: np.ndarray | float = 0.0
    viscous: np.ndarray | float = 0.0
    breakaway: np.ndarray | float = 0.0
    stribeck_velocity: float = 0.1
    load: np.ndarray | float = 0.0
    rotor: np.ndarray | float = 0.0
    ratio: np.ndarray | float = 0.0
    gain: np.ndarray | float = 1.0
    offset: np.ndarray | float = 0.0
    drift: np.ndarray | float = 0.0
    motor_gain: np.ndarray | float = 1.0
    spring: np.ndarray | float = 0.0
    ripple: np.ndarray | float = 0.0
    cycles: float = 9.0
    position_offset: np.ndarray | float = 0.0
    play: np.ndarray | float = 0.0
    """Full width of the play between motor, where positions are read, and link [rad]."""
    payload: float = 0.0
    payload_at: tuple[float, float, float] = (0.02, 0.03, 0.2)
    moved: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """Shift of the centre of mass of a link [m]."""
    tilt: tuple[float, float] = (0.0, 0.0)


def model(xml: str = THREE) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def motion(n: int, seconds: float, rate: float, seed: int, speed: float = 0.6) -> tuple[np.ndarray, ...]:
    """Time and smooth multi-sine position, velocity and acceleration, (K,) and (K, n) each."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / rate)
    q, v, a = (np.zeros((len(t), n)) for _ in range(3))
    for j in range(n):
        for frequency in random.uniform(0.05, 0.35, 4):
            w, phase = 2 * np.pi * frequency, random.uniform(0, 2 * np.pi)
            size = speed / w / 2
            q[:, j] += size * np.sin(w * t + phase)
            v[:, j] += size * w * np.cos(w * t + phase)
            a[:, j] -= size * w**2 * np.sin(w * t + phase)
    return t, q, v, a


def record(
    nominal: mujoco.MjModel,
    wrong: Wrong,
    seed: int = 0,
    seconds: float = 60.0,
    rate: float = 50.0,
    noise: float = 0.02,
    channels: tuple[str, ...] = ("tau", "tau_motor"),
) -> Recording:
    """A recording of the arm that is wrong like this; noise is that of the torque channels [N·m]."""
    return record_along(motion(nominal.nv, seconds, rate, seed), nominal, wrong, seed, noise, channels)


def record_along(
    moved: tuple[np.ndarray, ...],
    nominal: mujoco.MjModel,
    wrong: Wrong,
    seed: int = 0,
    noise: float = 0.02,
    channels: tuple[str, ...] = ("tau", "tau_motor"),
) -> Recording:
    """As `record`, along a motion: time (K,) and position, velocity, acceleration (K, n)."""
    random = np.random.default_rng(seed + 1000)
    t, q, v, a = moved
    true = q + wrong.position_offset
    link = _inverse(_truth(nominal, wrong), true, v, a) + wrong.spring * true
    if np.any(wrong.play):
        true = true - 0.5 * np.asarray(wrong.play) * np.tanh(link / LANDS)
        link = _inverse(_truth(nominal, wrong), true, v, a) + wrong.spring * true
    level = wrong.coulomb + wrong.load * np.abs(link) + wrong.breakaway * np.exp(-((v / wrong.stribeck_velocity) ** 2))
    friction = np.tanh(v / 0.002) * level * (1 + wrong.ratio * np.sign(v)) + wrong.viscous * v
    motor = link + friction + wrong.rotor * a + wrong.ripple * np.sin(wrong.cycles * true + 0.4)
    tau = wrong.gain * link + wrong.offset + wrong.drift * t[:, None]
    return Recording(
        t=t,
        position=q,
        torque=tau + noise * random.normal(size=q.shape) if "tau" in channels else None,
        motor_torque=motor / wrong.motor_gain + noise * random.normal(size=q.shape)
        if "tau_motor" in channels
        else None,
    )


def _truth(nominal: mujoco.MjModel, wrong: Wrong) -> mujoco.MjModel:
    real = copy(nominal)
    for link, shift in wrong.moved.items():
        real.body_ipos[link + 1] += shift
    if wrong.payload:
        tip, mass = real.nbody - 1, real.body_mass[-1]
        at = np.array(wrong.payload_at)
        centre = (mass * real.body_ipos[tip] + wrong.payload * at) / (mass + wrong.payload)
        inertia = np.diag(real.body_inertia[tip])
        for m, c in ((mass, real.body_ipos[tip] - centre), (wrong.payload, at - centre)):
            inertia = inertia + m * (c @ c * np.eye(3) - np.outer(c, c))
        values, axes = np.linalg.eigh(inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        real.body_ipos[tip], real.body_mass[tip], real.body_inertia[tip] = centre, mass + wrong.payload, values
        mujoco.mju_mat2Quat(real.body_iquat[tip], axes.ravel())
    x, y = wrong.tilt
    turn = np.array([[1, 0, -y], [0, 1, x], [y, -x, 1.0]])
    real.opt.gravity[:] = turn @ nominal.opt.gravity
    return real


def _inverse(real: mujoco.MjModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data, out = mujoco.MjData(real), np.empty_like(q)
    real.opt.disableflags |= 1
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(real, data)
        out[k] = data.qfrc_inverse
    return out
