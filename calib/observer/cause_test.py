"""The cause test: which single effect explains a window's torque residual, if any (docs/theory.md, section 6)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from calib.fit.calibration import VERY_STRONG_EVIDENCE
from calib.observer.config import LONGEST_WINDOW, ObserverConfig
from calib.observer.evidence import DRIFT, ChangeFit, ChangeHypothesis, ResidualTest, Verdict
from calib.observer.gravity_belief import GravityBelief
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_levers, gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

OF_AN_ARM = ("friction", "spring", "slip", "tilt", "scale")
"""Causes that a discrepancy consists of: as small as its level they are not told."""
INEXACT = 0.02
"""Most that an effect's own shape may be off, as a share: it is as inexact as the gravity model's torque."""
LEVEL_ROWS = 10
"""Rows that what was expected of the discrepancy's level counts for beside those it was fitted to."""
MISFIT = 4.0
"""(χ² − dof)/√(2 dof) above which no entry explains the window (docs/theory.md, section 6)."""

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


def dictionary(arm: Arm, beta: Array, window: StaticReadings) -> Iterator[ChangeHypothesis]:
    """Every entry of the dictionary for the true angles of a window; beta (2n,) [kg·m] is the present gravity model."""
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
        yield ChangeHypothesis("gain", j, row_of(j, torque[:, j]))
        yield ChangeHypothesis("offset", j, row_of(j, one))
        yield ChangeHypothesis("drift", j, row_of(j, torque[:, j], one))
        yield ChangeHypothesis("friction", j, row_of(j, window.direction[:, j]))
        yield ChangeHypothesis("spring", j, row_of(j, q[:, j] - middle[j], one))
    stiffness = gravity_stiffness(arm, beta, q)
    for j in range(n):
        yield ChangeHypothesis("slip", j, stiffness[:, :, j].reshape(-1, 1))
    yield ChangeHypothesis("payload", None, (regressor @ np.column_stack(payload_columns(arm))).reshape(-1, 4))
    across = np.linalg.svd(arm.gravity[None])[2][1:] * np.linalg.norm(arm.gravity)
    tilted = [gravity_regressor(replace(arm, gravity=direction), q) @ beta for direction in across]
    yield ChangeHypothesis("tilt", None, np.stack(tilted, axis=-1).reshape(-1, 2))
    # a payload explains nine tenths of a common scale and is far more frequent: at the same price it wins
    yield ChangeHypothesis("scale", None, torque.reshape(-1, 1), price=4)


def class_of(entry: ChangeHypothesis) -> str:
    """Class of an entry in the comparison of verdicts: gain, offset and both of one joint are one class."""
    cause = "drift" if entry.cause in DRIFT else entry.cause
    return cause if entry.joint is None else f"{cause}_{entry.joint + 1}"


def kin(entry: ChangeHypothesis, winner: ChangeHypothesis) -> bool:
    """Whether an entry is not a rival: it is of the same class, or the winner is a special case of it."""
    special = entry.joint == winner.joint and set(CAUSES[winner.cause]) < set(CAUSES[entry.cause])
    return class_of(entry) == class_of(winner) or special


