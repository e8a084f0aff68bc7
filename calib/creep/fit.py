"""Torque constants, friction, zeros and gravity from creep sweeps without and with a reference mass."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from armlink.torque_calibration import GAIN_RANGE
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.creep.model import CreepModel
from calib.creep.parameters import HARMONICS, Doubt, family_slices, prior
from calib.creep.pushes import WIDE_SHARE, Disturbed, Spring, disturbed_sweeps, springs
from calib.creep.ripple import ripple_cycles
from calib.creep.rows import CreepRows
from calib.creep.scatter import Scatter, scatter
from calib.creep.solve import CreepSolution, solve
from calib.dataset import SweepData, digests
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask

SCATTER_ROUNDS = 4
"""Times that the scatter of the readings is estimated again."""
SEEN = 0.3
"""A parameter is found if the data leave so much of what was doubted beforehand, as a share of it."""
LOOSEST = 0.02
"""Largest standard deviation of a gain that is of use, as a share of it."""
QUANTILE = 1.96
LEAST_COULOMB = 1e-3
"""Least friction that scales its unevenness, as a share of rated torque."""
ASSUMED = 4.0
"""Harmonics for which the doubt of the friction's unevenness counts, beside those that were measured."""


@dataclass(frozen=True, eq=False)
class CreepFit:
    """Estimates with standard deviations. The gain is the drive's torque per true torque, g = 1/k."""

    arm: Arm
    rows: CreepRows
    solution: CreepSolution
    prior_std: Array
    scatter: Scatter
    """Of the readings."""
    ripple: Array
    """Periods in a turn of the ripple that each joint has, 0 for none (n,)."""
    disturbed: tuple[Disturbed, ...] = ()
    """Sweeps that were left out, and why."""
    springs: tuple[Spring, ...] = ()
    """Joints on which something pulls in every sweep; the other values then hold beside it."""
    sources: dict[str, str] = field(default_factory=dict)
    """Names and digests of the data sets."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.arm.names

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Place of each family in the vector."""
        return family_slices(self.arm.n)

    @cached_property
    def covariance(self) -> Array:
        """Of all parameters (P, P)."""
        return self.solution.covariance

    def value(self, family: str) -> Array:
        """Estimates of one family, whether found or not."""
        return self.solution.x[self.slices[family]]

    def std(self, family: str) -> Array:
        variance: Array = np.diag(self.covariance)[self.slices[family]]
        return np.sqrt(variance)

    def found(self, family: str) -> Mask:
        """Parameters of a family that the data determine; without a gain nothing tells the scale of mass moments."""
        if family == "gain" and not (self.rows.mass > 0).any():
            return np.zeros(len(self.value(family)), dtype=bool)
        if family == "beta" and not self.found("gain").any():
            return np.zeros(len(self.value(family)), dtype=bool)
        seen = self.std(family) < SEEN * self.prior_std[self.slices[family]]
        if family == "gain":
            low, high = GAIN_RANGE
            value = self.value(family)
            seen = seen & (self.std(family) < LOOSEST * np.abs(value)) & (low <= value) & (value <= high)
        return np.asarray(seen, dtype=bool)

    @property
    def findings(self) -> tuple[str, ...]:
        """Disturbances of the sweeps, one sentence each."""
        return tuple(str(each) for each in (*self.disturbed, *self.springs))

    @property
    def beta(self) -> Array:
        """Mass moments (2n,) [kg·m]; 0 for those not found."""
        return np.where(self.found("beta"), self.value("beta"), 0.0)

    @cached_property
    def residual_rms(self) -> Array:
        """(n,) [N·m], with the ripple, which records do not hold."""
        own = [self.solution.residual[self.rows.joint == joint] for joint in range(self.arm.n)]
        ripple = self.value("gain") * np.linalg.norm(self.value("ripple").reshape(-1, 2), axis=1) / np.sqrt(2)
        ripple = np.where(self.ripple > 0, ripple, 0.0)
        return np.hypot(ripple, [np.sqrt(np.mean(each**2)) if each.size else np.nan for each in own])

    def gravity(self, rows: NDArray[np.intp] | slice = slice(None)) -> Array:
        """Gravity torque that the fit has at its rows [N·m]."""
        return CreepModel(self.arm, self.rows, self.ripple).gravity(self.solution.x)[rows]


