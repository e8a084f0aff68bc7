"""Laws outside the library: the smooth function of one quantity of a joint that takes what is left of a row.

For each row with structure left, smooth functions of position, velocity, load, temperature and time are fitted to the
training residual, as they are or with the sign of the velocity. The one that predicts parts left out best is judged on
held-out data. It is named "a law of velocity of joint 2" and never an effect: nobody knows what causes it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array, Mask
from gcomp.estimate.linear_terms import PRICE, SIGNIFICANT
from sim_gap.better_model.forward_effects import JointEffect
from sim_gap.residuals.disregarded_rows import regimes_left_out, slides
from sim_gap.residuals.layout import Row
from sim_gap.residuals.preprocess import PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square
from sim_gap.search.term_equations import CORRELATED, MOST_MEASUREMENTS

KNOTS = 8
"""Number of points between which a law is linear."""
NEAR_ZERO = (0.0, 0.004, 0.01, 0.03)
"""Points of a law of velocity around rest [rad/s], where friction changes most."""
LEAST = 0.3
"""Share of the squared residual above the noise that a law must take off the held-out data."""
STIFF = 1e-3
"""Weight of the second differences of a law, as a share of its columns' power."""
SMALLEST = 0.02
"""Least range of a quantity for a law of it, in its unit."""
FEWEST = 100
"""Number of samples from which a law is fitted."""
WARM_UPS = (6.0, 20.0, 60.0, 200.0)
"""Time constants of laws of time [s]."""


@dataclass(frozen=True, eq=False)
class ResidualLaw:
    """One law: torque over a quantity, and the RMS of its row on held-out data without and with it [N·m]."""

    quantity: str
    """`position`, `velocity`, `load`, `temperature` or `time`, in rad, rad/s, N·m, °C, s."""
    joint: int
    channel: str
    directed: bool
    """Whether the torque opposes the motion: then it is a function of the amount of velocity or load."""
    at: Array
    torque: Array
    band: Array
    """Points, torque there and half the width of its band, (m,) each."""
    before: float
    after: float

    @property
    def share(self) -> float:
        """Share of the row's squared residual that it takes."""
        return float(1.0 - (self.after / self.before) ** 2) if self.before > 0.0 else 0.0


@dataclass(frozen=True)
class _LawCandidate:
    quantity: str
    directed: bool
    at: Array
    warm_up: float = 0.0
    """Time constant of a law of time [s]; zero for any other law."""

    def basis(self, x: Array) -> Array:
        """Functions that are one at a point, zero at the others and linear between, constant beyond the ends, (K, m).

        Of a law of time, a constant and what fades: parts left out tell nothing of a function that is free there. Of
        temperature, a straight line for the same reason.
        """
        if self.quantity == "time":
            return np.stack([np.ones_like(x), np.exp(-x / self.warm_up)], axis=1)
        if self.quantity == "temperature":
            return np.stack([np.ones_like(x), x - self.at[0]], axis=1)
        return np.stack([np.interp(x, self.at, unit) for unit in np.eye(len(self.at))], axis=1)

    def columns(self, s: PreparedSignals, joint: int) -> Array:
        """The basis along a recording, filtered like the readings, (k, m)."""
        x = _values(s, self.quantity, joint)
        own = self.basis(np.abs(x) if self.directed and self.quantity in ("velocity", "load") else x)
        return s.filtered(own * s.direction[:, joint, None] if self.directed else own)


def residual_laws(
    fit: ResidualSet,
    judge: ResidualSet,
    left_fit: Mapping[Row, Array],
    left: Mapping[Row, Array],
    friction: Array,
) -> list[ResidualLaw]:
    """The laws of what is left of training and held-out data, (K,) per row each, the largest first.

    `friction` (n,) is the known dry friction [N·m]: in creep a motor may hold any torque up to that.
    """
    wide = _samples(fit), _samples(judge)
    found = []
    for row in fit.rows:
        sticks = float(friction[row[1]])
        for masks, any_torque in (((fit.valid[row], judge.valid[row]), 0.0), ((wide[0][row], wide[1][row]), sticks)):
            enough = min(mask.sum() for mask in masks) >= FEWEST
            if enough and root_mean_square(left[row][masks[1]]) > judge.margin[row] + any_torque:
                law = _best(fit, judge, row, (left_fit[row], left[row]), masks)
                found += [law] if law is not None else []
                break
    return sorted(found, key=lambda law: law.after - law.before)


def as_effects(laws: Sequence[ResidualLaw], names: Sequence[str]) -> list[JointEffect]:
    """The laws in the form of the module beside an exported model."""
    return [
        (
            f"law.{law.quantity}",
            names[law.joint],
            {"at": law.at.tolist(), "torque": law.torque.tolist(), "directed": law.directed},
        )
        for law in laws
    ]


