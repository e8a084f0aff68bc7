"""The parameters of arm and sensors together, as families, as one vector, and by name."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array, frozen
from gcomp.errors import BadArray
from gcomp.identify.readings import StaticReadings

FAMILIES = ("gain", "offset", "position_gain", "position_offset", "beta", "rho")
"""In the order of the parameter vector (6n + 3,)."""
GAIN_STD, POSITION_GAIN_STD = 0.15, 0.02
"""Standard deviations of a torque gain and a position gain before any reading, as shares."""


def family_size(family: str, n: int) -> int:
    """Length of one family for an arm of n joints."""
    return {"beta": 2 * n, "rho": 3}.get(family, n)


def family_slices(n: int) -> dict[str, slice]:
    """Place of each family in the parameter vector (6n + 3,)."""
    slices, begin = {}, 0
    for family in FAMILIES:
        slices[family] = slice(begin, begin + family_size(family, n))
        begin += family_size(family, n)
    return slices


def parameter_names(arm: Arm) -> tuple[str, ...]:
    """Names of the parameter vector (6n + 3,), such as gain[joint_1], mass_moment_x[joint_2], load_point_z."""
    each = [f"{family}[{joint}]" for family in FAMILIES[:4] for joint in arm.names]
    moments = [f"mass_moment_{axis}[{joint}]" for joint in arm.names for axis in "xy"]
    return (*each, *moments, *(f"load_point_{axis}" for axis in "xyz"))


@dataclass(frozen=True, eq=False)
class Parameters:
    """One value per parameter: readings are v = gain · τ(β, q) + offset at q = position_gain · φ + position_offset."""

    gain: Array
    """Torque sensor gains k (n,)."""
    offset: Array
    """Torque sensor offsets o (n,) [N·m]."""
    position_gain: Array
    """Position sensor gains c (n,)."""
    position_offset: Array
    """Position sensor offsets θ0 (n,) [rad]."""
    beta: Array
    """Mass moments (2n,) [kg·m]."""
    rho: Array
    """Place of the reference mass in bar frame n (3,) [m]."""

    @classmethod
    def nominal(cls, n: int, **known: ArrayLike) -> "Parameters":
        """Gains 1 and all else 0, except for the families given; raises BadArray on an unknown family or shape."""
        values = {family: np.full(family_size(family, n), float("gain" in family)) for family in FAMILIES}
        for family, value in known.items():
            if family not in FAMILIES:
                raise BadArray(f"{family} is no parameter family; expected one of {', '.join(FAMILIES)}")
            values[family] = as_array(family, value, (family_size(family, n),))
        return cls(**values)

    @classmethod
    def from_vector(cls, vector: Array, n: int) -> "Parameters":
        """From the parameter vector (6n + 3,)."""
        return cls(**{family: vector[place] for family, place in family_slices(n).items()})

    @property
    def vector(self) -> Array:
        return np.concatenate([getattr(self, family) for family in FAMILIES])

    def __post_init__(self) -> None:
        frozen(self, **{family: np.asarray(getattr(self, family), dtype=np.float64) for family in FAMILIES})


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of one family: mean and standard deviation, infinite for no knowledge."""

    mean: ArrayLike
    std: ArrayLike


def free_mask(n: int, unknown: Collection[str]) -> Mask:
    """Entries of the parameter vector (6n + 3,) that are estimated.

    With β unknown, θ0_n stays fixed: turning link n's frame is the same as turning n_n and ρ (docs/theory.md, 4.1).
    """
    strangers = sorted(set(unknown) - set(FAMILIES))
    if strangers or not unknown:
        raise BadArray(f"unknown is {sorted(unknown)}, expected some of {', '.join(FAMILIES)}")
    slices, mask = family_slices(n), np.zeros(6 * n + 3, dtype=bool)
    for family in unknown:
        mask[slices[family]] = True
    if "beta" in unknown:
        mask[slices["position_offset"].stop - 1] = False
    return mask


def prior_vectors(n: int, priors: Mapping[str, Prior]) -> tuple[Array, Array]:
    """Mean and standard deviation of the whole parameter vector (6n + 3,); infinite without a prior."""
    mean, std = np.zeros(6 * n + 3), np.full(6 * n + 3, np.inf)
    slices = family_slices(n)
    for family, prior in priors.items():
        if family not in slices:
            raise BadArray(f"prior on {family}, which is no parameter family; expected one of {', '.join(FAMILIES)}")
        size = (family_size(family, n),)
        mean[slices[family]] = as_array(f"mean of the prior on {family}", np.broadcast_to(prior.mean, size), size)
        std[slices[family]] = np.broadcast_to(prior.std, size)
        if not np.all(std[slices[family]] > 0):
            raise BadArray(f"std of the prior on {family} is {np.min(prior.std)}, expected above zero")
    return mean, std


def natural_units(arm: Arm, readings: StaticReadings, start: Parameters) -> Array:
    """Natural units of the parameter vector (6n + 3,): the size of a change that matters (docs/theory.md, section 7.3).

    The gain of the start, 1 rad and 1 m; the RMS reading of the most loaded joint for offsets, that over g for mass
    moments.
    """
    with np.errstate(invalid="ignore"):
        per_joint = np.sqrt(np.nansum(readings.torque**2, axis=0) / np.maximum(readings.counted.sum(axis=0), 1))
    torque = float(per_joint.max()) or 1.0
    n, ones = arm.n, np.ones(arm.n)
    moment = torque / (float(np.linalg.norm(arm.gravity)) or 1.0)
    return Parameters(np.abs(start.gain), torque * ones, ones, ones, moment * np.ones(2 * n), np.ones(3)).vector
