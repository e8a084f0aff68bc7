"""Is the reference mass there that the data set says? Judged before any gain is known, joint by joint."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.readings import StaticReadings

LEAST, MOST = 0.4, 2.5
"""A mass that is felt as this share of the stated one is another mass: no sensor gain is so far from 1."""
MOST_SHARE_STD = 0.15
"""A joint counts if it tells the share to this standard deviation."""


@dataclass(frozen=True)
class FeltMass:
    """The reference mass as the torque sensors feel it, if their gains are 1."""

    stated: float
    """[kg]."""
    felt: float
    """[kg]."""

    @property
    def contradicts(self) -> bool:
        """Whether this cannot be the stated mass, whatever the gains are."""
        return not LEAST <= self.felt / self.stated <= MOST

    def __str__(self) -> str:
        return (
            f"the loaded pass shows {self.felt:.1f} kg, but --reference-mass was {self.stated:g} kg: was the "
            "mass attached, and is the number right?"
        )


def felt_mass(arm: Arm, readings: StaticReadings) -> FeltMass | None:
    """The mass that is felt in readings with and without load; None if no joint tells it.

    Each joint is fitted alone: v = k (Y β + μ Y (E0 + Eρ ρ)) + o is linear in kβ, o, kμ and kμρ (docs/theory.md,
    section 4), and |kμ| over the stated mass is |k|, near 1, if the mass is there. Positions are taken as read.
    """
    stated = float(readings.load.max(initial=0.0))
    if stated <= 0 or (readings.load == stated).all():
        return None
    regressor = gravity_regressor(arm, readings.position)
    at_origin, by_point = payload_columns(arm)
    shares, spreads = [], []
    for joint in range(arm.n):
        counts = readings.counted[:, joint]
        rows, load = regressor[counts, joint, 2 * joint :], readings.load[counts, None] / stated
        loaded = np.hstack([load * (rows @ at_origin[2 * joint :, None]), load * (rows @ by_point[2 * joint :])])
        columns = np.hstack([loaded * stated, rows, np.ones((len(rows), 1))])
        found = _first(columns, readings.torque[counts, joint], readings.sigma[counts, joint])
        if found is not None and found[1] < MOST_SHARE_STD:
            shares.append(abs(found[0]))
            spreads.append(found[1])
    if not shares:
        return None
    return FeltMass(stated, stated * float(np.average(shares, weights=1 / np.square(spreads))))


def _first(columns: Array, values: Array, sigma: Array) -> tuple[float, float] | None:
    """The first coefficient of a weighted fit and its standard deviation; None if the fit does not determine it."""
    if len(values) <= columns.shape[1]:
        return None
    weighted = columns / sigma[:, None]
    _, singular, basis = np.linalg.svd(weighted, full_matrices=False)
    kept = singular > 1e-9 * singular[0]
    if np.linalg.norm(basis[~kept, 0]) > 1e-6:
        return None
    inverse = (basis[kept].T / singular[kept] ** 2) @ basis[kept]
    solution = inverse @ (weighted.T @ (values / sigma))
    scatter = np.sum(np.square(values / sigma - weighted @ solution)) / (len(values) - kept.sum())
    return float(solution[0]), float(np.sqrt(inverse[0, 0] * max(scatter, 1.0)))
