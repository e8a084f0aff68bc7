"""The final fit of the selected terms: coefficients, covariance, reported parameters, predictions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from gcomp.arrays import Array
from sim_gap.residuals.layout import Columns, Row
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore, width_of
from sim_gap.search.term import MASSES, Term, shares_a_factor
from sim_gap.search.term_equations import TermEquations

NOMINAL, WORSE, WORST = 0.01, 0.5, 0.2
"""Undetected error of a nominal model, as of mass moments, relative: NOMINAL, by which two arms of one build differ, or
WORSE times the largest error found at a link, up to WORST."""
SHAPE_STEP = 1e-2
"""Step of the differences in a shape, as a share of it; accuracy to which it is found between its neighbours."""
LEAST_LEVER_M = 0.01
"""Least distance of a link's centre of mass from its joint's axis [m] for judging errors of its moment."""
SYSTEMATIC = 0.15
"""Share of a row's residual and of its relevance floor that mimics an effect, standard deviation, however long the
recording is: calibrated on sealed cases (docs/theory.md, section 12)."""


def _sandwich(inverse: Array, scores: Array) -> Array:
    """Covariance of parameters (P, P) from the inverse of their normal equations and the scores of clusters (C, P)."""
    clusters = max(len(scores), 2)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse * clusters / (clusters - 1))


@dataclass(frozen=True)
class Value:
    value: float
    low: float
    high: float
    unit: str


class EffectEstimate:
    """Terms fitted to a training set."""

    def __init__(self, store: ColumnStore, terms: Sequence[Term]) -> None:
        """Terms of a choice on this store, which holds the columns about what they are fitted to be."""
        self.store = store
        self.equations = TermEquations(store, terms)
        self.terms = tuple(self.equations.terms)
        every = self.equations.index(self.terms).tolist()
        self.linear = self.equations.linear.reweighed(every)
        self.coefficients = self.linear.fit(every)
        self._elsewhere: ColumnStore | None = None

    def of(self, term: Term) -> Array:
        return self.coefficients[self.equations.at[term]]

    def subset(self, terms: Sequence[Term]) -> Array:
        """Coefficients (P,) of a fit of these terms alone with the final weights; zero for the others."""
        return self.linear.fit(self.equations.index(terms).tolist())

    def at_bounds(self) -> list[Term]:
        """Terms of which a coefficient is the largest or least that can exist: its size is not determined."""
        at = {k for k in self.linear.at_bounds(self.coefficients).tolist() if self.coefficients[k]}
        return [term for term in self.terms if at & {*self.equations.at[term].tolist()}]

    @cached_property
    def _jacobian(self) -> list[tuple[float, Array, Array, NDArray[np.intp]]]:
        """Per row: weight, columns with shape derivatives (k, P + S), residual (k,), block (k,)."""
        data, size, out = self.store.data, self.equations.size, []
        counts = self.linear.counts.sum(1)
        shaped = [(term, term.free) for term in self._shaped]
        for r, row in enumerate(self.equations.rows):
            valid = data.valid[row]
            weight = float(counts[r] / max(valid.sum(), 1) / self.linear.variance[r])
            x = np.zeros((len(valid), size + len(shaped)))
            touching = [term for term in self.terms if row in self.store.columns(term)]
            x[:, self.equations.index(touching)] = self.store.wide(touching, row, self.equations.fixed)
            for k, (term, i) in enumerate(shaped):
                if row in self.store.columns(term):
                    assert i is not None
                    x[:, size + k] = self._shape_slope(term, i, row)
            residual = data.values[row] - x[:, :size] @ self.coefficients
            out.append((weight, x[valid], residual[valid], data.blocks[valid]))
        return out

    @cached_property
    def _shaped(self) -> list[Term]:
        return [term for term in self.terms if term.free is not None]

    def _shape_slope(self, term: Term, i: int, row: Row) -> Array:
        step = SHAPE_STEP * abs(term.shape[i])
        moved = (term.reshaped(i, term.shape[i] + d) for d in (step, -step))
        above, below = (self.store.columns(each)[row] @ self.of(term) for each in moved)
        return np.asarray((above - below) / (2.0 * step))

    @cached_property
    def covariance(self) -> Array:
        """Covariance of coefficients and fitted shapes, (P + S, P + S): a sandwich estimate over blocks of time, plus
        systematic errors: SYSTEMATIC times each row's residual along the column itself, undetected errors of the links'
        mass moments, and the effect's standard deviation over sound arms; wider by what changes from recording to
        recording."""
        size = self._jacobian[0][1].shape[1]
        bread, scores = np.zeros((size, size)), np.zeros((int(self.store.data.blocks.max()) + 1, size))
        for weight, x, residual, block in self._jacobian:
            bread += weight * x.T @ x
            np.add.at(scores, block, weight * x * residual[:, None])
        own = np.arange(self.equations.size)
        bread[own, own] += self.linear.prior
        scale = 1.0 / np.sqrt(np.maximum(np.diag(bread), 1e-300))
        scale[[*self.equations.fixed.values()]] = 0.0  # what stands beside a term's columns is no parameter
        inverse = np.linalg.pinv(bread * scale * scale[:, None], hermitian=True, rcond=1e-10) * scale * scale[:, None]
        systematic = SYSTEMATIC**2 * float(self.linear.counts.sum()) / max(len(self._jacobian), 1) * inverse
        background = np.zeros(size)
        for term in self.terms:
            background[self.equations.at[term]] = self._background(term)
        whole = _sandwich(inverse, scores) + systematic + self._undetected(inverse) + np.diag(background**2)
        wider = self._widening(whole, inverse, scores)
        return np.asarray(whole * wider * wider[:, None])

    def _widening(self, whole: Array, inverse: Array, scores: Array) -> Array:
        """Factor on the standard deviations of a covariance for what changes from recording to recording, (P + S,).

        A sandwich over whole recordings has that, one over blocks of time not. What it has more is a variance with as
        many degrees of freedom as there are recordings less one; the sum has those of Satterthwaite (Biometrics
        Bulletin 2, 1946), and Student's factor for them is in this one.
        """
        blocks, ends = self.store.data.blocks, np.cumsum(self.store.data.lengths)
        if (count := len(ends)) < 2:
            return np.ones(len(whole))
        of_recordings = np.add.reduceat(scores, [0, *(blocks[ends[:-1] - 1] + 1).tolist()], axis=0)
        own = np.where(np.diag(whole) > 0.0, np.diag(whole), 1.0)
        both = (np.diag(_sandwich(inverse, each)) for each in (of_recordings, scores))
        excess = np.maximum(np.subtract(*both), 0.0)
        freedom = (own + excess) ** 2 / (own**2 / self._freedom + excess**2 / (count - 1))
        return np.asarray(np.sqrt(1.0 + excess / own) * stdtrit(freedom, 0.975) / self._quantile)

    def _undetected(self, inverse: Array) -> Array:
        """Contribution to the covariance of undetected errors z of the links' mass moments, (P + S, P + S).

        They shift the coefficients by A⁻¹ XᵀW Z z, A⁻¹ being `inverse`. The mean square of z about zero follows from
        its usual size and the residual.
        """
        errors = self._errors_of_links()
        if not errors:
            return np.zeros_like(inverse)
        size = sum(width_of(columns) for columns in errors)
        pull, own, seen = np.zeros((len(inverse), size)), np.eye(size), np.zeros(size)
        for (weight, x, residual, _), row in zip(self._jacobian, self.equations.rows, strict=True):
            valid = self.store.data.valid[row]
            z = np.hstack([c[row] if row in c else np.zeros((len(valid), width_of(c))) for c in errors])[valid]
            pull += weight * x.T @ z
            own += weight * z.T @ z
            seen += weight * z.T @ residual
        moved = inverse @ pull
        spread = np.linalg.inv(own - pull.T @ moved)
        mean = spread @ seen
        return np.asarray(moved @ (spread + np.outer(mean, mean)) @ moved.T)

    def _errors_of_links(self) -> list[Columns]:
        """Changes of the rows by undetected errors of usual size, (K, z) each: of each component of each link's mass
        moment that is not a term; with torque constants that only motor torque tells, of all masses in common, too."""
        arm = self.store.data.signals[0].arm
        found = {term.place: self.of(term) for term in self.terms if term.effect == MASSES}
        usual = np.maximum(np.linalg.norm(arm.inertial[:, 1:4], axis=1), LEAST_LEVER_M * arm.inertial[:, 0])
        wrong = max((float(np.linalg.norm(found[link]) / usual[link]) for link in found), default=0.0)
        share = min(max(NOMINAL, WORSE * wrong), WORST)
        errors = [(share * usual[k], self.store.columns(Term(MASSES, k))) for k in range(arm.n) if k not in found]
        if shares_a_factor(self.equations.layout, self.terms):
            errors.append((NOMINAL, self.store.masses_in_common()))
        return [{row: size * x for row, x in columns.items()} for size, columns in errors if columns]

    def _background(self, term: Term) -> Array | float:
        """Standard deviation of a term's coefficients over sound arms."""
        usual = term.form.plausibility
        std = usual.background_std(term.shape) if callable(usual.background_std) else usual.background_std
        return self.store.data.background(std) if usual.background_nm else std

    def is_usual(self, term: Term) -> bool:
        """Whether a sound arm may have as much of an effect: every coefficient is within 95 % of theirs."""
        return bool(np.all(np.abs(self.of(term)) <= ndtri(0.975) * self._background(term)))

    def may_be_nothing(self, term: Term) -> bool:
        """Whether the 95 % interval of every coefficient of a term contains zero."""
        at = self.equations.at[term]
        return bool(np.all(np.abs(self.of(term)) <= self._quantile * np.sqrt(np.diag(self.covariance)[at])))

    @property
    def _freedom(self) -> int:
        """Degrees of freedom of the covariance: blocks of time less one."""
        return max(int(self.store.data.blocks.max()), 1)

    @cached_property
    def _quantile(self) -> float:
        """Half of a 95 % interval in standard deviations."""
        return float(stdtrit(self._freedom, 0.975))

    def parameters(self, term: Term) -> dict[str, Value]:
        reported, start, chosen = self._reported(term)
        centre, steps = reported(start), 1e-5 * np.maximum(np.abs(start), 1e-3)
        slopes = [
            (reported(start + d) - reported(start - d)) / (2 * s) for s, d in zip(steps, np.diag(steps), strict=True)
        ]
        jacobian = np.stack(slopes, axis=1)
        spread = np.sqrt(np.maximum(np.diag(jacobian @ self.covariance[np.ix_(chosen, chosen)] @ jacobian.T), 0.0))
        half = spread * self._quantile
        of_joint = not term.effect.startswith(("link.", "base."))
        arm = self.store.data.signals[0].arm
        return {
            name: Value(float(c), float(c - h), float(c + h), arm.unit_at(term.place, unit) if of_joint else unit)
            for (name, unit), c, h in zip(term.form.reported, centre, half, strict=True)
        }

    def draws(self, terms: Sequence[Term], count: int, seed: int) -> list[dict[Term, dict[str, float]]]:
        """Parameters of these terms drawn from their joint distribution, Student's t as their intervals are."""
        random, freedom = np.random.default_rng(seed), self._freedom
        errors = random.multivariate_normal(np.zeros(len(self.covariance)), self.covariance, count, method="eigh")
        errors *= np.sqrt(freedom / random.chisquare(freedom, (count, 1)))
        forms = {term: self._reported(term) for term in terms}
        names = {term: [name for name, _ in term.form.reported] for term in terms}
        return [
            {
                term: dict(zip(names[term], reported(start + error[chosen]).tolist(), strict=True))
                for term, (reported, start, chosen) in forms.items()
            }
            for error in errors
        ]

    def _reported(self, term: Term) -> tuple[Callable[[Array], Array], Array, list[int]]:
        """The reported parameters as a function of what they follow from, its fitted value, its place in the fit."""
        effect = term.form
        beneath = {other.effect: other for other in self.terms if other.key in term.beneath}
        shaped, free = self._shaped, term.free
        chosen = [*self.equations.at[term], *(i for other in beneath.values() for i in self.equations.at[other])]
        if term in shaped:
            chosen.append(self.equations.size + shaped.index(term))
        own = len(self.equations.at[term])

        def evaluate(z: Array) -> Array:
            shape = term.shape if free is None else term.reshaped(free, float(z[-1])).shape
            under, at = {"nominal": self.equations.ratings.joint[:, term.place]}, own
            for name, other in beneath.items():
                width = len(self.equations.at[other])
                under[name], at = z[at : at + width], at + width
            return np.asarray(effect.parameters_of(z[:own], shape, under), float)

        size = () if free is None else (term.shape[free],)
        return evaluate, np.concatenate([self.of(term), *(self.of(other) for other in beneath.values()), size]), chosen

    def predict(
        self, data: ResidualSet, store: ColumnStore | None = None, terms: tuple[Term, ...] | None = None
    ) -> dict[Row, Array]:
        """Sum of the terms on another set, (K,) per row."""
        store = store or self.on(data)
        out = {row: np.zeros(sum(data.lengths)) for row in data.rows}
        for term in self.terms if terms is None else terms:
            for row, columns in store.columns(term).items():
                out[row] += columns @ self.of(term)
            for row, beside in store.offset(term).items():
                out[row] += beside[:, 0]
        return out

    def on(self, data: ResidualSet) -> ColumnStore:
        """The columns of another set about this estimate."""
        if data is self.store.data:
            return self.store
        if self._elsewhere is None or self._elsewhere.data is not data:
            self._elsewhere = ColumnStore(data, self.store.values)
        return self._elsewhere
