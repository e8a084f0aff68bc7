"""The cause test: which one effect explains a window's torque residual, if any does (theory.md section 6)."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_triangular

from calib.belief import ModelBelief
from calib.observer_config import ObserverConfig
from calib.records import Array
from gcomp.arm import Arm
from gcomp.gravity import gravity_levers, gravity_regressor, gravity_stiffness
from gcomp.moments import payload_columns

DRIFT = ("gain", "offset", "drift")


@dataclass(frozen=True)
class Window:
    """K rows: true-angle positions (K, n) [rad], torque readings as installed (K, n) [N·m], directions (K, n)."""

    position: Array
    torque: Array
    direction: Array


@dataclass(frozen=True)
class Entry:
    """One effect of the dictionary."""

    cause: str
    """gain, offset, drift (both), friction, spring, slip, payload, tilt or scale."""
    joint: int | None
    """Index of the joint, None where it concerns the arm."""
    columns: Array
    """What a unit of each parameter adds to the torque readings, (K·n, p)."""
    contains: tuple[str, ...] = ()
    """Causes of the same joint that are special cases of this one."""
    price: int | None = None
    """Parameters that it is charged for in the BIC; by default those that it has."""


@dataclass(frozen=True)
class Verdict:
    """What the window says. `values` and `covariance` are the parameters of the winning entry."""

    cause: str
    """none, unknown, ambiguous or the winning entry's cause."""
    joint: int | None
    confidence: float
    """Share of the winner among all classes, exp(−BIC/2) weighted; for unknown and ambiguous that of the best entry."""
    values: Array
    covariance: Array
    evidence: dict[str, float] = field(default_factory=dict)
    """BIC of the best entry of each class above the best one; `misfit` of the winner in standard deviations."""
    rivals: tuple[str, ...] = ()
    """Classes that fit as well, where ambiguous."""

    @property
    def is_drift(self) -> bool:
        """Whether it is a drift of one joint's torque sensor, the only verdict that may lead to a new record."""
        return self.cause in DRIFT


def dictionary(arm: Arm, beta: Array, window: Window) -> Iterator[Entry]:
    """Every entry of the dictionary for the poses of a window; beta (2n,) [kg·m] is the model believed."""
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
        yield Entry("gain", j, row_of(j, torque[:, j]))
        yield Entry("offset", j, row_of(j, one))
        yield Entry("drift", j, row_of(j, torque[:, j], one), contains=("gain", "offset"))
        yield Entry("friction", j, row_of(j, window.direction[:, j]))
        yield Entry("spring", j, row_of(j, q[:, j] - middle[j], one), contains=("offset",))
    stiffness = gravity_stiffness(arm, beta, q)
    for j in range(n):
        yield Entry("slip", j, stiffness[:, :, j].reshape(-1, 1))
    at_origin, by_point = payload_columns(arm)
    yield Entry("payload", None, (regressor @ np.column_stack([at_origin, by_point])).reshape(-1, 4))
    across = np.linalg.svd(arm.gravity[None])[2][1:] * np.linalg.norm(arm.gravity)
    tilted = [gravity_regressor(replace(arm, gravity=direction), q) @ beta for direction in across]
    yield Entry("tilt", None, np.stack(tilted, axis=-1).reshape(-1, 2))
    # a payload explains nine tenths of a common scale and is far more frequent: same price, so that it wins
    yield Entry("scale", None, torque.reshape(-1, 1), price=4)


@dataclass(frozen=True)
class _Fit:
    entry: Entry
    bic: float
    chi2: float
    values: Array
    covariance: Array


