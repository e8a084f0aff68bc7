"""The dictionary of effects that the cause test fits, as columns of the torque readings (docs/theory.md, section 6)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

CAUSES = {
    "gain": ("torque.gain",),
    "offset": ("torque.offset",),
    "drift": ("torque.gain", "torque.offset"),
    "friction": ("friction.coulomb",),
    "spring": ("transmission.spring", "torque.offset"),
    "slip": ("position.offset",),
    "payload": ("link.payload",),
    "tilt": ("base.tilt",),
    "scale": ("torque.gain",),
}
"""Effects (`armlink.effect_catalogue`) that a cause consists of; a spring's rest angle acts as an offset."""
DRIFT = ("gain", "offset", "drift")


@dataclass(frozen=True)
class DictionaryEffect:
    cause: str
    """A key of CAUSES."""
    joint: int | None
    """Index of the joint; None if it concerns the whole arm."""
    columns: Array
    """Change of the torque readings per unit of each parameter, (K·n, p)."""
    price: int | None = None
    """Parameters charged in the BIC; by default the number of columns."""

    def contains(self, other: "DictionaryEffect") -> bool:
        """Whether the other is a special case of this one: fewer of its effects, at the same joint."""
        return self.joint == other.joint and set(CAUSES[other.cause]) < set(CAUSES[self.cause])


def dictionary(arm: Arm, beta: Array, window: StaticReadings) -> Iterator[DictionaryEffect]:
    """Every entry of the dictionary for the true angles of a window; beta (2n,) [kg·m] is the present gravity model."""
    q, n = window.position, arm.n
    regressor = gravity_regressor(arm, q)
    torque = regressor @ beta
    middle = np.where(np.isfinite(arm.lower + arm.upper), (arm.lower + arm.upper) / 2, 0.0)
    one = np.ones(len(q))

    def row_of(joint: int, *columns: Array) -> Array:
        full = np.zeros((len(q), n, len(columns)))
        full[:, joint] = np.stack(columns, axis=1)
        return full.reshape(len(q) * n, len(columns))

    for j in range(n):
        yield DictionaryEffect("gain", j, row_of(j, torque[:, j]))
        yield DictionaryEffect("offset", j, row_of(j, one))
        yield DictionaryEffect("drift", j, row_of(j, torque[:, j], one))
        yield DictionaryEffect("friction", j, row_of(j, window.direction[:, j]))
        yield DictionaryEffect("spring", j, row_of(j, q[:, j] - middle[j], one))
    stiffness = gravity_stiffness(arm, beta, q)
    for j in range(n):
        yield DictionaryEffect("slip", j, stiffness[:, :, j].reshape(-1, 1))
    at_origin, by_point = payload_columns(arm)
    yield DictionaryEffect("payload", None, (regressor @ np.column_stack([at_origin, by_point])).reshape(-1, 4))
    across = np.linalg.svd(arm.gravity[None])[2][1:] * np.linalg.norm(arm.gravity)
    tilted = [gravity_regressor(replace(arm, gravity=direction), q) @ beta for direction in across]
    yield DictionaryEffect("tilt", None, np.stack(tilted, axis=-1).reshape(-1, 2))
    # a payload explains nine tenths of a common scale and is far more frequent: at the same price it wins
    yield DictionaryEffect("scale", None, torque.reshape(-1, 1), price=4)


def class_of(entry: DictionaryEffect) -> str:
    """Class of an entry in the comparison of verdicts: gain, offset and both of one joint are one class."""
    cause = "drift" if entry.cause in DRIFT else entry.cause
    return cause if entry.joint is None else f"{cause}_{entry.joint + 1}"


def kin(entry: DictionaryEffect, winner: DictionaryEffect) -> bool:
    """Whether an entry is not a rival: it is of the same class, or the winner is a special case of it."""
    return class_of(entry) == class_of(winner) or entry.contains(winner)
