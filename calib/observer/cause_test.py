"""The cause test: which single effect explains the torque residuals of a window of rows, if any.

Generalised least squares of each candidate, with the belief's own doubt in the covariance; candidates compete by BIC
(docs/theory.md, section 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise, product

import numpy as np

from calib.fit.calibration import NOISE_ROUNDS, VERY_STRONG_EVIDENCE
from calib.motion.static_reading import StaticReading, batch, stack
from calib.observer.config import WindowSizes
from calib.observer.evidence import (
    DRIFT,
    INEXACT,
    ChangeFit,
    ChangeHypothesis,
    Verdict,
    decomposed,
    smallest_noticed_change,
    span,
)
from calib.observer.gravity_belief import GravityBelief
from calib.observer.motor_belief import MotorBelief
from gcomp.arrays import Array
from gcomp.estimate.posterior import linear_posterior
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.readings import StaticReadings

AGREEMENT = 13.8
"""Two disjoint windows agree if the χ² of their difference (gain, offset) is smaller: noise exceeds it, with 2 degrees
of freedom, once in 1000 (docs/theory.md, section 6)."""
OF_AN_ARM = ("friction", "spring", "slip", "tilt", "scale")
"""Causes that a discrepancy consists of: as small as its level they are not told."""

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

Belief = GravityBelief | MotorBelief
"""An arm as its records and the rows in which nothing had changed describe it."""


def kin(entry: ChangeHypothesis, winner: ChangeHypothesis) -> bool:
    """Whether an entry is not a rival: it is of the same class, or the winner is a special case of it."""
    special = entry.joint == winner.joint and set(CAUSES[winner.cause]) < set(CAUSES[entry.cause])
    return entry.class_name == winner.class_name or special


def cause_test(belief: Belief, rows: Sequence[StaticReading]) -> "CauseTest":
    """The test of these rows, by the belief from rows before them."""
    return CauseTest(belief.before(rows[0].position), batch(rows, belief.sigma), stack(rows, "temperature"))


class CauseTest:
    """Every change that the belief knows, fitted to one window, with the model's error marginalised."""

    def __init__(self, belief: Belief, window: StaticReadings, temperature: Array | None = None) -> None:
        """Of K rows with true angles, torques as installed, their standard deviations, temperatures (K, n) if told."""
        self.belief, self.window = belief, window
        self.known = known = belief.residuals(window, temperature)
        self.hypotheses = known.hypotheses
        self._root = np.linalg.cholesky(known.covariance)
        white = self._whitened(np.column_stack([known.residual, *(each.columns for each in self.hypotheses)]))
        self._residual: Array = white[:, 0]
        ends = np.cumsum([1, *(each.columns.shape[1] for each in self.hypotheses)])
        self._columns: list[Array] = [white[:, begin:end] for begin, end in pairwise(ends)]
        self._chi2 = float(self._residual @ self._residual)
        """Where nothing has changed."""

    def verdict(self) -> Verdict:
        """The winning class, or why none wins."""
        fits = sorted(map(self._fit, range(len(self.hypotheses))), key=lambda fit: fit.bic)
        classes = {"none": self._chi2}
        for fit in reversed(fits):
            classes[fit.hypothesis.class_name] = fit.bic
        top = min(classes.values())
        weights = {name: np.exp(-(bic - top) / 2) for name, bic in classes.items()}
        total = sum(weights.values())
        evidence = {
            name: round(float(bic - top), 1) for name, bic in sorted(classes.items(), key=lambda item: item[1])[:6]
        }

        def answer(cause: str, fit: ChangeFit | None, of: str, rivals: tuple[str, ...] = ()) -> Verdict:
            known = (fit.values, fit.covariance) if fit else (np.empty(0), np.empty((0, 0)))
            joint = fit.hypothesis.joint if fit else None
            return Verdict(cause, joint, float(weights[of] / total), *known, evidence, rivals)

        if not fits or self._chi2 - fits[0].bic < VERY_STRONG_EVIDENCE:
            misfit = self._misfit(self._chi2, 0)
            evidence["misfit"] = misfit
            return answer("unknown" if misfit > self.belief.misfit_limit else "none", None, "none")
        best = fits[0]
        winner, name = best.hypothesis, best.hypothesis.class_name
        inexact = min(float(np.median(self.known.relative_level)), INEXACT) ** 2 * (self._chi2 - best.chi2)
        evidence["misfit"] = self._misfit(best.chi2 - inexact, winner.columns.shape[1])
        if evidence["misfit"] > self.belief.misfit_limit or (winner.cause == "payload" and not self._weighs(best)):
            return self._two_drifts() or self._all_zeros() or answer("unknown", None, name)
        near = [fit.hypothesis for fit in fits[1:] if fit.bic - best.bic < VERY_STRONG_EVIDENCE]
        rivals = tuple(dict.fromkeys(entry.class_name for entry in near if not kin(entry, winner)))
        sensor_or_load = any(entry.cause in (*DRIFT, "payload") for entry in near)
        if winner.cause in OF_AN_ARM and not sensor_or_load and self._is_small(best):
            return answer("none", None, "none")
        if rivals:
            return answer("ambiguous", best, name, rivals)
        return answer(winner.cause, best, name)

    def drift(self, joint: int, cause: str, beside: int | None = None) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) under `cause` (gain, offset or drift), and covariance (2, 2).

        If the joint `beside` drifts too, both are fitted together.
        """
        fit = self._drift_fit(joint, cause, beside)
        at = [index for index, name in enumerate(("gain", "offset")) if cause in (name, "drift")]
        values, covariance = np.zeros(2), np.zeros((2, 2))
        values[at] = fit.values[: len(at)]
        covariance[np.ix_(at, at)] = fit.covariance[: len(at), : len(at)]
        return values, covariance

    def sensor(self, joint: int) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) [1, N·m], fitted together, and their covariance (2, 2).

        Drawn towards nothing where the rows tell little.
        """
        std = self.belief.change_std
        columns = np.zeros((len(self._residual), 2))
        for place, cause in enumerate(("gain", "offset")):
            if (cause, joint) in self._index:
                columns[:, [place]] = self._columns[self._index[cause, joint]]
        fit = linear_posterior(columns, self._residual, np.zeros(2), std)
        return fit.x, fit.covariance

    def denies(self, cause: str, joints: tuple[int, ...], values: Array) -> bool:
        """Whether these rows show that an earlier change of these values is there no more."""
        own = self._index.get((cause, joints[0] if joints else None))
        if own is None:
            return cause not in CAUSES or not joints
        fit = self._fit(own)
        if fit.values.shape != values.shape or not np.isfinite(fit.bic):
            return True
        known = np.diag(fit.covariance) > 0
        away = (fit.values - values)[known]
        apart = float(away @ np.linalg.pinv(fit.covariance[np.ix_(known, known)]) @ away)
        return bool(apart > AGREEMENT + 2 * known.sum())

    def noticed(self, cause: str, joint: int) -> float:
        """Size of a change of one parameter that wins in one case of two: over "none", and over every rival; NaN if no
        row tells it."""
        index, entries = self._index.get((cause, joint)), self.hypotheses
        if index is None:
            return float("nan")
        rivals = [k for k, entry in enumerate(entries) if not kin(entry, entries[index])]
        bases = ((self._bases[rival], entries[rival].parameters) for rival in rivals)
        return smallest_noticed_change(self._columns[index][:, 0], bases, VERY_STRONG_EVIDENCE)

    def loss(self, joint: int, simple: str, full: str, beside: int | None = None) -> float:
        """BIC of a joint's drift `simple` above that of `full` (each gain, offset or drift)."""
        return self._drift_fit(joint, simple, beside).bic - self._drift_fit(joint, full, beside).bic

    def lever_share(self, joint: int) -> float:
        """Largest Γ_j/g in the window: gravity's lever on the joint as a share of g."""
        levers = gravity_levers(self.belief.arm, self.window.position)[:, joint]
        return float(levers.max() / np.linalg.norm(self.belief.arm.gravity))

    def _whitened(self, columns: Array) -> Array:
        return np.linalg.solve(self._root, columns)  # scipy takes longer to load

    @cached_property
    def _bases(self) -> list[Array]:
        return [span(columns) for columns in self._columns]

    @cached_property
    def _index(self) -> dict[tuple[str, int | None], int]:
        """(Cause, joint) → number of the hypothesis."""
        return {(each.cause, each.joint): number for number, each in enumerate(self.hypotheses)}

    def _drift_fit(self, joint: int, cause: str, beside: int | None) -> ChangeFit:
        wanted = [(cause, joint)] if beside is None else [(cause, joint), ("drift", beside)]
        return self._fit(*(self._index[each] for each in wanted))

    def _fit(self, *indices: int) -> ChangeFit:
        """Generalised least squares of entries together; columns that are collinear at these poses never win.

        But for a payload: of an arm with parallel axes no lever may show its mass, or where it is along them. These
        parameters come with variance 0.
        """
        entries = [self.hypotheses[index] for index in indices]
        columns = np.hstack([self._columns[index] for index in indices])
        fit = _least_squares(entries, columns, self._residual)
        about = entries[0].about if len(entries) == 1 else None
        for _ in range(0 if about is None else NOISE_ROUNDS):
            assert about is not None
            white = self._whitened(np.column_stack(about(fit.values)))
            change = _least_squares(entries, white[:, 1:], white[:, 0])
            fit = replace(change, values=fit.values + change.values)
        count = len(fit.values)
        payload = [entry.cause for entry in entries] == ["payload"]
        if fit.shown and (fit.shown == count or (payload and fit.shown >= self.belief.payload_rank)):
            return fit
        unknown = np.full((count, count), np.nan)
        return ChangeFit(entries[0], np.inf, np.inf, unknown[0], unknown, fit.shown)

    def _is_small(self, fit: ChangeFit) -> bool:
        """Whether an effect is no larger than the arm's discrepancy anyway: twice its level at each joint."""
        level = self.known.level
        if not level.any():
            return False
        size = (fit.hypothesis.columns @ fit.values).reshape(-1, len(level))
        return bool((np.sqrt((size**2).mean(axis=0)) <= 2 * level).all())

    def _two_drifts(self) -> Verdict | None:
        """Two joints that drift at once, if that alone explains the window; else None.

        Competes with the drift of one joint together with an effect on the whole arm, such as a payload picked up.
        """
        entries = self.hypotheses
        whole = [index for index, entry in enumerate(entries) if entry.joint is None]
        drifts = [index for index, entry in enumerate(entries) if entry.cause == "drift"]
        drifts.sort(key=lambda index: self._fit(index).chi2)
        fits = {pair: self._fit(*pair) for pair in (*combinations(drifts, 2), *product(drifts, whole))}
        if not fits:
            return None
        best = min(fits, key=lambda pair: fits[pair].bic)
        fit = fits[best]
        misfit = self._misfit(fit.chi2, 4) if np.isfinite(fit.bic) else np.inf
        if misfit > self.belief.misfit_limit or best[1] in whole:
            return None
        above = np.array([other.bic - fit.bic for pair, other in fits.items() if pair != best])
        if above.min() < VERY_STRONG_EVIDENCE:
            return None
        confidence = float(1 / (1 + np.exp(-above / 2).sum()))
        evidence = {"next": round(float(above.min()), 1), "misfit": misfit}
        first, second = (entries[index].joint for index in best)
        return Verdict("drift", first, confidence, fit.values, fit.covariance, evidence, beside=second)

    def _weighs(self, payload: ChangeFit) -> bool:
        """Whether a payload's mass is possible: positive, or no more taken off than the model carries as a tool; or no
        lever shows it."""
        return bool(payload.values[0] > min(0.0, -1.2 * self.belief.mass)) or payload.covariance[0, 0] == 0

    def _all_zeros(self) -> Verdict | None:
        """The zeros of several sensors moved together, as temperature moves them, if that alone explains the window."""
        if not self.belief.of_sensors:
            return None
        zeros = [index for index, entry in enumerate(self.hypotheses) if entry.cause == "offset"]
        fit = self._fit(*zeros)
        misfit = self._misfit(fit.chi2, len(zeros)) if np.isfinite(fit.bic) else np.inf
        if misfit > self.belief.misfit_limit:
            return None
        return Verdict("temperature", None, 1.0, fit.values, fit.covariance, {"misfit": misfit})

    def _misfit(self, chi2: float, parameters: int) -> float:
        """χ² above its degrees of freedom, in standard deviations."""
        free = max(len(self._residual) - parameters, 1)
        return round(float((chi2 - free) / np.sqrt(2 * free * (1 + self.known.doubt))), 2)