class CauseTest:
    """The dictionary fitted to one window, the model's error marginalised: covariance σ²I + Y Cov(β) Yᵀ + H Σ_q Hᵀ."""

    def __init__(self, belief: ModelBelief, window: Window, sigma: Array, config: ObserverConfig) -> None:
        """sigma (n,) [N·m]: standard deviation of one row."""
        self.belief, self.window, self._config = belief, window, config
        residual, nuisance = belief.residual(window.position, window.torque, config.position_std)
        noise = np.tile(sigma, len(window.position))
        covariance = nuisance @ nuisance.T
        covariance[np.diag_indices_from(covariance)] += noise**2
        self.entries = list(dictionary(belief.arm, belief.beta, window))
        stacked = np.column_stack([residual.ravel(), *(entry.columns for entry in self.entries)])
        white = solve_triangular(np.linalg.cholesky(covariance), stacked, lower=True)
        self._white: Array = white[:, 0]
        ends = np.cumsum([1, *(entry.columns.shape[1] for entry in self.entries)])
        self._columns: list[Array] = [white[:, start:end] for start, end in pairwise(ends)]
        self.chi2_none = float(self._white @ self._white)

    def verdict(self) -> Verdict:
        """Which class wins, and whether it is decided."""
        fits = sorted(map(self._fit, range(len(self.entries))), key=lambda fit: fit.bic)
        best, config = fits[0], self._config
        classes = {"none": self.chi2_none}
        for fit in reversed(fits):
            classes[_class(fit.entry)] = fit.bic
        top = min(classes.values())
        weights = {name: np.exp(-(bic - top) / 2) for name, bic in classes.items()}
        total = sum(weights.values())
        evidence = {name: round(float(bic - top), 1) for name, bic in sorted(classes.items(), key=lambda item: item[1])[:6]}

        def answer(cause: str, fit: _Fit | None, of: str, rivals: tuple[str, ...] = ()) -> Verdict:
            known = (fit.values, fit.covariance) if fit else (np.empty(0), np.empty((0, 0)))
            joint = fit.entry.joint if fit else None
            return Verdict(cause, joint, float(weights[of] / total), *known, evidence, rivals)

        if self.chi2_none - best.bic < config.evidence:
            misfit = self._misfit(self.chi2_none, 0)
            evidence["misfit"] = misfit
            return answer("unknown" if misfit > config.misfit else "none", None, "none")
        winner, name = best.entry, _class(best.entry)
        evidence["misfit"] = self._misfit(best.chi2, winner.columns.shape[1])
        if evidence["misfit"] > config.misfit or (winner.cause == "payload" and best.values[0] <= 0):
            return answer("unknown", None, name)
        near = [fit.entry for fit in fits[1:] if fit.bic - best.bic < config.evidence]
        rivals = tuple(dict.fromkeys(_class(entry) for entry in near if not _kin(entry, winner)))
        if rivals:
            return answer("ambiguous", best, name, rivals)
        return answer(winner.cause, best, name)

    def _fit(self, index: int) -> _Fit:
        """Generalised least squares of one entry; one whose columns these poses do not tell apart never wins."""
        entry, columns = self.entries[index], self._columns[index]
        count = columns.shape[1]
        nothing = _Fit(entry, np.inf, np.inf, np.full(count, np.nan), np.full((count, count), np.nan))
        size = np.linalg.norm(columns, axis=0)
        if (size < 1e-9).any():
            return nothing
        u, s, vt = np.linalg.svd(columns / size, full_matrices=False)
        if s[-1] < 1e-6 * s[0]:
            return nothing
        back = (vt.T / s) / size[:, None]
        explained = u.T @ self._white
        chi2 = self.chi2_none - float(explained @ explained)
        price = count if entry.price is None else entry.price
        return _Fit(entry, chi2 + price * np.log(len(self._white)), chi2, back @ explained, back @ back.T)

    def drift(self, joint: int, cause: str) -> tuple[Array, Array]:
        """Gain and offset change of a joint (2,), as `cause` (gain, offset or drift) has it, and covariance (2, 2)."""
        fit = self._fit(self._index(cause, joint))
        at = [index for index, name in enumerate(("gain", "offset")) if cause in (name, "drift")]
        values, covariance = np.zeros(2), np.zeros((2, 2))
        values[at] = fit.values
        covariance[np.ix_(at, at)] = fit.covariance
        return values, covariance

    def loss(self, joint: int, simple: str, full: str) -> float:
        """How much worse (BIC) the drift `simple` of a joint explains the window than `full` (gain, offset, drift)."""
        return self._fit(self._index(simple, joint)).bic - self._fit(self._index(full, joint)).bic

    def lever_share(self, joint: int) -> float:
        """Largest Γ_j/g that the window reached."""
        levers = gravity_levers(self.belief.arm, self.window.position)[:, joint]
        return float(levers.max() / np.linalg.norm(self.belief.arm.gravity))

    def _index(self, cause: str, joint: int) -> int:
        return [(entry.cause, entry.joint) for entry in self.entries].index((cause, joint))

    def _misfit(self, chi2: float, parameters: int) -> float:
        dof = len(self._white) - parameters
        return round(float((chi2 - dof) / np.sqrt(2 * dof)), 2)


def _class(entry: Entry) -> str:
    """What an entry counts as when verdicts compete: gain, offset and both of one joint are one class."""
    cause = "drift" if entry.cause in DRIFT else entry.cause
    return cause if entry.joint is None else f"{cause}_{entry.joint + 1}"


def _kin(entry: Entry, winner: Entry) -> bool:
    """Whether an entry is no rival: same class, or the winner is a special case of it."""
    return _class(entry) == _class(winner) or (entry.joint == winner.joint and winner.cause in entry.contains)
