"""All imperfections of a simulated arm as arrays: effects write them; plant, drives and sensors read them."""

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array


@dataclass
class Imperfections:
    """Imperfections of an arm, per joint (n,) unless noted otherwise; initially none."""

    names: tuple[str, ...]
    coulomb: Array = field(init=False)
    """Coulomb friction [N·m]."""
    viscous: Array = field(init=False)
    """[N·m·s/rad]."""
    breakaway: Array = field(init=False)
    """Static friction in excess of Coulomb friction [N·m]."""
    stribeck_velocity: Array = field(init=False)
    """[rad/s]."""
    asymmetry: Array = field(init=False)
    """Friction is (1 + a) times as large for positive motion and (1 − a) for negative."""
    load_friction: Array = field(init=False)
    """Friction torque per transmitted torque [1]."""
    ripple: Array = field(init=False)
    """Amplitude [N·m], cycles [1/rad], phase [rad] (n, 3)."""
    spring: Array = field(init=False)
    """Stiffness [N·m/rad] and rest angle [rad] (n, 2)."""
    elasticity: Array = field(init=False)
    """Stiffness between motor and link [N·m/rad]; infinite if rigid."""
    backlash: Array = field(init=False)
    """Full width of the backlash between motor and link [rad]."""
    coupling: Array = field(init=False)
    """Turn of motor i per turn of joint j ≠ i (n, n)."""
    rotor_inertia: Array = field(init=False)
    """Reflected to the joint [kg·m²]."""
    actuator_gain: Array = field(init=False)
    actuator_lag: Array = field(init=False)
    """[s]."""
    actuator_delay: Array = field(init=False)
    """[s]."""
    actuator_saturation: Array = field(init=False)
    """[N·m]; infinite if there is no limit."""
    torque_gain: Array = field(init=False)
    torque_offset: Array = field(init=False)
    """[N·m]."""
    torque_drift: Array = field(init=False)
    """[N·m/s]."""
    crosstalk: Array = field(init=False)
    """Torque reading of joint i per torque of joint j (n, n)."""
    hysteresis: Array = field(init=False)
    """Half width [N·m]."""
    deadband: Array = field(init=False)
    """Half width [N·m]."""
    torque_saturation: Array = field(init=False)
    """[N·m]; infinite if there is no limit."""
    position_gain: Array = field(init=False)
    position_offset: Array = field(init=False)
    """[rad]."""
    eccentricity: Array = field(init=False)
    """Amplitude [rad] and phase [rad] (n, 2)."""
    torque_delay: Array = field(init=False)
    """[s]."""
    mass_moment: Array = field(init=False)
    """Added m·s of each link in its bar frame [kg·m] (n, 3)."""
    inertia: Array = field(init=False)
    """Added inertia of each link about its centre of mass: xx, yy, zz, xy, xz, yz [kg·m²] (n, 6)."""
    payload: Array = field(init=False)
    """Mass [kg] and centre of mass in the last bar frame [m] (4,)."""
    tilt: Array = field(init=False)
    """Rotation of the base about its x and y axes [rad] (2,)."""
    cubic: Array = field(init=False)
    """Deviation of the torque sensor at full scale that grows with the cube of torque, as a share of full scale."""
    warm_up: Array = field(init=False)
    """How much lower the torque sensor's zero is when cold [N·m], and the time constant of warming up [s] (n, 2)."""
    cable: Array = field(init=False)
    """Stiffness [N·m/rad], bend per turn of the next joint [1], rest from mid-range [rad], pull that lags [N·m] and
    the bend over which it does [rad] (n, 5)."""
    compliance: Array = field(init=False)
    """Turn of the link against its position sensor per transmitted torque [rad/(N·m)]."""
    frame_turn: Array = field(init=False)
    """Rotation of each joint's frame against the drawing, about its own x, y and z axes [rad] (n, 3)."""
    frame_shift: Array = field(init=False)
    """Place of each joint's frame against the drawing, along its own axes [m] (n, 3)."""
    uneven: Array = field(init=False)
    """Coulomb friction: amplitude over a turn as a share and its phase [rad], friction per transmitted torque, and the
    share by which it is higher when cold (n, 4)."""
    leaning: Array = field(init=False)
    """Like `asymmetry`, for friction that is brought up to date once a cycle [1]."""
    cogging: Array = field(init=False)
    """Like `ripple`, brought up to date once a cycle: for joints that move slowly (n, 3)."""
    warm_constant: Array = field(init=False)
    """Loss of the torque constant when warm [1], time constant [s] and rise of temperature [K] of warming up (n, 3)."""

    def __post_init__(self) -> None:
        n = len(self.names)
        square, pair = (n, n), (n, 2)
        shapes: dict[str, tuple[int, ...]] = {"ripple": (n, 3), "spring": pair, "tilt": (2,)}
        shapes |= {
            "coupling": square,
            "crosstalk": square,
            "eccentricity": pair,
            "mass_moment": (n, 3),
            "inertia": (n, 6),
            "payload": (4,),
            "warm_up": pair,
            "cable": (n, 5),
            "frame_turn": (n, 3),
            "frame_shift": (n, 3),
            "uneven": (n, 4),
            "cogging": (n, 3),
            "warm_constant": (n, 3),
        }
        initial = {"stribeck_velocity": 0.01, "actuator_gain": 1.0, "torque_gain": 1.0, "position_gain": 1.0}
        initial |= {"actuator_saturation": np.inf, "torque_saturation": np.inf, "elasticity": np.inf}
        for item in fields(self):
            if item.name != "names":
                setattr(self, item.name, np.full(shapes.get(item.name, (n,)), initial.get(item.name, 0.0)))

    @property
    def steady_friction(self) -> bool:
        """Whether friction has one level, independent of velocity, direction and load."""
        return not (self.breakaway.any() or self.asymmetry.any() or self.load_friction.any())

    @property
    def soft(self) -> NDArray[np.bool_]:
        """Joints whose motor can turn while the link is at rest, (n,)."""
        return np.isfinite(self.elasticity) | (self.backlash > 0)

    @property
    def gearing(self) -> bytes:
        """Key of how the motors are geared to the joints; empty if each turns rigidly with its own."""
        if not (self.soft.any() or self.coupling.any()):
            return b""
        return self.soft.tobytes() + self.coupling.tobytes()

    @property
    def prompt_motors(self) -> bool:
        """Whether motors produce the commanded torque at once and transmit all of it."""
        return not (self.actuator_lag.any() or self.actuator_delay.any() or self.ripple[:, 0].any())
