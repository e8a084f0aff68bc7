"""Parameters of controller, joints and whole arm, the effect that each belongs to, and the coordinate of its fit."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array


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
    """A quantity of `Scales`, `stiffness` (of the servo, about) or `1`."""
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
        LoopParameter("coulomb", "N·m", 0.0, 0.2, 0.0, np.inf, "friction"),
        LoopParameter("viscous", "N·m·s/rad", 0.0, 0.2, 0.0, np.inf, "damping"),
        LoopParameter("back_emf", "N·m·s/rad", 0.0, 0.2, 0.0, np.inf, "damping"),
        LoopParameter("stribeck", "N·m", 0.0, 0.2, 0.0, np.inf, "friction"),
        LoopParameter("stribeck_velocity", "rad/s", 0.1, 0.1, 0.01, 1.0),
        LoopParameter("creep", "rad/s", 0.0, 0.02, 0.0, 0.5),
        # gears lose a tenth to two fifths of the torque that they carry (Harmonic Drive's efficiency charts)
        LoopParameter("load", "N·m/(N·m)", 0.0, 0.1, 0.0, 2.0, spread=2.0),
        LoopParameter("asymmetry", "1", 0.0, 0.1, -0.95, 0.95),
        LoopParameter("armature", "kg·m²", 0.0, 0.3, 0.0, np.inf, "inertia"),
        LoopParameter("spring", "N·m/rad", 0.0, 0.1, 0.0, np.inf, "stiffness"),
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
    """Natural sizes of each joint, (J,): torque, friction [N·m], damping [N·m·s/rad], inertia [kg·m²], error [rad]."""

    torque: Array
    friction: Array
    damping: Array
    inertia: Array
    angle: Array

    def of(self, name: str) -> Array:
        """Size at which a parameter is tried, (J,)."""
        parameter = PARAMETERS[name]
        # a spring is felt beside the servo, which makes its torque under its error
        own = {"1": np.ones_like(self.torque), "stiffness": self.torque / self.angle}
        return np.asarray(parameter.trial * (own | vars(self))[parameter.scale])


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


# ---- links and base

UNIT = {"mass": "kg", "x": "kg·m", "y": "kg·m", "z": "kg·m", "angle": "rad", "angle_1": "rad", "angle_2": "rad"}
REACH = 0.1
"""Length beyond the last joint [m]; a model does not tell how long the last link is."""
LIGHTEST = 0.5
"""Mass of an arm [kg] that is counted at least: models without masses are about."""
LARGEST_TURN = 0.35
"""Largest error of a zero or of the base's tilt [rad]."""


def shared_effects(arm: RigidArm) -> dict[str, tuple[str, ...]]:
    """Effects with one set of parameters for the whole arm → names of these."""
    effects = {"link.payload": tuple(f"payload.{part}" for part in ("mass", "x", "y", "z"))}
    for link, name in enumerate(arm.names):
        effects[f"link.mass_moment@{name}"] = tuple(f"moment{link}.{axis}" for axis in "xyz")
        effects[f"position.offset@{name}"] = (f"zero{link}.angle",)
    effects["base.tilt"] = ("tilt.angle_1", "tilt.angle_2")
    return effects


def range_of(arm: RigidArm, name: str) -> tuple[float, float]:
    """Lowest and highest value that an arm can have; wide, but on the arm's own scale.

    Without them a mass moment of some hundred times the arm's own can stand against a spring as stiff: both cancel
    along the recorded motion, and the simulation breaks loose along any other.
    """
    total = max(float(arm.inertial[:, 0].sum()), LIGHTEST)
    length = float(np.linalg.norm(arm.offset, axis=1).sum() + REACH)
    if UNIT[name.partition(".")[2]] == "rad":
        return -LARGEST_TURN, LARGEST_TURN
    if name == "payload.mass":
        return -float(arm.inertial[-1, 0]), total
    if name.startswith("moment"):  # as far as the link's own mass may be moved
        most = max(float(arm.inertial[int(name.split(".")[0][6:]), 0]), 0.1 * total) * length
        return -most, most
    return -total * length, total * length


def size_of(arm: RigidArm, name: str) -> float:
    """Size at which a parameter is tried."""
    low, high = range_of(arm, name)
    return 0.1 * min(-low, high) if -low > 1e-9 else 0.1 * high
