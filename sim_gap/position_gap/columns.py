"""Torque of changes to links and base along the recorded motion, as columns of the simulation."""

from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.base import axes_across
from sim_gap.model.rigid_body import RigidArm
from sim_gap.position_gap.tracks import MODEL_HZ
from sim_gap.position_gap.windows import Windows

UNIT = {"mass": "kg", "x": "kg·m", "y": "kg·m", "z": "kg·m", "angle": "rad", "angle_1": "rad", "angle_2": "rad"}
PAYLOAD_INERTIA = tuple(f"payload.{entry}" for entry in ("xx", "xy", "xz", "yy", "yz", "zz"))
"""Columns of a payload's moments of inertia, which follow from its mass and its centre."""
REACH = 0.1
"""Length beyond the last joint [m]; a model does not tell how long the last link is."""
LIGHTEST = 0.5
"""Mass of an arm [kg] that is counted at least: models without masses are about."""
LARGEST_TURN = 0.35
"""Largest error of a zero or of the base's tilt [rad]: torques are linear in it no further."""


def shared_effects(arm: RigidArm) -> dict[str, tuple[str, ...]]:
    """Effects with one set of coefficients for the whole arm → names of their columns."""
    effects = {"link.payload": tuple(f"payload.{part}" for part in ("mass", "x", "y", "z"))}
    for link, name in enumerate(arm.names):
        effects[f"link.mass_moment@{name}"] = tuple(f"moment{link}.{axis}" for axis in "xyz")
        effects[f"position.offset@{name}"] = (f"zero{link}.angle",)
    effects["base.tilt"] = ("tilt.angle_1", "tilt.angle_2")
    return effects


def payload_inertia(mass: Array, moment: tuple[Array, Array, Array], arm: RigidArm) -> dict[str, Array]:
    """Column → moment of inertia about the last joint [kg·m²] of a payload in one point, from mass [kg] and mass
    moments [kg·m]; it is no further away than the arm is long.
    """
    x, y, z = moment
    least = np.sqrt(x**2 + y**2 + z**2) / _length(arm)
    divisor = np.copysign(np.maximum(np.maximum(np.abs(mass), least), 1e-9), mass)
    products = (y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y)
    return {name: product / divisor for name, product in zip(PAYLOAD_INERTIA, products, strict=True)}


def with_columns(data: Windows) -> Windows:
    """The windows with the columns of all `shared_effects` and of a payload's inertia, as far as they move a joint."""
    arm, (steps, n, count) = data.arm, data.command.shape
    few = np.unique(np.append(np.arange(0, steps, max(1, round(1.0 / (MODEL_HZ * data.dt)))), steps - 1))
    q, v, a = (x[few].transpose(0, 2, 1).reshape(-1, n) for x in (data.q, data.v, data.a))
    regressor = arm.regressor(q, v, a)
    made: dict[str, Array] = {
        name: regressor[:, :, n - 1, k]
        for k, name in enumerate((*(f"payload.{part}" for part in ("mass", "x", "y", "z")), *PAYLOAD_INERTIA))
    }
    for link in range(n):
        made |= {f"moment{link}.{axis}": regressor[:, :, link, 1 + k] for k, axis in enumerate("xyz")}
        made[f"zero{link}.angle"] = _of_an_angle(arm, q, v, a, link)
    still = np.zeros_like(q)
    for k, axis in enumerate(axes_across(arm.gravity)):
        made[f"tilt.angle_{k + 1}"] = arm.torque(q, still, still, np.cross(arm.gravity, axis))
    columns = {}
    for name, rows in made.items():
        if np.abs(rows).max() > 1e-9:
            spread = rows.reshape(len(few), count, n).transpose(0, 2, 1)
            columns[name] = _filled(spread, few, steps)
    ranges = {name: _range(arm, name) for name in columns if name not in PAYLOAD_INERTIA}
    return replace(data, columns=columns, ranges=ranges)


def _range(arm: RigidArm, name: str) -> tuple[float, float]:
    """Lowest and highest coefficient of a column that an arm can have; wide, but on the arm's own scale.

    Without them a mass moment of some hundred times the arm's own can stand against a spring as stiff: both cancel
    along the recorded motion, and the simulation breaks loose along any other.
    """
    total, length = max(arm.inertial[:, 0].sum(), LIGHTEST), _length(arm)
    if UNIT[name.partition(".")[2]] == "rad":
        return -LARGEST_TURN, LARGEST_TURN
    if name == "payload.mass":
        return -float(arm.inertial[-1, 0]), float(total)
    return -float(total * length), float(total * length)


def _length(arm: RigidArm) -> float:
    """Longest distance of anything from the first joint [m]."""
    return float(np.linalg.norm(arm.offset, axis=1).sum() + REACH)


def _of_an_angle(arm: RigidArm, q: Array, v: Array, a: Array, joint: int) -> Array:
    """Derivative of all joints' torques with respect to one joint's angle, (k, n): those beyond it feel it too."""
    step = np.zeros(arm.n)
    step[joint] = 1e-4
    return np.asarray((arm.torque(q + step, v, a) - arm.torque(q - step, v, a)) / 2e-4)


def _filled(values: Array, few: Array, steps: int) -> Array:
    """Values (k, J, W) at the steps `few`, linear between, (T, J, W)."""
    place = np.arange(steps)
    after = np.clip(np.searchsorted(few, place), 1, len(few) - 1)
    share = ((place - few[after - 1]) / (few[after] - few[after - 1]))[:, None, None]
    return np.asarray(values[after - 1] * (1.0 - share) + values[after] * share)
