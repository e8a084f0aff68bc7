"""Changes to links and base that the whole arm shares: their parameters and ranges."""

import numpy as np

from sim_gap.model.rigid_body import RigidArm

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
