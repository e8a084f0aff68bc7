"""Parameters of controller and joint, the effect that each belongs to, and the coordinate in which each is fitted."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.solve import LONGEST_STEP


@dataclass(frozen=True)
class LoopParameter:
    name: str
    unit: str
    neutral: float
    """Value without the effect."""
    trial: float
    """Size at which it is tried, in units of the joint's own scale (`scale`)."""
    low: float = 0.0
    high: float = np.inf
    scale: str = "1"
    """`torque` (RMS torque of the joint), `damping`, `inertia`, `angle` (RMS of the error) or `1`."""
    spread: float = 10.0
    """Standard deviation before any recording, in units of the size at which it is tried."""


PARAMETERS = {
    p.name: p
    for p in (
        LoopParameter("kp", "N·m/rad", 0.0, 1.0, 1e-4),
        LoopParameter("kd", "N·m·s/rad", 0.0, 0.05),
        LoopParameter("ki", "N·m/(rad·s)", 0.0, 0.5),
        LoopParameter("feed", "1", 0.0, 1.0, 0.0, 1.5),
        LoopParameter("delay", "s", 0.0, 0.01, -0.05, 0.4),
        LoopParameter("lag", "s", 0.0, 0.02, 0.0, 1.0),
        LoopParameter("slew", "rad/s", np.inf, 1.0, 0.02),
        LoopParameter("dead", "rad", 0.0, 0.5, 0.0, 0.2, "angle"),
        LoopParameter("limit", "N·m", np.inf, 1.0, 1e-3, np.inf, "torque"),
        LoopParameter("coulomb", "N·m", 0.0, 0.2, 0.0, np.inf, "torque"),
        LoopParameter("viscous", "N·m·s/rad", 0.0, 0.2, 0.0, np.inf, "damping"),
        LoopParameter("back_emf", "N·m·s/rad", 0.0, 0.2, 0.0, np.inf, "damping"),
        LoopParameter("stribeck", "N·m", 0.0, 0.2, 0.0, np.inf, "torque"),
        LoopParameter("stribeck_velocity", "rad/s", 0.1, 0.1, 0.01, 1.0),
        LoopParameter("creep", "rad/s", 0.0, 0.02, 0.0, 0.5),
        # gears lose a tenth to two fifths of the torque that they carry (Harmonic Drive's efficiency charts)
        LoopParameter("load", "N·m/(N·m)", 0.0, 0.1, 0.0, 2.0, spread=2.0),
        LoopParameter("asymmetry", "1", 0.0, 0.1, -0.95, 0.95),
        LoopParameter("armature", "kg·m²", 0.0, 0.3, 0.0, np.inf, "inertia"),
        LoopParameter("spring", "N·m/rad", 0.0, 0.1, 0.0, np.inf, "torque"),
        LoopParameter("offset", "N·m", 0.0, 0.1, -np.inf, np.inf, "torque"),
        LoopParameter("gain", "1", 1.0, 0.05, 0.2, 3.0),
    )
}


WITH_TORQUE = ("ki", "kd", "coulomb", "viscous", "stribeck", "back_emf", "armature", "spring", "offset")
"""Parameters that go with the scale of all torques, as a gain does; the others are ratios, times or velocities."""


@dataclass(frozen=True)
class LoopEffect:
    """An effect of one joint: its parameters here, and how each is called in an answer."""

    id: str
    parameters: tuple[str, ...]
    reported: tuple[str, ...]
    needs: tuple[str, ...] = ()
    """Effects that have to be there before, fitted or in the model as it is."""
    controller: bool = False
    """Whether it belongs to the controller, which a model without actuators leaves open."""


EFFECTS = {
    e.id: e
    for e in (
        LoopEffect("controller.stiffness", ("kp",), ("kp",), controller=True),
        LoopEffect("controller.damping", ("kd",), ("kd",), controller=True),
        LoopEffect("controller.integral", ("ki",), ("ki",), controller=True),
        LoopEffect("controller.feed_forward", ("feed",), ("share",), controller=True),
        LoopEffect("controller.delay", ("delay",), ("time",), controller=True),
        LoopEffect("controller.lag", ("lag",), ("time",), controller=True),
        LoopEffect("controller.slew", ("slew",), ("limit",)),
        LoopEffect("controller.dead_zone", ("dead",), ("width",)),
        LoopEffect("actuator.saturation", ("limit",), ("limit",)),
        LoopEffect("actuator.gain", ("gain",), ("gain",)),
        LoopEffect("actuator.back_emf", ("back_emf",), ("damping",)),
        LoopEffect("actuator.rotor_inertia", ("armature",), ("inertia",)),
        LoopEffect("friction.coulomb", ("coulomb",), ("torque",)),
        LoopEffect("friction.viscous", ("viscous",), ("damping",)),
        LoopEffect(
            "friction.stribeck", ("stribeck", "stribeck_velocity"), ("breakaway", "velocity"), ("friction.coulomb",)
        ),
        LoopEffect("friction.creep", ("creep",), ("speed",), ("friction.coulomb",)),
        LoopEffect("friction.load", ("load",), ("coefficient",)),
        LoopEffect("friction.asymmetric", ("asymmetry",), ("ratio",), ("friction.coulomb",)),
        LoopEffect("transmission.spring", ("spring", "offset"), ("stiffness", "torque")),
    )
}


@dataclass(frozen=True, eq=False)
class Scales:
    """Natural sizes of each joint, (J,): torque [N·m], damping [N·m·s/rad], inertia [kg·m²], error [rad]."""

    torque: Array
    damping: Array
    inertia: Array
    angle: Array

    def of(self, name: str) -> Array:
        """Size at which a parameter is tried, (J,)."""
        parameter = PARAMETERS[name]
        one = np.ones_like(self.torque)
        return np.asarray(parameter.trial * (one if parameter.scale == "1" else getattr(self, parameter.scale)))


LOGARITHMIC = ("kp", "stribeck_velocity", "gain")
INVERSE = "limit", "slew"
"""Limits: their inverse is fitted, which is 0 where there is none."""
LEAST_INVERSE = 1e-3
"""Inverse of a limit, over that of its usual size, below which there is none."""


def to_coordinate(name: str, value: float, size: float) -> float:
    """A parameter's value in the coordinate in which it is fitted; `size` is that at which it is tried."""
    if name in LOGARITHMIC:
        return float(np.log(max(value, 1e-12)))
    return size / value if name in INVERSE else value / size


def from_coordinate(name: str, x: Array, size: Array) -> Array:
    """The value at a coordinate, within its bounds."""
    if name in LOGARITHMIC:
        value = np.exp(x)
    elif name in INVERSE:
        value = np.where(x > LEAST_INVERSE, size / np.maximum(x, LEAST_INVERSE), np.inf)
    else:
        value = x * size
    return np.clip(value, PARAMETERS[name].low, PARAMETERS[name].high)


def step_parameter(
    name: str, value: float, step: float, scales: Scales, joint: int, farthest: float = LONGEST_STEP
) -> float:
    """A parameter's value after a step in its own coordinate, within its bounds.

    `farthest` is the logarithm of the largest factor on a gain.
    """
    size = float(scales.of(name)[joint])
    if name in LOGARITHMIC:
        step = float(np.clip(step, -farthest, farthest))
    return float(from_coordinate(name, np.array(to_coordinate(name, value, size) + step), np.array(size)))


def relative_step(name: str, value: float, scales: Scales, joint: int) -> float:
    """Step in a parameter's own coordinate per relative change of its value."""
    return 1.0 if name in LOGARITHMIC else to_coordinate(name, value, float(scales.of(name)[joint]))