def fit_creep(arm_file: ArmFile, passes: Sequence[SweepData]) -> CreepFit:
    """Fit passes of creep sweeps, with and without a reference mass; raises BadInput where there is no such data."""
    rows = CreepRows.of(passes)
    if not len(rows):
        raise BadInput(f"{passes[0].path} holds no creep sweeps: sweep with `sweep.motion: creep`")
    doubt, sources = Doubt.of(sweep_section(arm_file)), digests(passes)
    return fit_rows(gcomp_arm(arm_file), rows, DriveLimits.of(arm_file).rated, doubt, sources)


def fit_rows(
    arm: Arm, rows: CreepRows, rated: Array, doubt: Doubt | None = None, sources: dict[str, str] | None = None
) -> CreepFit:
    """Fit rows; rated torque (n,) [N·m] scales what is doubted beforehand. Disturbed sweeps are left out by name."""
    doubt = doubt or Doubt()
    left_out: tuple[Disturbed, ...] = ()
    plain = _fit(arm, rows, rated, doubt, ripple=False)  # which a contact would be taken for
    for _ in range(len(rows.sweeps)):
        found = disturbed_sweeps(arm, plain.rows, plain.solution.residual, rated)
        if not found:
            break
        left_out = (*left_out, *found)
        rows = rows.kept(~np.isin(rows.sweep, [each.sweep for each in found]))
        plain = _fit(arm, rows, rated, doubt, ripple=False)
    plain = _fit(arm, rows, rated, doubt, plain.solution.x)
    plain = replace(plain, disturbed=left_out, sources=sources or {})
    loose = replace(doubt, spring_share=WIDE_SHARE)
    free = _fit(arm, rows, rated, loose, plain.solution.x, ripple=False)
    pulled = springs(CreepModel(arm, rows, free.ripple), free.solution, rated)
    if not pulled:
        return plain
    free = _fit(arm, rows, rated, loose, free.solution.x)
    return replace(free, disturbed=left_out, springs=pulled, sources=sources or {})


def _fit(
    arm: Arm, rows: CreepRows, rated: Array, doubt: Doubt, start: Array | None = None, ripple: bool = True
) -> CreepFit:
    model, slices = CreepModel(arm, rows), family_slices(arm.n)
    scattered = Scatter.even(rows, 0.01 * rated[rows.joint])
    coulomb, uneven = 0.02 * rated, np.full(HARMONICS, doubt.uneven)
    mean, std = prior(arm, rated, doubt, rows.by_temperature, coulomb, uneven)
    x = mean.copy() if start is None else start
    for _ in range(SCATTER_ROUNDS):
        found = solve(model, scattered, mean, std, x)
        x = found.x
        coulomb = np.maximum(np.abs(x[slices["coulomb"]]), LEAST_COULOMB * rated)
        uneven = _unevenness(found, std, coulomb, doubt)
        mean, std = prior(arm, rated, doubt, rows.by_temperature, coulomb, uneven)
        determined = float(np.sum(1 - np.diag(found.covariance) / std**2))  # by the data, and not the prior
        freedom = 1 - determined / len(rows)
        by_degree = _temperature_std(rows) * x[slices["warming"]][rows.joint] * rows.reading
        scattered = scatter(rows, found.residual, rated, freedom, by_degree, ripple)
        if ripple and not model.ripple.any():
            model = CreepModel(arm, rows, ripple_cycles(rows, found.residual, arm.n))
    return CreepFit(arm, rows, found, std, scattered, model.ripple)


def _unevenness(found: CreepSolution, std: Array, coulomb: Array, doubt: Doubt) -> Array:
    """Usual size of each harmonic of the friction over position (HARMONICS,), as a share of the Coulomb friction.

    That of all joints' harmonics of one order, which count by what the data tell of them, and of `ASSUMED` more of the
    size that is doubted beforehand.
    """
    place = family_slices(len(coulomb))["uneven"]
    shares = found.x[place].reshape(-1, HARMONICS, 2) / coulomb[:, None, None]
    told = (1 - np.diag(found.covariance)[place] / std[place] ** 2).clip(0.0).reshape(shares.shape)
    size = (ASSUMED * doubt.uneven**2 + (shares**2).sum(axis=(0, 2))) / (ASSUMED + told.sum(axis=(0, 2)))
    return np.asarray(np.sqrt(size))


def _temperature_std(rows: CreepRows) -> float:
    """Standard deviation that the rounding of the temperatures leaves [K]; 0 where none are told."""
    steps = np.diff(np.unique(rows.warmth.round(6))) if rows.by_temperature else np.empty(0)
    return float(steps.min(initial=1.0)) / np.sqrt(12) if steps.size else 0.0