def _samples(data: ResidualSet) -> dict[Row, Mask]:
    """Samples of the comparison and those in creep, for a row that is quiet but for creep, (K,) per row."""
    out = {row: valid.copy() for row, valid in data.valid.items()}
    for (row, regime), mask in regimes_left_out(data).items():
        if regime == "creep" and slides(data, row):
            out[row] |= mask
    return out


def _best(
    fit: ResidualSet, judge: ResidualSet, row: Row, left: tuple[Array, Array], masks: tuple[Mask, Mask]
) -> ResidualLaw | None:
    """The law that predicts left-out parts of the training residual best, if it holds on the held-out data."""
    (mask, judged), joint = masks, row[1]
    measurements = min(mask.sum() / CORRELATED, MOST_MEASUREMENTS)
    best, chosen = np.inf, None  # velocity is tried first, then position, load, temperature, time
    for law in _candidates(fit.signals, joint, row[0] == fit.layout.motor_side):
        x = np.concatenate([law.columns(s, joint) for s in fit.signals])
        missed = _cross_validated(x[mask], left[0][mask], fit.folds[mask])
        if missed < np.exp(-2.0 * PRICE / measurements) * best:
            best, chosen = missed, (law, x)
    if chosen is None:
        return None
    law, x = chosen
    c, covariance = _fitted(x[mask], left[0][mask], fit.blocks[mask])
    y = np.concatenate([law.columns(s, joint) for s in judge.signals]) @ c
    before, after = (root_mean_square(rest[judged]) for rest in (left[1], left[1] - y))
    above = before**2 - judge.floor[row] ** 2
    if before**2 - after**2 < LEAST * above or before - after < judge.relevant_nm:
        return None
    at = law.basis(law.at)
    band = SIGNIFICANT * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", at, covariance, at), 0.0))
    return ResidualLaw(law.quantity, joint, row[0], law.directed, law.at, at @ c, band, before, after)


def _candidates(signals: Sequence[PreparedSignals], joint: int, friction: bool) -> Iterator[_LawCandidate]:
    for quantity in ("velocity", "position", "load", "temperature", "time"):
        if quantity == "temperature" and any(s.temperature is None for s in signals):
            continue
        x = np.concatenate([_values(s, quantity, joint) for s in signals])
        if np.ptp(x) < SMALLEST:
            continue
        for directed in (False, True) if friction else (False,):
            amount = directed and quantity in ("velocity", "load")
            at = np.quantile(np.abs(x) if amount else x, np.linspace(0.0, 1.0, KNOTS))
            if amount and quantity == "velocity":
                at = np.concatenate([NEAR_ZERO, at[at > 2.0 * NEAR_ZERO[-1]]])
            at = at[np.r_[True, np.diff(at) > SMALLEST / KNOTS]]
            if len(at) > 2:
                yield from (
                    _LawCandidate(quantity, directed, at, tau) for tau in (WARM_UPS if quantity == "time" else (0.0,))
                )


def _values(s: PreparedSignals, quantity: str, joint: int) -> Array:
    if quantity == "time":
        return s.t
    if quantity == "temperature":
        assert s.temperature is not None
        return np.asarray(s.temperature[:, joint])
    return np.asarray({"velocity": s.v, "position": s.q, "load": s.model}[quantity][:, joint])


def _solve(x: Array, y: Array) -> Array:
    gram = x.T @ x
    bend = np.diff(np.eye(len(gram)), 2, axis=0) if len(gram) > 2 else np.zeros((1, len(gram)))
    gram = gram + STIFF * np.trace(gram) / len(gram) * (bend.T @ bend + 1e-3 * np.eye(len(gram)))
    return np.asarray(np.linalg.solve(gram, x.T @ y))


def _cross_validated(x: Array, y: Array, folds: NDArray[np.intp]) -> float:
    """Mean square that is left if each fold is predicted from the others."""
    missed = 0.0
    for fold in np.unique(folds):
        out = folds == fold
        if out.all():
            return float(np.mean((y - x @ _solve(x, y)) ** 2))
        missed += float(np.sum((y[out] - x[out] @ _solve(x[~out], y[~out])) ** 2))
    return missed / len(y)


def _fitted(x: Array, y: Array, blocks: NDArray[np.intp]) -> tuple[Array, Array]:
    """Coefficients of the columns (m,) and their covariance (m, m), from sums over blocks of time."""
    c = _solve(x, y)
    scores = np.zeros((int(blocks.max()) + 1, x.shape[1]))
    np.add.at(scores, blocks, x * (y - x @ c)[:, None])
    inverse = np.linalg.pinv(x.T @ x + STIFF * np.trace(x.T @ x) / x.shape[1] * np.eye(x.shape[1]))
    return c, np.asarray(inverse @ scores.T @ scores @ inverse)
