"""Force and moment at a frame from external torque, by least squares; and the smallest force felt."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array, Mask
from gcomp.external.contact import ONE_SIDED_95, ContactDetector
from gcomp.external.external_model import ExternalModel, Spread
from gcomp.external.rigid_motion import RigidMotion, jacobian

LEVER = 0.1
"""Moments compare with forces at this lever [m]: a hand's."""
WIDEST = 1e4
"""Standard deviation along a direction over that along the best one, from which the direction is not determined."""


@dataclass(frozen=True, eq=False)
class Wrench:
    """At a frame, base axes: force [N] and moment [N·m]."""

    value: Array
    """(S, 6); NaN along axes that the arm's joints do not show."""
    covariance: Array
    """(S, 6, 6), of what is determined."""
    determined: Mask
    """(S, 6)."""
    force: Array
    """(S, 3) [N], if there is no moment at the frame: then three joints are enough; NaN where it is not determined."""
    force_std: Array
    """(S, 3) [N]."""

    @property
    def std(self) -> Array:
        """Standard deviations of `value` (S, 6); NaN as there."""
        return np.where(self.determined, np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)), np.nan)


def wrench(motion: RigidMotion, link: int, point: Array, external: Array, std: Array, precision: Array) -> Wrench:
    """At a point of a link's bar frame, from external torques (S, n), their standard deviations and the inverse of
    their correlation."""
    scale = np.array([1.0] * 3 + [LEVER] * 3)
    full = jacobian(motion, link, point) / scale[:, None]
    inverse = precision / (std[:, :, None] * std[:, None, :])
    weighted = full @ inverse
    information, torque = weighted @ full.swapaxes(1, 2), weighted @ external[..., None]
    value, covariance, determined = _least_squares(information, torque)
    force, force_covariance, seen = _least_squares(information[:, :3, :3], torque[:, :3])
    force_std = np.sqrt(np.diagonal(force_covariance, axis1=1, axis2=2))
    return Wrench(
        np.where(determined, value / scale, np.nan), covariance / np.outer(scale, scale), determined,
        np.where(seen, force, np.nan), np.where(seen, force_std, np.nan),
    )  # fmt: skip


def _least_squares(information: Array, torque: Array) -> tuple[Array, Array, Mask]:
    """Values (S, k), covariance (S, k, k), and which axes have no share in directions that are not determined."""
    values, vectors = np.linalg.eigh(information)
    kept = values > values[:, -1:] / WIDEST**2
    inverted = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    covariance = (vectors * inverted[:, None]) @ vectors.swapaxes(1, 2)
    lost = ((vectors**2) * ~kept[:, None]).sum(-1)
    return (covariance @ torque)[..., 0], covariance, lost < 1e-3


def smallest_force(
    model: ExternalModel, limit: float, motion: RigidMotion, link: int, point: Array, std: Array, spread: Spread
) -> tuple[Array, Array]:
    """Force at a point that is found in 95 % [N], in the direction felt best and in the one felt worst, (S,) each."""
    pull = jacobian(motion, link, point)[:, :3]
    inverse = spread.precision / (std[:, :, None] * std[:, None, :])
    values = np.linalg.eigvalsh(pull @ inverse @ pull.swapaxes(1, 2))
    needed = np.sqrt(limit) + ONE_SIDED_95
    with np.errstate(divide="ignore"):
        best, worst = needed / np.sqrt(np.maximum(values[:, -1], 0.0)), needed / np.sqrt(np.maximum(values[:, 0], 0.0))
    return best, worst


def force_found(
    detector: ContactDetector, motion: RigidMotion, link: int, point: Array, direction: Array, std: Array
) -> Array:
    """Size of a force along a direction (3,) of the base that is found in 95 % [N], (S,)."""
    pull = np.einsum("skn,k->sn", jacobian(motion, link, point)[:, :3], direction)
    inverse = detector.model.sudden.precision / (std[:, :, None] * std[:, None, :])
    felt = np.sqrt(np.einsum("si,sij,sj->s", pull, inverse, pull))
    return np.asarray((np.sqrt(detector.sudden_limit) + ONE_SIDED_95) / np.maximum(felt, 1e-12))