class CauseTest:
    """The dictionary fitted to one window, with model error marginalised: the belief's covariance and σ²I."""

    def __init__(self, belief: GravityBelief, window: StaticReadings, temperature: Array | None = None) -> None:
        """Of K rows with true angles, torques as installed, their standard deviations, temperatures (K, n) if told."""
        self.belief, self.window = belief, window
        expected = belief.expected(window.position, window.direction, temperature)
        residual = window.torque - expected.torque - expected.mean
        covariance = expected.covariance.copy()
        covariance[np.diag_indices_from(covariance)] += window.sigma.ravel() ** 2
        noise = (window.sigma**2).mean(axis=0)
        self.of_model: Array = 1 - noise / (noise + expected.variance.mean(axis=0))
        """Share of the model's own error in the variance of each joint's residuals (n,)."""
        self.found = ResidualTest(residual.ravel(), covariance, list(dictionary(belief.arm, belief.beta, window)))
        discrepancy = float(np.median(belief.level.total / belief.kernel.typical)) if belief.level.total.any() else 0.0
        self._inexact = min(discrepancy, INEXACT)

    def verdict(self) -> Verdict:
        """The winning class, or why none wins."""
        fits = sorted(map(self._fit, range(len(self.found.hypotheses))), key=lambda fit: fit.bic)
        best = fits[0]
        classes = {"none": self.found.chi2}
        for fit in reversed(fits):
            classes[class_of(fit.hypothesis)] = fit.bic
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

        if self.found.chi2 - best.bic < VERY_STRONG_EVIDENCE:
            misfit = self._misfit(self.found.chi2, 0)
            evidence["misfit"] = misfit
            return answer("unknown" if misfit > MISFIT else "none", None, "none")
        winner, name = best.hypothesis, class_of(best.hypothesis)
        inexact = self._inexact**2 * (self.found.chi2 - best.chi2)
        evidence["misfit"] = self._misfit(best.chi2 - inexact, winner.columns.shape[1])
        if evidence["misfit"] > MISFIT or (winner.cause == "payload" and not self._weighs(best)):
            return self._two_drifts() or self._all_zeros() or answer("unknown", None, name)
        near = [fit.hypothesis for fit in fits[1:] if fit.bic - best.bic < VERY_STRONG_EVIDENCE]
        rivals = tuple(dict.fromkeys(class_of(entry) for entry in near if not kin(entry, winner)))
        sensor_or_load = any(entry.cause in (*DRIFT, "payload") for entry in near)
        if winner.cause in OF_AN_ARM and not sensor_or_load and self._is_small(best):
            return answer("none", None, "none")
        if rivals:
            return answer("ambiguous", best, name, rivals)
        return answer(winner.cause, best, name)

    def _is_small(self, fit: ChangeFit) -> bool:
        """Whether an effect is no larger than the arm's discrepancy anyway: twice its level at each joint."""
        size = (fit.hypothesis.columns @ fit.values).reshape(-1, self.belief.arm.n)
        return bool((np.sqrt((size**2).mean(axis=0)) <= 2 * self.belief.level.total).all())

    def _fit(self, *indices: int) -> ChangeFit:
        """Generalised least squares of entries together; columns that are collinear at these poses never win.

        But for a payload: of an arm with parallel axes no lever may show its mass, or where it is along them. These
        parameters come with variance 0.
        """
        fit, entries = self.found.fit(*indices), [self.found.hypotheses[index] for index in indices]
        count = len(fit.values)
        payload = [entry.cause for entry in entries] == ["payload"]
        if fit.shown and (fit.shown == count or (payload and fit.shown == self.belief.kernel.payload_rank)):
            return fit
        unknown = np.full((count, count), np.nan)
        return ChangeFit(entries[0], np.inf, np.inf, unknown[0], unknown, fit.shown)

    def _two_drifts(self) -> Verdict | None:
        """Two joints that drift at once, if that alone explains the window; else None.

        Competes with the drift of one joint together with an effect on the whole arm, such as a payload picked up.
        """
        entries = self.found.hypotheses
        whole = [index for index, entry in enumerate(entries) if entry.joint is None]
        drifts = [index for index, entry in enumerate(entries) if entry.cause == "drift"]
        drifts.sort(key=lambda index: self._fit(index).chi2)
        pairs = [*combinations(drifts, 2), *product(drifts, whole)]
        fits = {pair: self._fit(*pair) for pair in pairs}
        best = min(fits, key=lambda pair: fits[pair].bic)
        fit = fits[best]
        if not np.isfinite(fit.bic) or self._misfit(fit.chi2, 4) > MISFIT or best[1] in whole:
            return None
        above = np.array([other.bic - fit.bic for pair, other in fits.items() if pair != best])
        if above.min() < VERY_STRONG_EVIDENCE:
            return None
        confidence = float(1 / (1 + np.exp(-above / 2).sum()))
        evidence = {"next": round(float(above.min()), 1), "misfit": self._misfit(fit.chi2, 4)}
        first, second = (entries[index].joint for index in best)
        return Verdict("drift", first, confidence, fit.values, fit.covariance, evidence, beside=second)

    def _weighs(self, payload: ChangeFit) -> bool:
        """Whether a payload's mass is possible: positive, or no more taken off than the model carries as a tool; or no
        lever shows it."""
        return bool(payload.values[0] > min(0.0, -1.2 * self.belief.mass)) or payload.covariance[0, 0] == 0

    def _all_zeros(self) -> Verdict | None:
        """The zeros of several sensors moved together, as temperature moves them, if that alone explains the window."""
        zeros = [self.found.index("offset", joint) for joint in range(self.belief.arm.n)]
        fit = self._fit(*zeros)
        misfit = self._misfit(fit.chi2, len(zeros))
        if not np.isfinite(fit.bic) or misfit > MISFIT:
            return None
        return Verdict("temperature", None, 1.0, fit.values, fit.covariance, {"misfit": misfit})

    def drift(self, joint: int, cause: str, beside: int | None = None) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) under `cause` (gain, offset or drift), and covariance (2, 2).

        If the joint `beside` drifts too, both are fitted together.
        """
        also = [] if beside is None else [self.found.index("drift", beside)]
        fit = self._fit(self.found.index(cause, joint), *also)
        at = [index for index, name in enumerate(("gain", "offset")) if cause in (name, "drift")]
        values, covariance = np.zeros(2), np.zeros((2, 2))
        values[at] = fit.values[: len(at)]
        covariance[np.ix_(at, at)] = fit.covariance[: len(at), : len(at)]
        return values, covariance

    def noticed(self, cause: str, joint: int) -> float:
        """Size of a gain's or offset's change that wins in one case of two: over "none", and over every rival."""
        index, entries = self.found.index(cause, joint), self.found.hypotheses
        rivals = [k for k, entry in enumerate(entries) if not kin(entry, entries[index])]
        return self.found.noticed(index, rivals, VERY_STRONG_EVIDENCE)

    def loss(self, joint: int, simple: str, full: str, beside: int | None = None) -> float:
        """BIC of a joint's drift `simple` above that of `full` (each gain, offset or drift)."""
        also = [] if beside is None else [self.found.index("drift", beside)]
        less, more = (self._fit(self.found.index(cause, joint), *also).bic for cause in (simple, full))
        return less - more

    def lever_share(self, joint: int) -> float:
        """Largest Γ_j/g in the window: gravity's lever on the joint as a share of g."""
        levers = gravity_levers(self.belief.arm, self.window.position)[:, joint]
        return float(levers.max() / np.linalg.norm(self.belief.arm.gravity))

    def _misfit(self, chi2: float, parameters: int) -> float:
        level = self.belief.level
        doubt = len(self.window.position) / (level.rows + LEVEL_ROWS) if level.total.any() else 0.0
        return self.found.misfit(chi2, parameters, doubt)


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
    longer = np.sqrt(LONGEST_WINDOW / count)
    gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) / longer for cause in ("gain", "offset"))
    gain[~(gain <= 1.0)] = np.nan  # gravity hardly loads the joint: not even a gain of 0 would be noticed
    return DetectionLimits(gain, offset, wait + LONGEST_WINDOW + 2 * config.window)
