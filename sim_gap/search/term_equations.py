"""Normal equations of all candidate terms on one set of residuals, and their choice by held-out likelihood."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from gcomp.estimate.choice import EffectChoice
from gcomp.estimate.linear_terms import PRICE, Effect, LinearTerms, fold_sums
from sim_gap.effects.effect import Key, Ratings
from sim_gap.residuals.residual_set import FEWEST, ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term

CORRELATED = 8.0
"""Samples per independent measurement: residuals of real arms are correlated over a third of a second or more."""
MOST_MEASUREMENTS = 333.0
"""Independent measurements that a row counts for at most: with the price of a parameter, this is a fall of its RMS by
1 %, which what no model has can mimic however long the recording is."""


class TermEquations:
    """Terms as parameters of the residual rows, linear about the estimate of a store of columns."""

    def __init__(self, store: ColumnStore, terms: Sequence[Term], like: "TermEquations | None" = None) -> None:
        """`like` has the same coefficients, on other data."""
        data = store.data
        self.store = store
        self.terms = [term for term in terms if store.columns(term)]
        self.rows, self.layout = data.rows, data.layout
        widths = [next(iter(store.columns(term).values())).shape[1] for term in self.terms]
        ends = np.cumsum([0, *widths])
        self.at = {term: np.arange(ends[i], ends[i + 1]) for i, term in enumerate(self.terms)}
        held = [term for term in self.terms if (term in like.fixed if like else store.offset(term))]
        self.fixed: dict[Term, int] = {term: int(ends[-1]) + k for k, term in enumerate(held)}
        """Index of the column that a nonlinear term has beside its own; its coefficient is one."""
        self.size = int(ends[-1]) + len(held)
        self.ratings = Rated(data, store.values)
        self.linear = self._linear(data, 1 if like else FEWEST)
        store.release()

    def _linear(self, data: ResidualSet, fewest: int) -> LinearTerms:
        valid = np.array([data.valid[row] for row in self.rows])
        seen = valid.sum(1)
        measurements = min(max(int(seen.max()), 1) / CORRELATED, MOST_MEASUREMENTS)
        weight = valid * np.where(seen >= fewest, measurements / np.maximum(seen, 1), 0.0)[:, None]
        touching = [[term for term in self.terms if row in self.store.columns(term)] for row in self.rows]
        acting = tuple(self.index(terms) for terms in touching)
        columns = (-self.store.wide(terms, row, self.fixed).T for terms, row in zip(touching, self.rows, strict=True))
        residual = np.array([data.values[row] for row in self.rows])
        squares, products, totals, counts = fold_sums(columns, residual, weight, data.folds)
        power = np.zeros(self.size)
        for index, gram in zip(acting, squares, strict=True):
            power[index] += np.diagonal(gram.sum(0)) / measurements
        floor = np.array([data.relevance_floor[row] for row in self.rows])
        spread, expected, low, high = (np.zeros(self.size) for _ in range(4))
        for term, at in self.at.items():
            likely = term.form.plausibility
            spread[at], expected[at] = likely.spread(data.signals[0], term.place), likely.prior_mean
            low[at], high[at] = likely.limits(self.ratings.of(term), term.shape)
        beside = list(self.fixed.values())
        spread[beside], expected[beside], low[beside], high[beside] = np.inf, 1.0, 1.0, 1.0
        for term, values in self.store.pins.items():
            if term in self.at:
                low[self.at[term]] = high[self.at[term]] = values
        prior = 1.0 / spread**2 + 1e-9 * power + (power == 0.0)
        raw = totals.sum(1) / np.maximum(counts.sum(1), 1e-300)
        return LinearTerms(
            np.zeros(self.size), acting, squares, products, totals, counts, raw + floor**2, floor,
            np.zeros(self.size), prior, expected, low, high,
        )  # fmt: skip

    def index(self, terms: Sequence[Term]) -> NDArray[np.intp]:
        """Indices of the terms' coefficients, then of the columns beside them (`fixed`)."""
        beside = [np.array([self.fixed[term]]) for term in terms if term in self.fixed]
        return np.concatenate([*(self.at[term] for term in terms), *beside, np.zeros(0, np.intp)]).astype(np.intp)

    def effects(self, usual: Collection[str] = ()) -> dict[Term, Effect[Term]]:
        """Every term as an effect of the choice; those that are `usual` on this arm are not charged for being rare."""
        forms: dict[Key, set[Term]] = {}
        for term in self.terms:
            forms.setdefault(term.key, set()).add(term)
        out = {}
        for term in self.terms:
            gone = {term.key, *term.form.hints.covers(self.layout, term.place)}
            excluded = frozenset(other for key in gone for other in forms.get(key, ()) if other != term)
            needs, simpler = (
                tuple(other for key in keys for other in forms.get(key, ()))
                for keys in (term.beneath, term.form.hints.alternatives(self.layout, term.place, term.shape))
            )
            likely = term.form.plausibility
            price = 0.0 if likely.every_joint else self.price(term, rare=term.effect not in usual)
            numbers = tuple(self.index([term]).tolist())
            out[term] = Effect(term, numbers, needs, price=price, excludes=excluded, simpler=simpler)
        return out

    def price(self, term: Term, rare: bool = True) -> float:
        """Price of a term: of its effective coefficients, its shape but for numbers of joints, and of being rare."""
        form = term.form
        shape = sum(i not in form.hints.discrete for i in range(len(term.shape))) * (form.hints.linearised_at is None)
        return PRICE * (self.linear.freedom(self.at[term].tolist()) + shape + rare * form.plausibility.prior_penalty)

    def log_squares(self, change: Array) -> float:
        """Σ ½ log(R² + floor²) over the rows, R² the mean square that terms with these coefficients (P,) leave."""
        squares = self.linear.mean_squares(change) + self.linear.floor**2
        return float(0.5 * np.log(squares)[self.seen].sum())

    def fitted(self) -> dict[Term, Array]:
        """Coefficients of a fit of all terms, the rows weighed by what it leaves."""
        every = self.index(self.terms).tolist()
        change = self.linear.reweighed(every).fit(every)
        return {term: change[at] for term, at in self.at.items()}

    @property
    def measurements(self) -> float:
        """Independent measurements of the row with most."""
        return float(self.linear.counts.sum(1).max(initial=0.0))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Rows that are looked at, (R,)."""
        return np.asarray(self.linear.counts.sum(1) > 0.0)


class TermChoice(EffectChoice[Term]):
    """A choice among the terms of some equations; it begins with what every joint has."""

    def __init__(
        self,
        equations: TermEquations,
        current: Sequence[Term] = (),
        usual: frozenset[str] = frozenset(),
        least: float = 0.0,
    ) -> None:
        self.equations, self.usual = equations, usual
        every = [term for term in equations.terms if term.form.plausibility.every_joint and term not in current]
        super().__init__(equations.linear, equations.effects(usual), [*current, *every], least)
        self.others: list[tuple[float, list[Term]]] = []
        """Terms at which searches ended that began elsewhere, and how much worse they score."""

    def judge(self, names: Sequence[Term]) -> float:
        """As of any choice; infinite for a body that is farther from the tip than its own mass allows."""
        change: Array | None = None
        for term in names:
            if term.form.signature.body:
                change = self.terms.fit(self.free(names)) if change is None else change
                c = change[self.equations.at[term]]
                rated = replace(self.equations.ratings.of(term), own=c)
                low, high = term.form.plausibility.limits(rated, term.shape)
                if np.any(c < low) or np.any(c > high):
                    return float("inf")
        return super().judge(names)

    def loss(self, score: float) -> float:
        """By how much a score is worse than that of the terms chosen, per independent measurement; zero if these end at
        a bound, for then they explain nothing."""
        return (score - self.score) / self.equations.measurements if np.isfinite(self.score) else 0.0

    def values(self, terms: Sequence[Term] | None = None) -> dict[Term, Array]:
        """Coefficients of a fit of some terms, of those chosen if none are given."""
        terms = self.current if terms is None else terms
        change = self.terms.fit(self.free(terms))
        return {term: change[self.equations.at[term]] for term in terms}


class Rated:
    """Ratings of every joint of an arm, from the nominal model, the recordings and an estimate."""

    def __init__(self, data: ResidualSet, values: Mapping[Term, Array]) -> None:
        arm, of_motor = data.signals[0].arm, float(data.layout.motor is not None)
        self.values = {term.key: c for term, c in values.items()}
        self.joint = of_motor * np.stack([arm.frictionloss, arm.damping, arm.armature])
        """Friction, damping and armature of the nominal model, (3, n): a sensor on the link reads none of them."""
        self.speed = np.sqrt(np.mean([np.mean(s.v**2, axis=0) for s in data.signals], axis=0))
        parts = [np.abs(s.model).max(0) + np.abs([*s.reading.values()]).max((0, 1)) for s in data.signals]
        self.torque = np.asarray(np.max(parts, axis=0))
        self.tip_mass, self.mass = float(arm.inertial[-1, 0]), float(arm.inertial[:, 0].sum())

    def of(self, term: Term) -> Ratings:
        friction, damping, armature = self.joint[:, term.place].tolist()
        torque = float(self.torque[term.place])
        found = self.values.get(("friction.coulomb", term.place))
        dry = torque if found is None else max(friction + float(found[0]), 0.0)
        speed = float(self.speed[term.place])
        own = self.values.get(term.key)
        return Ratings(friction, damping, armature, speed, torque, self.tip_mass, self.mass, dry, own)
