"""Which effects: every term of the library competes, judged on motion left out of its fit, at a price per parameter."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sim_gap.effects.registry import effects
from sim_gap.search.normal_equations import Normal, Term, Weighted

SHORTLIST = 10
MOST_TERMS = 60
TRIES = 3
"""How often one effect at one place may come in during a search."""
OWED = 0.06
"""What an effect must do better by than the simpler ones it is made of, where it needs some of these besides."""
MUCH = 3.0
"""What a fit leaves, in units of what is not worth explaining, from which on another start of the search is tried."""
BESIDE = 0.3
"""Size of these, as a share of its own, from which it needs them."""


@dataclass
class Search:
    """Stepwise search over one set of normal equations."""

    normal: Normal
    active: list[Term] = field(default_factory=list)
    added: Counter[tuple[str, int]] = field(default_factory=Counter)
    """How often each effect and place came in, so that nothing goes in and out for ever."""

    def __post_init__(self) -> None:
        self.reweigh()

    def reweigh(self) -> None:
        """Weigh rows by what the active terms leave, twice, so that weights and fit agree."""
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
        """The terms less those whose coefficients no such effect can have, one after the other."""
        while wrong := self._implausible(terms):
            terms = self.without(wrong, terms)
        return terms

    def _implausible(self, terms: Sequence[Term]) -> Term | None:
        """The first of the terms whose coefficients no such effect can have."""
        ends = np.cumsum([len(self.normal.at[term]) for term in terms])
        pieces = np.split(self.weighted.fit(terms)[1], ends[:-1]) if terms else []
        values = {term.key: piece for term, piece in zip(terms, pieces, strict=True)}
        for term in terms:
            beneath = {name: values[name, place] for name, place in term.beneath}
            beneath["nominal"] = self.normal.known_friction[term.place, None]
            if not effects()[term.effect].plausible_on(values[term.key], term.shape, beneath):
                return term
        return None

    def accept(self, chosen: list[Term]) -> None:
        """Go on with these terms."""
        self.added.update(term.key for term in chosen if term not in self.active)
        self.active = chosen
        self.reweigh()

    def cost(self, term: Term) -> float:
        """Coefficients that can show and shape parameters of a term, and what a rare effect must earn besides."""
        effect = effects()[term.effect]
        return self.normal.freedom(term) + len(term.shape) * (not effect.secant) + effect.rare

    def with_beneath(self, term: Term, terms: Sequence[Term]) -> list[Term]:
        """`terms` plus `term` plus what it stands upon; another shape of the same effect there gives way."""
        gone = {term.key, *term.covers(self.normal.layout)}
        kept = [other for other in terms if other.key not in gone and term.key not in other.covers(self.normal.layout)]
        have = {other.key for other in kept}
        missing = [other for other in self.normal.terms if other.key in term.beneath and other.key not in have]
        return [*kept, *missing, term]

    def without(self, term: Term, terms: Sequence[Term]) -> list[Term]:
        """`terms` less `term` and what stands upon it."""
        return [other for other in terms if other != term and term.key not in other.beneath]

    def forward(self) -> bool:
        """Add the term that helps most, if any earns its place."""
        inactive = [term for term in self.normal.terms if term not in self.active and self.added[term.key] < TRIES]
        best, chosen = self.score - 1e-4, None
        for _, term in shortlist(self.weighted.screen(self.active, inactive)):
            trial = self.with_beneath(term, self.active)
            score = self.judge(trial)
            if score < best:
                best, chosen = score, trial
        if chosen is None or len(chosen) > MOST_TERMS:
            return False
        self.accept(chosen)
        return True

    def backward(self) -> bool:
        """Drop the term that is missed least, if the rest does better without it."""
        best, chosen = self.score, None
        for term in self.active:
            trial = self.without(term, self.active)
            score = self.judge(trial)
            if score < best:
                best, chosen = score, trial
        if chosen is None:
            return False
        self.accept(chosen)
        return True

    def swap(self) -> bool:
        """Exchange one term for another that does better in its stead."""
        best, chosen = self.score - 1e-3, None
        for term in list(self.active):
            rest = self.without(term, self.active)
            inactive = [
                other
                for other in self.normal.terms
                if other not in rest and other != term and self.added[other.key] < TRIES
            ]
            for _, other in shortlist(self.weighted.screen(rest, inactive))[:4]:
                trial = self.with_beneath(other, rest)
                score = self.judge(trial)
                if score < best:
                    best, chosen = score, trial
        if chosen is None:
            return False
        self.accept(chosen)
        return True

    def dissolve(self) -> bool:
        """Exchange one term for the simpler effects that it could be made of, where those do as well."""
        best, chosen = self.score - 1e-3, None
        for term in self.active:
            parts = effects()[term.effect].made_of(self.normal.layout, term.place, term.shape)
            if not parts:
                continue
            rest = self.without(term, self.active)
            have = {other.key for other in rest}
            new = [other for other in self.normal.terms if other.key in parts and other.key not in have]
            score, trial = self.pruned([*rest, *new], new)
            if score - self.owed(term) < best:
                best, chosen = score - self.owed(term), trial
        if chosen is None:
            return False
        self.accept(chosen)
        return True

    def leaves_much(self, term: Term) -> bool:
        """Whether a row that the term touches is left with more than a few times what is not worth explaining."""
        normal = self.normal
        left = np.sqrt(normal.mean_square(*self.weighted.fit(self.active)))
        touched = np.array([np.all(block.position[normal.at[term]] >= 0) for block in normal.blocks])
        return bool(np.any(left[touched & normal.seen] > MUCH * normal.floor[touched & normal.seen]))

    def pruned(self, terms: list[Term], doubtful: Sequence[Term]) -> tuple[float, list[Term]]:
        """Score and terms after dropping of the doubtful ones those that do not earn their place."""
        best, kept = self.judge(terms), terms
        while True:
            trials = [self.without(term, kept) for term in doubtful if term in kept]
            scored = [(self.judge(trial), i) for i, trial in enumerate(trials)]
            if not scored or min(scored)[0] >= best:
                return best, kept
            best, kept = min(scored)[0], trials[min(scored)[1]]

    def owed(self, term: Term) -> float:
        """What a term must do better by than its parts, where some of these are needed beside it."""
        parts = effects()[term.effect].made_of(self.normal.layout, term.place, term.shape)
        beside = [other for other in self.active if other.key in parts]
        if not beside or not effects()[term.effect].whole_arm:
            return 0.0
        own = self.normal.size_of(term, *self.weighted.fit(self.active))
        others = [self.normal.size_of(other, *self.weighted.fit(self.active)) for other in beside]
        return OWED if any(np.any(size > BESIDE * own) for size in others) else 0.0

    def run(self) -> list[Term]:
        """Forward and backward until nothing helps, then exchanges, then again."""
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


def shortlist(screened: list[tuple[float, Term]]) -> list[tuple[float, Term]]:
    """The first few, no effect at one place more than twice."""
    seen: dict[tuple[str, int], int] = {}
    out = []
    for fall, term in screened:
        seen[term.key] = seen.get(term.key, 0) + 1
        if seen[term.key] <= 2:
            out.append((fall, term))
        if len(out) == SHORTLIST:
            break
    return out
