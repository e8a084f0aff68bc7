"""All imperfections of a simulated arm as arrays: effects write them; plant, drives and sensors read them."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array

INITIAL = {
    **dict.fromkeys(("actuator_gain", "torque_gain", "position_gain"), 1.0),
    **dict.fromkeys(("actuator_saturation", "torque_saturation", "elasticity"), np.inf),
    "stribeck_velocity": 0.01,
}
"""Values of arrays that are not 0 in an arm without imperfections."""


class Imperfections:
    """Imperfections of an arm, per joint (n,) unless noted otherwise; initially none."""

    names: tuple[str, ...]
    coulomb: Array
    """Coulomb friction [N·m]."""
    viscous: Array
    """[N·m·s/rad]."""
    breakaway: Array
    """Static friction in excess of Coulomb friction [N·m]."""
    stribeck_velocity: Array
    """[rad/s]."""
    asymmetry: Array
    """Friction is (1 + a) times as large for positive motion and (1 − a) for negative."""
    load_friction: Array
    """Friction torque per transmitted torque [1]."""
    ripple: Annotated[Array, "n", 3]
    """Amplitude [N·m], cycles [1/rad], phase [rad] (n, 3)."""
    spring: Annotated[Array, "n", 2]
    """Stiffness [N·m/rad] and rest angle [rad] (n, 2)."""
    elasticity: Array
    """Stiffness between motor and link [N·m/rad]; infinite if rigid."""
    backlash: Array
    """Full width of the backlash between motor and link [rad]."""
    coupling: Annotated[Array, "n", "n"]
    """Turn of motor i per turn of joint j ≠ i (n, n)."""
    rotor_inertia: Array
    """Reflected to the joint [kg·m²]."""
    actuator_gain: Array
    actuator_lag: Array
    """[s]."""
    actuator_delay: Array
    """[s]."""
    actuator_saturation: Array
    """[N·m]; infinite if there is no limit."""
    torque_gain: Array
    torque_offset: Array
    """[N·m]."""
    torque_drift: Array
    """[N·m/s]."""
    crosstalk: Annotated[Array, "n", "n"]
    """Torque reading of joint i per torque of joint j (n, n)."""
    hysteresis: Array
    """Half width [N·m]."""
    deadband: Array
    """Half width [N·m]."""
    torque_saturation: Array
    """[N·m]; infinite if there is no limit."""
    position_gain: Array
    position_offset: Array
    """[rad]."""
    eccentricity: Annotated[Array, "n", 2]
    """Amplitude [rad] and phase [rad] (n, 2)."""
    torque_delay: Array
    """[s]."""
    mass_moment: Annotated[Array, "n", 3]
    """Added m·s of each link in its bar frame [kg·m] (n, 3)."""
    inertia: Annotated[Array, "n", 6]
    """Added inertia of each link about its centre of mass: xx, yy, zz, xy, xz, yz [kg·m²] (n, 6)."""
    payload: Annotated[Array, 4]
    """Mass [kg] and centre of mass in the last bar frame [m] (4,)."""
    tilt: Annotated[Array, 2]
    """Rotation of the base about its x and y axes [rad] (2,)."""
    cubic: Array
    """Deviation of the torque sensor at full scale that grows with the cube of torque, as a share of full scale."""
    warm_up: Annotated[Array, "n", 2]
    """How much lower the torque sensor's zero is when cold [N·m], and the time constant of warming up [s] (n, 2)."""
    cable: Annotated[Array, "n", 5]
    """Stiffness [N·m/rad], bend per turn of the next joint [1], rest from mid-range [rad], pull that lags [N·m] and
    the bend over which it does [rad] (n, 5)."""
    compliance: Array
    """Turn of the link against its position sensor per transmitted torque [rad/(N·m)]."""
    frame_turn: Annotated[Array, "n", 3]
    """Rotation of each joint's frame against the drawing, about its own x, y and z axes [rad] (n, 3)."""
    frame_shift: Annotated[Array, "n", 3]
    """Place of each joint's frame against the drawing, along its own axes [m] (n, 3)."""
    uneven: Annotated[Array, "n", 4]
    """Coulomb friction: amplitude over a turn as a share and its phase [rad], friction per transmitted torque, and the
    share by which it is higher when cold (n, 4)."""
    leaning: Array
    """Like `asymmetry`, for friction that is brought up to date once a cycle [1]."""
    cogging: Annotated[Array, "n", 3]
    """Like `ripple`, brought up to date once a cycle: for joints that move slowly (n, 3)."""
    warm_constant: Annotated[Array, "n", 3]
    """Loss of the torque constant when warm [1], time constant [s] and rise of temperature [K] of warming up (n, 3)."""

    def __init__(self, names: tuple[str, ...]) -> None:
        """Shapes as annotated, where "n" stands for the number of joints; by default (n,)."""
        self.names = names
        for name, kind in list(type(self).__annotations__.items())[1:]:
            shape = tuple(len(names) if size == "n" else size for size in getattr(kind, "__metadata__", ("n",)))
            setattr(self, name, np.full(shape, INITIAL.get(name, 0.0)))

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
