"""The cause test: which single effect explains a window's torque residual, if any (docs/theory.md, section 6)."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, pairwise, product

import numpy as np

from calib.observer.config import ObserverConfig
from calib.observer.effect_dictionary import DRIFT, DictionaryEffect, class_of, dictionary, kin
from calib.observer.gravity_belief import GravityBelief
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.readings import StaticReadings

OF_AN_ARM = ("friction", "spring", "slip", "tilt", "scale")
"""Causes that a discrepancy consists of: as small as its level they are not told."""
INEXACT = 0.02
"""Most that an effect's own shape may be off, as a share: it is as inexact as the gravity model's torque."""
LEVEL_ROWS = 10
"""Rows that what was expected of the discrepancy's level counts for beside those it was fitted to."""
MOST_GAIN_LIMIT = 1.0
"""A gain whose limit is above this is not observed: gravity hardly loads the joint."""


@dataclass(frozen=True)
class Verdict:
    """Result of one test. `values` and `covariance` are the parameters of the winning entry."""

    cause: str
    """none, unknown, ambiguous, temperature (several zeros at once) or the winning entry's cause."""
    joint: int | None
    """Index of the joint, None if it concerns the whole arm."""
    confidence: float
    """Weight exp(−BIC/2) of the winner among all classes; for unknown and ambiguous that of the best entry."""
    values: Array
    covariance: Array
    evidence: dict[str, float] = field(default_factory=dict)
    """BIC of the best entry of each class above the best one; `misfit` of the winner in standard deviations."""
    rivals: tuple[str, ...] = ()
    """Classes that fit as well, if ambiguous."""
    beside: int | None = None
    """Another joint whose sensor drifts at the same time."""

    @property
    def is_drift(self) -> bool:
        """Whether it is a drift of torque sensors, the only verdict that may lead to a new record."""
        return self.cause in DRIFT

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints concerned, the one with more evidence first."""
        return tuple(joint for joint in (self.joint, self.beside) if joint is not None)

    def other(self, joint: int) -> int | None:
        """The joint that drifts beside this one, if any."""
        return next((other for other in self.joints if other != joint), None)


@dataclass(frozen=True)
class _CauseFit:
    entry: DictionaryEffect
    bic: float
    chi2: float
    values: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Solved:
    """A least-squares fit of whitened columns."""

    values: Array
    """Parameters (p,)."""
    covariance: Array
    """(p, p); 0 for parameters that the rows do not show."""
    chi2: float
    """Of what the columns leave."""
    shown: int
    """Number of independent parameters that the rows show."""


def solve_whitened(columns: Array, target: Array) -> Solved:
    """The fit of whitened columns (K, p) to a whitened target (K,)."""
    u, s, vt, size = _decomposed(columns)
    kept = s > 0
    back = (vt[kept].T / s[kept]) / size[:, None]
    explained = u[:, kept].T @ target
    covariance = back @ back.T
    hidden = (np.abs(vt[~kept]) > 1e-3).any(axis=0)
    covariance[hidden] = covariance[:, hidden] = 0.0
    chi2 = float(target @ target) - float(explained @ explained)
    return Solved(back @ explained, covariance, chi2, int(kept.sum()))


def span(columns: Array) -> Array:
    """An orthonormal basis (K, r) of whitened columns (K, p), of which r are independent."""
    u, s, _, _ = _decomposed(columns)
    return u[:, s > 0]


def _decomposed(columns: Array) -> tuple[Array, Array, Array, Array]:
    """u, s, vt of columns (K, p) in units of their lengths, and these; s is 0 where columns depend on others."""
    size = np.linalg.norm(columns, axis=0)
    size[size <= 1e-9] = 1.0
    u, s, vt = np.linalg.svd(columns / size, full_matrices=False)
    return u, np.where(s > max(1e-6 * s[0], 1e-12), s, 0.0), vt, size


def smallest_noticed_change(own: Array, rivals: Iterable[tuple[Array, int]], evidence: float) -> float:
    """Size of a change with whitened column (K,) that wins in one case of two: over "none", and over every rival.

    Of each rival an orthonormal basis (K, p) and the parameters charged in its BIC.
    """
    size, once = float(own @ own), float(np.log(len(own)))
    needed = evidence + once
    for basis, price in rivals if size > 0 else ():
        alike = float(((basis.T @ own) ** 2).sum()) / size
        needed = max(needed, (evidence - (price - 1) * once) / max(1 - alike, 1e-9))
    return float(np.sqrt(needed / max(size, 1e-30)))


class CauseTest:
    """The dictionary fitted to one window, with model error marginalised: the belief's covariance and σ²I."""

    def __init__(
        self,
        belief: GravityBelief,
        window: StaticReadings,
        config: ObserverConfig,
        temperature: Array | None = None,
    ) -> None:
        """Of K rows with true angles, torques as installed, their standard deviations, temperatures (K, n) if told."""
        self.belief, self.window, self._config = belief, window, config
        expected = belief.expected(window.position, window.direction, temperature)
        residual = window.torque - expected.torque - expected.mean
        covariance = expected.covariance.copy()
        covariance[np.diag_indices_from(covariance)] += window.sigma.ravel() ** 2
        noise = (window.sigma**2).mean(axis=0)
        self._of_model: list[float] = (1 - noise / (noise + expected.variance.mean(axis=0))).tolist()
        self.entries = list(dictionary(belief.arm, belief.beta, window))
        stacked = np.column_stack([residual.ravel(), *(entry.columns for entry in self.entries)])
        white: Array = np.linalg.solve(np.linalg.cholesky(covariance), stacked)  # scipy takes longer to load
        self._white: Array = white[:, 0]
        ends = np.cumsum([1, *(entry.columns.shape[1] for entry in self.entries)])
        self._columns: list[Array] = [white[:, start:end] for start, end in pairwise(ends)]
        self.chi2_none = float(self._white @ self._white)
        discrepancy = float(np.median(belief.level.total / belief.kernel.typical)) if belief.level.total.any() else 0.0
        self._inexact = min(discrepancy, INEXACT)

    def verdict(self) -> Verdict:
        """The winning class, or why none wins."""
        fits = sorted(map(self._fit, range(len(self.entries))), key=lambda fit: fit.bic)
        best, config = fits[0], self._config
        classes = {"none": self.chi2_none}
        for fit in reversed(fits):
            classes[class_of(fit.entry)] = fit.bic
        top = min(classes.values())
        weights = {name: np.exp(-(bic - top) / 2) for name, bic in classes.items()}
        total = sum(weights.values())
        evidence = {
            name: round(float(bic - top), 1) for name, bic in sorted(classes.items(), key=lambda item: item[1])[:6]
        }

        def answer(cause: str, fit: _CauseFit | None, of: str, rivals: tuple[str, ...] = ()) -> Verdict:
            known = (fit.values, fit.covariance) if fit else (np.empty(0), np.empty((0, 0)))
            joint = fit.entry.joint if fit else None
            return Verdict(cause, joint, float(weights[of] / total), *known, evidence, rivals)

        if self.chi2_none - best.bic < config.evidence:
            misfit = self._misfit(self.chi2_none, 0)
            evidence["misfit"] = misfit
            return answer("unknown" if misfit > config.misfit else "none", None, "none")
        winner, name = best.entry, class_of(best.entry)
        inexact = self._inexact**2 * (self.chi2_none - best.chi2)
        evidence["misfit"] = self._misfit(best.chi2 - inexact, winner.columns.shape[1])
        if evidence["misfit"] > config.misfit or (winner.cause == "payload" and not self._weighs(best)):
            return self._two_drifts() or self._all_zeros() or answer("unknown", None, name)
        near = [fit.entry for fit in fits[1:] if fit.bic - best.bic < config.evidence]
        rivals = tuple(dict.fromkeys(class_of(entry) for entry in near if not kin(entry, winner)))
        sensor_or_load = any(entry.cause in (*DRIFT, "payload") for entry in near)
        if winner.cause in OF_AN_ARM and not sensor_or_load and self._is_small(best):
            return answer("none", None, "none")
        if rivals:
            return answer("ambiguous", best, name, rivals)
        return answer(winner.cause, best, name)

    def _is_small(self, fit: _CauseFit) -> bool:
        """Whether an effect is no larger than the arm's discrepancy anyway: twice its level at each joint."""
        size = (fit.entry.columns @ fit.values).reshape(-1, self.belief.arm.n)
        return bool((np.sqrt((size**2).mean(axis=0)) <= 2 * self.belief.level.total).all())

    def _fit(self, *indices: int) -> _CauseFit:
        """Generalised least squares of entries together; columns that are collinear at these poses never win.

        But for a payload: of an arm with parallel axes no lever may show its mass, or where it is along them. These
        parameters come with variance 0.
        """
        columns = np.hstack([self._columns[index] for index in indices])
        entries = [self.entries[index] for index in indices]
        count = columns.shape[1]
        nothing = _CauseFit(entries[0], np.inf, np.inf, np.full(count, np.nan), np.full((count, count), np.nan))
        found = solve_whitened(columns, self._white)
        hidden_by_arm = [entry.cause for entry in entries] == [
            "payload"
        ] and found.shown == self.belief.kernel.payload_rank
        if not found.shown or not (found.shown == count or hidden_by_arm):
            return nothing
        price = sum(entry.columns.shape[1] if entry.price is None else entry.price for entry in entries)
        price -= count - found.shown
        bic = found.chi2 + price * np.log(len(self._white))
        return _CauseFit(entries[0], bic, found.chi2, found.values, found.covariance)

    def _two_drifts(self) -> Verdict | None:
        """Two joints that drift at once, if that alone explains the window; else None.

        Competes with the drift of one joint together with an effect on the whole arm, such as a payload picked up.
        """
        whole = [index for index, entry in enumerate(self.entries) if entry.joint is None]
        drifts = [index for index, entry in enumerate(self.entries) if entry.cause == "drift"]
        drifts.sort(key=lambda index: self._fit(index).chi2)
        pairs = [*combinations(drifts, 2), *product(drifts, whole)]
        fits = {pair: self._fit(*pair) for pair in pairs}
        best = min(fits, key=lambda pair: fits[pair].bic)
        fit = fits[best]
        if not np.isfinite(fit.bic) or self._misfit(fit.chi2, 4) > self._config.misfit or best[1] in whole:
            return None
        above = np.array([other.bic - fit.bic for pair, other in fits.items() if pair != best])
        if above.min() < self._config.evidence:
            return None
        confidence = float(1 / (1 + np.exp(-above / 2).sum()))
        evidence = {"next": round(float(above.min()), 1), "misfit": self._misfit(fit.chi2, 4)}
        first, second = (self.entries[index].joint for index in best)
        return Verdict("drift", first, confidence, fit.values, fit.covariance, evidence, beside=second)

    def _weighs(self, payload: _CauseFit) -> bool:
        """Whether a payload's mass is possible: positive, or no more taken off than the model carries as a tool; or no
        lever shows it."""
        return bool(payload.values[0] > min(0.0, -1.2 * self.belief.mass)) or payload.covariance[0, 0] == 0

    def _all_zeros(self) -> Verdict | None:
        """The zeros of several sensors moved together, as temperature moves them, if that alone explains the window."""
        zeros = [self._index("offset", joint) for joint in range(self.belief.arm.n)]
        fit = self._fit(*zeros)
        misfit = self._misfit(fit.chi2, len(zeros))
        if not np.isfinite(fit.bic) or misfit > self._config.misfit:
            return None
        return Verdict("temperature", None, 1.0, fit.values, fit.covariance, {"misfit": misfit})

    def drift(self, joint: int, cause: str, beside: int | None = None) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) under `cause` (gain, offset or drift), and covariance (2, 2).

        If the joint `beside` drifts too, both are fitted together.
        """
        also = [] if beside is None else [self._index("drift", beside)]
        fit = self._fit(self._index(cause, joint), *also)
        at = [index for index, name in enumerate(("gain", "offset")) if cause in (name, "drift")]
        values, covariance = np.zeros(2), np.zeros((2, 2))
        values[at] = fit.values[: len(at)]
        covariance[np.ix_(at, at)] = fit.covariance[: len(at), : len(at)]
        return values, covariance

    def noticed(self, cause: str, joint: int) -> float:
        """Size of a gain's or offset's change that wins in one case of two: over "none", and over every rival."""
        index = self._index(cause, joint)
        winner, own = self.entries[index], self._columns[index][:, 0]
        rivals = (
            (basis, entry.columns.shape[1] if entry.price is None else entry.price)
            for entry, basis in zip(self.entries, self._bases, strict=True)
            if basis.size and not kin(entry, winner)
        )
        return smallest_noticed_change(own, rivals, self._config.evidence)

    @cached_property
    def _bases(self) -> list[Array]:
        """An orthonormal basis of each entry's columns."""
        return [span(columns) for columns in self._columns]

    def of_model(self, joint: int) -> float:
        """Share of the model's own error in the variance of a joint's residuals."""
        return self._of_model[joint]

    def loss(self, joint: int, simple: str, full: str, beside: int | None = None) -> float:
        """BIC of a joint's drift `simple` above that of `full` (each gain, offset or drift)."""
        also = [] if beside is None else [self._index("drift", beside)]
        return self._fit(self._index(simple, joint), *also).bic - self._fit(self._index(full, joint), *also).bic

    def lever_share(self, joint: int) -> float:
        """Largest Γ_j/g in the window: gravity's lever on the joint as a share of g."""
        levers = gravity_levers(self.belief.arm, self.window.position)[:, joint]
        return float(levers.max() / np.linalg.norm(self.belief.arm.gravity))

    def _index(self, cause: str, joint: int) -> int:
        return [(entry.cause, entry.joint) for entry in self.entries].index((cause, joint))

    def _misfit(self, chi2: float, parameters: int) -> float:
        """χ² above its degrees of freedom in standard deviations, those of the level's own uncertainty included."""
        dof, level = len(self._white) - parameters, self.belief.level
        known = np.inf if not level.total.any() else level.rows + LEVEL_ROWS
        return round(float((chi2 - dof) / np.sqrt(2 * dof * (1 + len(self.window.position) / known))), 2)


@dataclass(frozen=True)
class DetectionLimits:
    """Smallest changes that are noticed, in one case of two; 1.5 times as large ones almost always."""

    gain: Array
    """Relative (n,); NaN if gravity does not load the joint."""
    offset: Array
    """(n,) [N·m]."""
    rests: int
    """Rests at other poses after which they are noticed."""


def limits(test: CauseTest, config: ObserverConfig, wait: int) -> DetectionLimits:
    """Limits in work at poses like those of a test.

    A change is noticed if it stands out of a window of the longest kind, by the rule of the cause test, and rows after
    it confirm it. `wait` is the number of rests until the first test.
    """
    count, n = test.window.position.shape
    longer = np.sqrt(config.longest_window / count)
    gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) / longer for cause in ("gain", "offset"))
    gain[~(gain <= MOST_GAIN_LIMIT)] = np.nan
    return DetectionLimits(gain, offset, wait + config.longest_window + 2 * config.window)
