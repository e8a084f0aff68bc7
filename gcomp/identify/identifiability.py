"""Identifiability from a weighted Jacobian: covariance, parameters that are not identifiable, and why, in words."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array, Mask

NULL_RATIO = 1e-7
"""Share of the largest singular value below which one counts as zero. Structural zeros are below 1e-8, since angles are
written with eight digits; the smallest true ones seen are above 1e-4 (docs/theory.md, section 7.3)."""
NULL_STD = 1.0
"""A direction with a larger standard deviation, in natural units, is held: a linearisation over it means nothing."""
PARTICIPATION = 1e-4
"""Smallest share in a null direction with which a parameter counts as taking part in it."""


@dataclass(frozen=True, eq=False)
class Information:
    """Information of the readings on p parameters."""

    covariance: Array
    """Covariance (p, p); NaN rows and columns for parameters that take part in a null direction."""
    determined: Mask
    """Parameters that take part in no null direction (p,)."""
    null_basis: Array
    """Null directions (p, m) in natural units, made sparse by elimination."""
    rank: int
    """Rank of the Jacobian."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Singular value decomposition of a triangular factor in natural units, split into range and null space."""

    left: Array
    values: Array
    right: Array
    null: Array

    @classmethod
    def of(cls, triangle: Array, unit: Array) -> "Spectrum":
        """Of a factor R (p, p), or (m, p) of m < p readings, with RᵀR = JᵀJ; columns in units `unit` (p,)."""
        left, values, right = np.linalg.svd(triangle * unit)
        kept = int((values > max(1 / NULL_STD, NULL_RATIO * values[0])).sum())  # the values come in falling order
        return cls(left[:, :kept], values[:kept], right[:kept], right[kept:])


def analyse(triangle: Array, unit: Array) -> Information:
    """Covariance and identifiability from a factor R (p or fewer, p) with RᵀR = JᵀJ and natural units (p,)."""
    spectrum = Spectrum.of(triangle, unit)
    spread = (spectrum.right.T / spectrum.values) * unit[:, None]
    determined = np.linalg.norm(spectrum.null, axis=0) < PARTICIPATION
    covariance = spread @ spread.T
    covariance[~determined] = covariance[:, ~determined] = np.nan
    return Information(covariance, determined, _sparse_basis(spectrum.null).T, len(spectrum.values))


def _sparse_basis(null: Array) -> Array:
    """The same null space (m, p) in reduced echelon form, largest pivots first; small entries become zero."""
    basis = null.copy()
    for step in range(len(basis)):
        at = np.unravel_index(np.argmax(np.abs(basis[step:])), basis[step:].shape)
        pivot_row, pivot = step + int(at[0]), int(at[1])
        basis[[step, pivot_row]] = basis[[pivot_row, step]]
        basis[step] /= basis[step, pivot]
        others = np.arange(len(basis)) != step
        basis[others] -= np.outer(basis[others, pivot], basis[step])
    basis[np.abs(basis) < PARTICIPATION] = 0.0
    return basis


def describe_null_space(basis: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """One sentence per null direction (columns of `basis` (p, m)), with the parameters that change together."""
    sentences = []
    for direction in basis.T:
        taking_part = [name for name, share in zip(names, direction, strict=True) if share]
        moments = [name for name in taking_part if name.startswith("mass_moment")]
        gains = [name for name in taking_part if name.startswith("gain")]
        if len(taking_part) == 1:
            sentences.append(f"{taking_part[0]} changes no reading, since gravity does not act on it in these poses")
        elif len(gains) > 1 and moments and len(gains) + len(moments) == len(taking_part):
            sentences.append(
                f"{', '.join(gains)} can change by one common factor together with all mass moments: "
                "readings with a reference mass fix this factor"
            )
        else:
            sentences.append(f"{', '.join(taking_part)} can change together without changing any reading")
    return tuple(sentences)