def _least_squares(together: Sequence[ChangeHypothesis], columns: Array, target: Array) -> ChangeFit:
    """Hypotheses fitted together: whitened columns (K, p) to a whitened target (K,)."""
    u, s, vt, size = decomposed(columns)
    kept = s > 0
    back = (vt[kept].T / s[kept]) / size[:, None]
    explained = u[:, kept].T @ target
    covariance, shown = back @ back.T, int(kept.sum())
    hidden = (np.abs(vt[~kept]) > 1e-3).any(axis=0)
    covariance[hidden] = covariance[:, hidden] = 0.0
    chi2 = float(target @ target) - float(explained @ explained)
    price = sum(each.parameters for each in together) - (columns.shape[1] - shown)
    bic = chi2 + price * float(np.log(len(target)))
    return ChangeFit(together[0], bic, chi2, back @ explained, covariance, shown)


@dataclass(frozen=True)
class DetectionLimits:
    """Smallest changes that are noticed, in one case of two; 1.5 times as large ones almost always."""

    gain: Array
    """Relative (n,); NaN if gravity does not load the joint."""
    offset: Array
    """(n,) [N·m]."""
    rests: int
    """Rows (rests at other poses) after which they are noticed."""


def limits(test: CauseTest, sizes: WindowSizes, wait: int) -> DetectionLimits:
    """Limits in work like that of a test.

    A change is noticed if it stands out of a window of the longest kind, by the rule of the cause test, and rows after
    it confirm it. `wait` is the number of rows until the first test.
    """
    count, n = test.window.position.shape
    longer = np.sqrt(sizes.longest / count)
    gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) / longer for cause in ("gain", "offset"))
    gain[~(gain <= 1.0)] = np.nan  # gravity hardly loads the joint: not even a gain of 0 would be noticed
    return DetectionLimits(gain, offset, wait + sizes.longest + 2 * sizes.window)
