"""Unknowns of the creep fit: their order in one vector, and what is known of them beforehand."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from calib.arm.sweep_section import SweepSection
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.identify.parameters import Prior

HARMONICS = 2
"""Friction over position: cosine and sine of so many multiples of the joint angle."""
LAST_ZERO = 1e-6
"""The last joint's zero is kept at 0 [rad]: turning the last link's frame is the same as turning its mass moment and
the place of the mass (docs/theory.md, 4.1). A measured place resolves it."""
FAMILIES = (
    "gain", "offset", "coulomb", "load", "viscous", "asymmetry", "warming", "zero", "lag", "spring", "uneven",
    "ripple", "beta", "rho",
)  # fmt: skip
"""In the order of the vector."""


def family_slices(n: int) -> dict[str, slice]:
    """Place of each family in the vector of an arm of n joints."""
    sizes = {"lag": 1, "uneven": 2 * HARMONICS * n, "ripple": 2 * n, "beta": 2 * n, "rho": 3}
    slices, begin = {}, 0
    for family in FAMILIES:
        slices[family] = slice(begin, begin + sizes.get(family, n))
        begin = slices[family].stop
    return slices


@dataclass(frozen=True)
class Doubt:
    """Standard deviations beforehand, one for all joints; each a choice that real arms stay well within."""

    gain: float = 0.5
    """About 1: makers' torque constants were found wrong by up to 1.5."""
    offset_share: float = 0.1
    """Of rated torque."""
    coulomb_share: float = 0.15
    """Of rated torque."""
    load: float = 0.07
    """Friction per torque: a planetary gear of 0.9 efficiency has 0.1."""
    viscous_share: float = 0.02
    """Of rated torque, per rad/s, about `viscous_mean`."""
    viscous_mean: float = 0.015
    """Of rated torque, per rad/s: 0.1 to 0.5 N·m·s/rad were measured on drives of 3 to 20 N·m."""
    asymmetry: float = 0.07
    """Friction of the two directions, half difference over mean."""
    warming: float = 0.001
    """Per kelvin, about `warming_mean`."""
    warming_mean: float = 0.001
    """Magnets lose a tenth of a per cent per kelvin: the drive then takes the same current for more torque than it
    makes."""
    warming_by_time: float = 0.02
    """Over all passes, where no temperature is known."""
    zero: float = 0.03
    """Position zero that was set by hand [rad]."""
    lag: float = 0.005
    """How much later than the position the torque is read, one for all joints: drives filter it, or average it [s]."""
    uneven: float = 0.15
    """Friction over position, as a share of the joint's Coulomb friction."""
    ripple: float = 0.3
    """Ripple of torque over position, as a share of the joint's Coulomb friction."""
    rho: float = 0.3
    """Place of the mass [m]."""
    spring_share: float = 1e-5
    """Pull that grows with position, of rated torque per rad: none, unless it is looked for."""
    point: Prior | None = None
    """Place of the mass, where it was measured [m]; the last joint's zero is then seen by it."""

    @classmethod
    def of(cls, section: SweepSection) -> Self:
        return cls(zero=section.creep.zero_std, point=section.known_point)


def prior(
    arm: Arm, rated: Array, doubt: Doubt, by_temperature: bool, coulomb: Array, uneven: Array | None = None
) -> tuple[Array, Array]:
    """(Mean, standard deviation) of the vector.

    `coulomb` (n,) scales the friction over position [N·m], of which `uneven` (HARMONICS,) are the harmonics' shares.
    """
    n, slices = arm.n, family_slices(arm.n)
    mean, std = np.zeros(slices["rho"].stop), np.empty(slices["rho"].stop)
    mean[slices["gain"]] = 1.0
    mean[slices["viscous"]] = doubt.viscous_mean * rated
    if by_temperature:
        mean[slices["warming"]] = doubt.warming_mean
    gravity = float(np.linalg.norm(arm.gravity))
    shares = np.full(HARMONICS, doubt.uneven) if uneven is None else uneven
    values = {
        "gain": doubt.gain,
        "offset": doubt.offset_share * rated,
        "coulomb": doubt.coulomb_share * rated,
        "load": doubt.load,
        "viscous": doubt.viscous_share * rated,
        "asymmetry": doubt.asymmetry,
        "warming": doubt.warming if by_temperature else doubt.warming_by_time,
        "zero": doubt.zero,
        "lag": doubt.lag,
        "spring": doubt.spring_share * rated,
        "uneven": np.outer(np.maximum(coulomb, 1e-3 * rated), np.repeat(shares, 2)).ravel(),
        "ripple": np.repeat(doubt.ripple * np.maximum(coulomb, 1e-3 * rated), 2),
        "beta": np.repeat(3.0 * float(rated.max()) / gravity, 2 * n),
        "rho": doubt.rho,
    }
    for family, value in values.items():
        std[slices[family]] = value
    if doubt.point is None:
        std[slices["zero"].stop - 1] = LAST_ZERO
    else:
        mean[slices["rho"]], std[slices["rho"]] = doubt.point.mean, doubt.point.std
    return mean, std
