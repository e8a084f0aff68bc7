"""Stepwise selection of effects by their cross-validated score and a price per parameter."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Key
from sim_gap.search.normal_equations import CORRELATED, NormalEquations, Weighted
from sim_gap.search.term import Term

Scored = tuple[float, list[Term]]
"""Score of a set of terms, lower is better, and the terms."""

MOST_TERMS = 60
"""Largest number of terms of a fit."""
TRIES = 3
"""How often one effect at one place may be added during a search."""
OWED = 0.06
"""Score by which an effect must be better than its simpler alternatives, if it needs some of them in addition."""
BESIDE = 0.3
"""Size of these, as a share of its own, from which it needs them."""
MUCH = 3.0
"""Residual of a fit, in units of the relevance floor, from which the search is started again elsewhere."""


@dataclass
class StepwiseSearch:
    """Stepwise search over one set of normal equations."""

    normal: NormalEquations
    active: list[Term] = field(default_factory=list)
    added: Counter[Key] = field(default_factory=Counter)
    """How often each effect and place was added, which bounds the search."""
    least: float = 1e-4
    """Least improvement of the score by a term that is added."""
    usual: frozenset[str] = frozenset()
    """Effects that this arm is known to have: the question is how large they are, and they are not charged for."""
    undone: set[frozenset[Term]] = field(default_factory=set)
    """Sets of terms that a step came to and that turned out to be no better once the rows were weighed by them."""

    def __post_init__(self) -> None:
        self.reweigh()

    def reweigh(self) -> None:
        """Weigh the rows by the residual of the active terms, iterated until weights and fit agree."""
        mean_square = self.normal.square.sum(0) / np.maximum(self.normal.count.sum(0), 1.0)
        for _ in range(3):
            self.weighted = Weighted(self.normal, mean_square)
            mean_square = self.normal.mean_square(*self.weighted.fit(self.active))
        self.active = self.possible(self.active)
        self.score = self.judge(self.active)

    def judge(self, terms: Sequence[Term]) -> float:
        """Σ ½ log(cross-validated R² + floor²) over the rows, plus the price of the terms; lower is better."""
        normal = self.normal
        if self._implausible(terms):
            return float("inf")
        squares = self.weighted.cross_validated(terms)
        fit = 0.5 * np.log(squares + normal.floor**2)[normal.seen].sum()
        return float(fit + normal.price * sum(self.cost(term) for term in terms))

    def possible(self, terms: list[Term]) -> list[Term]:
        """The terms less those with implausible coefficients, removed one after the other."""
        while wrong := self._implausible(terms):
            terms = self.without(wrong, terms)
        return terms

    def _implausible(self, terms: Sequence[Term]) -> Term | None:
        return next(impossible_terms(self.normal, terms, self.weighted.fit(terms)[1]), None) if terms else None

    def accept(self, chosen: list[Term], simpler: bool = False) -> bool:
        """Continue with these terms, unless they are worse than those before; true, for a step was tried.

        A term that cannot exist beside a new one may do so with another shape: a limit beside a lag. Terms that are
        `simpler` are kept though they are a little worse.
        """
        before = self.active, self.weighted, self.score
        self.added.update(term.key for term in chosen if term not in self.active)
        self.active = chosen
        self.reweigh()
        lost = {term.key for term in before[0] if term in chosen and term not in self.active}
        self.take_back(lost)
        if self.score >= before[2] and not simpler:
            self.undone.add(frozenset(chosen))
            self.active, self.weighted, self.score = before
        return True

    def take_back(self, lost: Collection[Key]) -> None:
        """Add effects that got lost again, with the best of their shapes, if that helps.

        Each is weighed by itself: with the rows weighed by what is left without it, it may seem impossible.
        """
        for key in lost:
            shapes = [term for term in self.normal.terms if term.key == key]
            trials = [
                StepwiseSearch(self.normal, self.with_beneath(term, self.active), usual=self.usual) for term in shapes
            ]
            best = min(trials, key=lambda trial: trial.score, default=self)
            if best.score < self.score:
                self.active, self.weighted, self.score = best.active, best.weighted, best.score

    def cost(self, term: Term) -> float:
        """Number of parameters that a term is charged for: effective coefficients, shape, and its prior penalty."""
        form = term.form
        shape = len(term.shape) * (form.hints.linearised_at is None)
        free = term.effect in self.usual
        return 0.0 if free else self.normal.freedom(term) + shape + form.plausibility.prior_penalty

    def after_price(self, screened: Sequence[tuple[float, Term]]) -> list[tuple[float, Term]]:
        """Screened candidates by how far each may lower the score, less its price, best first.

        By what they take alone, dear ones would keep cheap ones that earn more out of a shortlist.
        """
        normal = self.normal
        to_score = 0.5 * CORRELATED / max(float(normal.count.sum(0).max(initial=0.0)), 1.0)
        net = [(to_score * fall - normal.price * self.cost(term), term) for fall, term in screened]
        return sorted(net, key=lambda pair: -pair[0])

    def with_beneath(self, term: Term, terms: Sequence[Term]) -> list[Term]:
        """`terms` plus `term` plus what it needs; another shape of the same effect at that place is replaced."""
        gone = {term.key, *term.covers(self.normal.layout)}
        kept = [other for other in terms if other.key not in gone and term.key not in other.covers(self.normal.layout)]
        have = {other.key for other in kept}
        missing = [other for other in self.normal.terms if other.key in term.beneath and other.key not in have]
        return [*kept, *missing, term]

    def without(self, term: Term, terms: Sequence[Term]) -> list[Term]:
        """`terms` less `term` and what needs it."""
        return [other for other in terms if other != term and term.key not in other.beneath]

    def forward(self) -> bool:
        """Add the term that helps most, if any earns its place."""
        active = {*self.active}
        inactive = [term for term in self.normal.terms if term not in active and self.added[term.key] < TRIES]
        screened, judged = self.weighted.screen(self.active, inactive), list[Scored]()
        lists = [screened, self.after_price(screened)]
        while lists[0] and not any(np.isfinite(score) for score, _ in judged):  # the most promising may be impossible
            first = list(dict.fromkeys(term for each in lists for _, term in shortlist(each)))
            judged = list(self._judged(self.with_beneath(term, self.active) for term in first))
            tried = {term.key for term in first}
            lists = [[pair for pair in each if pair[1].key not in tried] for each in lists]
        chosen = self._best(judged, self.score - self.least)
        return chosen is not None and len(chosen) <= MOST_TERMS and self.accept(chosen)

    def backward(self) -> bool:
        """Drop the term that is missed least, if the rest scores better without it."""
        trials = (self.without(term, self.active) for term in self.active)
        chosen = self._best(self._judged(trials), self.score)
        return chosen is not None and self.accept(chosen)

    def swap(self) -> bool:
        """Exchange one term for another that scores better in its place."""
        chosen = self._best(self._judged(self._exchanges()), self.score - max(1e-3, self.least))
        return chosen is not None and self.accept(chosen)

    def dissolve(self) -> bool:
        """Exchange one term for its simpler alternatives, if they score as well."""
        chosen = self._best(self._dissolved(), self.score - 1e-3)
        return chosen is not None and self.accept(chosen, simpler=True)

    def _exchanges(self) -> Iterator[list[Term]]:
        for term in list(self.active):
            rest = self.without(term, self.active)
            used = {*rest, term}
            inactive = [other for other in self.normal.terms if other not in used and self.added[other.key] < TRIES]
            for _, other in shortlist(self.after_price(self.weighted.screen(rest, inactive)))[:4]:
                yield self.with_beneath(other, rest)

    def _dissolved(self) -> Iterator[Scored]:
        for term in self.active:
            parts = term.alternatives(self.normal.layout)
            if not parts:
                continue
            rest = self.without(term, self.active)
            have = {other.key for other in rest}
            new = [other for other in self.normal.terms if other.key in parts and other.key not in have]
            score, trial = self.pruned([*rest, *new], new)
            yield score - self.advantage_owed(term), trial

    def _judged(self, trials: Iterable[list[Term]]) -> Iterator[Scored]:
        for trial in trials:
            yield float("inf") if frozenset(trial) in self.undone else self.judge(trial), trial

    @staticmethod
    def _best(scored: Iterable[Scored], bound: float) -> list[Term] | None:
        """The trial with the lowest score below a bound; None if there is none."""
        best, chosen = bound, None
        for score, trial in scored:
            if score < best:
                best, chosen = score, trial
        return chosen

    def leaves_much(self, term: Term) -> bool:
        """Whether the residual of a row that the term touches exceeds MUCH times its relevance floor."""
        normal = self.normal
        left = np.sqrt(normal.mean_square(*self.weighted.fit(self.active)))
        touched = np.array([np.all(block.position[normal.at[term]] >= 0) for block in normal.blocks])
        return bool(np.any(left[touched & normal.seen] > MUCH * normal.floor[touched & normal.seen]))

    def pruned(self, terms: list[Term], doubtful: Sequence[Term]) -> tuple[float, list[Term]]:
        """Score and terms after dropping those of the doubtful ones that do not earn their place."""
        best, kept = self.judge(terms), terms
        while True:
            trials = [self.without(term, kept) for term in doubtful if term in kept]
            scored = [(self.judge(trial), i) for i, trial in enumerate(trials)]
            if not scored or min(scored)[0] >= best:
                return best, kept
            best, kept = min(scored)[0], trials[min(scored)[1]]

    def advantage_owed(self, term: Term) -> float:
        """Score by which a term must be better than its alternatives, if some of them are needed beside it."""
        parts = term.alternatives(self.normal.layout)
        beside = [other for other in self.active if other.key in parts]
        if not beside or not term.form.signature.whole_arm:
            return 0.0
        own = self.normal.size_of(term, *self.weighted.fit(self.active))
        others = [self.normal.size_of(other, *self.weighted.fit(self.active)) for other in beside]
        return OWED if any(np.any(size > BESIDE * own) for size in others) else 0.0

    def run(self) -> list[Term]:
        """Forward and backward steps until none helps, then exchanges, then again."""
        for _ in range(4):
            while self.forward():
                while self.backward():
                    pass
            while self.backward():
                pass
            dissolved = self.dissolve()
            if not self.swap() and not dissolved:
                break
        return self.active


def impossible_terms(normal: NormalEquations, terms: Sequence[Term], coefficients: Array) -> Iterator[Term]:
    """Those of the terms that cannot exist with their coefficients of a fit (`Weighted.fit`)."""
    ends = np.cumsum([len(normal.at[term]) for term in terms])
    values = {term.key: piece for term, piece in zip(terms, np.split(coefficients, ends)[:-1], strict=True)}
    needed = {key for term in terms for key in term.beneath}
    for term in terms:
        beneath = {name: values[name, place] for name, place in term.beneath}
        beneath["nominal"] = normal.known_joint[term.place]
        beneath["tip"] = normal.tip_mass
        beneath["needed"] = np.array([float(term.key in needed)])
        if not term.form.plausibility.allows(values[term.key], term.shape, beneath):
            yield term


def shortlist(screened: list[tuple[float, Term]]) -> list[tuple[float, Term]]:
    """The first few terms, no effect at one place more than twice."""
    seen: dict[Key, int] = {}
    out = []
    for fall, term in screened:
        seen[term.key] = seen.get(term.key, 0) + 1
        if seen[term.key] <= 2:
            out.append((fall, term))
        if len(out) == 10:
            break
    return out
