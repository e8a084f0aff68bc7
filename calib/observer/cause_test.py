"""The cause test: which single effect explains a window's torque residual, if any (docs/theory.md, section 6)."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from calib.fit.calibration import VERY_STRONG_EVIDENCE
from calib.observer.evidence import DRIFT, ChangeTest, Verdict
from calib.observer.gravity_belief import GravityBelief
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.estimate.explanation import ChangeFit, ChangeHypothesis, ResidualTest
from gcomp.gravity.torque import gravity_levers, gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

OF_AN_ARM = ("friction", "spring", "slip", "tilt", "scale")
"""Causes that a discrepancy consists of: as small as its level they are not told."""
INEXACT = 0.02
"""Most that an effect's own shape may be off, as a share: it is as inexact as the gravity model's torque."""
LEVEL_ROWS = 10
"""Rows that what was expected of the discrepancy's level counts for beside those it was fitted to."""

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
    at_origin, by_point = payload_columns(arm)
    yield ChangeHypothesis("payload", None, (regressor @ np.column_stack([at_origin, by_point])).reshape(-1, 4))
    across = np.linalg.svd(arm.gravity[None])[2][1:] * np.linalg.norm(arm.gravity)
    tilted = [gravity_regressor(replace(arm, gravity=direction), q) @ beta for direction in across]
    yield ChangeHypothesis("tilt", None, np.stack(tilted, axis=-1).reshape(-1, 2))
    # a payload explains nine tenths of a common scale and is far more frequent: at the same price it wins
    yield ChangeHypothesis("scale", None, torque.reshape(-1, 1), price=4)


class CauseTest(ChangeTest):
    """The dictionary fitted to one window, with model error marginalised: the belief's covariance and σ²I."""

    most_misfit = 4.0
    """docs/theory.md, section 6.4."""

    def __init__(self, belief: GravityBelief, window: StaticReadings, temperature: Array | None = None) -> None:
        """Of K rows with true angles, torques as installed, their standard deviations, temperatures (K, n) if told."""
        self.belief, self.window = belief, window
        expected = belief.expected(window.position, window.direction, temperature)
        residual = window.torque - expected.torque - expected.mean
        covariance = expected.covariance.copy()
        covariance[np.diag_indices_from(covariance)] += window.sigma.ravel() ** 2
        noise = (window.sigma**2).mean(axis=0)
        self._of_model: list[float] = (1 - noise / (noise + expected.variance.mean(axis=0))).tolist()
        level = belief.level.total
        found = ResidualTest(residual.ravel(), covariance, list(dictionary(belief.arm, belief.beta, window)))
        doubt = len(window.position) / (belief.level.rows + LEVEL_ROWS) if level.any() else 0.0
        super().__init__(found, doubt, min(float(np.median(level / belief.kernel.typical)), INEXACT))

    def class_of(self, entry: ChangeHypothesis) -> str:
        """Gain, offset and both of one joint are one class."""
        cause = "drift" if entry.cause in DRIFT else entry.cause
        return cause if entry.joint is None else f"{cause}_{entry.joint + 1}"

    def kin(self, entry: ChangeHypothesis, winner: ChangeHypothesis) -> bool:
        """Of the same class, or the winner is a special case of it."""
        special = entry.joint == winner.joint and set(CAUSES[winner.cause]) < set(CAUSES[entry.cause])
        return super().kin(entry, winner) or special

    def is_of_the_arm(self, best: ChangeFit, near: list[ChangeHypothesis]) -> bool:
        """At most twice the discrepancy's level at each joint; a sensor or a load must not explain it as well."""
        if best.hypothesis.cause not in OF_AN_ARM or any(entry.cause in (*DRIFT, "payload") for entry in near):
            return False
        size = (best.hypothesis.columns @ best.values).reshape(-1, self.belief.arm.n)
        return bool((np.sqrt((size**2).mean(axis=0)) <= 2 * self.belief.level.total).all())

    def fit(self, *indices: int) -> ChangeFit:
        """Columns that are collinear at these poses never win.

        But for a payload: of an arm with parallel axes no lever may show its mass, or where it is along them. These
        parameters come with variance 0.
        """
        fit, entries = super().fit(*indices), [self.found.hypotheses[index] for index in indices]
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
        drifts.sort(key=lambda index: self.fit(index).chi2)
        pairs = [*combinations(drifts, 2), *product(drifts, whole)]
        fits = {pair: self.fit(*pair) for pair in pairs}
        best = min(fits, key=lambda pair: fits[pair].bic)
        fit = fits[best]
        if not np.isfinite(fit.bic) or self.misfit(fit.chi2, 4) > self.most_misfit or best[1] in whole:
            return None
        above = np.array([other.bic - fit.bic for pair, other in fits.items() if pair != best])
        if above.min() < VERY_STRONG_EVIDENCE:
            return None
        confidence = float(1 / (1 + np.exp(-above / 2).sum()))
        evidence = {"next": round(float(above.min()), 1), "misfit": self.misfit(fit.chi2, 4)}
        first, second = (entries[index].joint for index in best)
        return Verdict("drift", first, confidence, fit.values, fit.covariance, evidence, beside=second)

    def is_possible(self, best: ChangeFit) -> bool:
        """A payload's mass is positive, or no more is taken off than the model carries as a tool; or no lever shows
        it."""
        tool = best.hypothesis.cause == "payload" and bool(best.values[0] > -1.2 * self.belief.mass)
        return super().is_possible(best) or tool or best.covariance[0, 0] == 0

    def several_changes(self) -> Verdict | None:
        return self._two_drifts() or self._all_zeros()

    def _all_zeros(self) -> Verdict | None:
        """The zeros of several sensors moved together, as temperature moves them, if that alone explains the window."""
        zeros = [self.found.places["offset", joint] for joint in range(self.belief.arm.n)]
        fit = self.fit(*zeros)
        misfit = self.misfit(fit.chi2, len(zeros))
        if not np.isfinite(fit.bic) or misfit > self.most_misfit:
            return None
        return Verdict("temperature", None, 1.0, fit.values, fit.covariance, {"misfit": misfit})

    def drift(self, joint: int, cause: str, beside: int | None = None) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) under `cause` (gain, offset or drift), and covariance (2, 2).

        If the joint `beside` drifts too, both are fitted together.
        """
        also = [] if beside is None else [self.found.places["drift", beside]]
        fit = self.fit(self.found.places[cause, joint], *also)
        at = [index for index, name in enumerate(("gain", "offset")) if cause in (name, "drift")]
        values, covariance = np.zeros(2), np.zeros((2, 2))
        values[at] = fit.values[: len(at)]
        covariance[np.ix_(at, at)] = fit.covariance[: len(at), : len(at)]
        return values, covariance

    def of_model(self, joint: int) -> float:
        """Share of the model's own error in the variance of a joint's residuals."""
        return self._of_model[joint]

    def loss(self, joint: int, simple: str, full: str, beside: int | None = None) -> float:
        """BIC of a joint's drift `simple` above that of `full` (each gain, offset or drift)."""
        also = [] if beside is None else [self.found.places["drift", beside]]
        less, more = (self.fit(self.found.places[cause, joint], *also).bic for cause in (simple, full))
        return less - more

    def lever_share(self, joint: int) -> float:
        """Largest Γ_j/g in the window: gravity's lever on the joint as a share of g."""
        levers = gravity_levers(self.belief.arm, self.window.position)[:, joint]
        return float(levers.max() / np.linalg.norm(self.belief.arm.gravity))
