"""Choice of effects among hundreds of candidates: forward, backward and by exchange, until no step pays any more.

A step is tried where a first look promises most, and the scale of the channels follows from what is left after it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Generic

import numpy as np

from gcomp.estimate.linear_terms import Effect, LinearTerms, Name, price_of

SHORTLIST, EXCHANGED, PAIRED = 12, 4, 4
"""Candidates that are tried in a step, in place of an effect that is there, and together with another one where none
pays alone: those that promise most beyond their price."""
MOST_EFFECTS = 60
"""Largest number of effects of a choice."""
AS_GOOD = 1e-3
"""Fall of the cost that is none."""
ROUNDS = 4
"""Times that steps and exchanges follow one another."""


class EffectChoice(Generic[Name]):
    """The effects `current` of those offered, and steps to better ones."""

    def __init__(
        self,
        terms: LinearTerms,
        effects: Mapping[Name, Effect[Name]],
        current: Iterable[Name] = (),
        least: float = 0.0,
        kept: Iterable[Name] = (),
    ) -> None:
        """`least` is the fall of the score that an effect has to bring which is added or exchanged; effects `kept` are
        never taken out."""
        self.plain, self.effects, self.least = terms, effects, max(least, AS_GOOD)
        self.worse = set[frozenset[Name]]()
        self._take([name for name in current if name in effects])
        self.kept = frozenset(kept).intersection(self.current)

    def _take(self, names: list[Name]) -> None:
        self.current = names
        self.terms = self.plain.reweighed(self.free(names))
        self.score = self.judge(names)

    def free(self, names: Iterable[Name]) -> frozenset[int]:
        return frozenset(k for name in names for k in self.effects[name].parameters)

    def price(self, names: Iterable[Name]) -> float:
        return sum(price_of(self.effects[name]) for name in names)

    def judge(self, names: Sequence[Name]) -> float:
        """Negative logarithm of the held-out likelihood plus the price of the effects; less is better.

        Infinite if an effect with a price ends at a bound: what is not that effect would have it impossible.
        """
        free = self.free(names)
        at = {*self.terms.at_bounds(self.terms.fit(free)).tolist()} & free
        if at and any(at & {*self.effects[n].parameters} and price_of(self.effects[n]) > 0.0 for n in names):
            return float("inf")
        return float(self.terms.cost(free).sum()) + self.price(names)

    def with_needs(self, name: Name, names: Sequence[Name]) -> list[Name]:
        """These effects, one more and what it needs; what it excludes gives way."""
        effect = self.effects[name]
        kept = [n for n in names if n != name and n not in effect.excludes and name not in self.effects[n].excludes]
        return [*kept, *(need for need in effect.needs if need not in kept and need in self.effects), name]

    def without(self, name: Name, names: Sequence[Name]) -> list[Name]:
        """These effects less one and those that need it."""
        return [n for n in names if n != name and name not in self.effects[n].needs]

    def shortlist(self, names: Sequence[Name], offered: Sequence[Name], most: int) -> list[Name]:
        """Those that promise most beside `names` beyond their price; of the forms of one effect at most two."""
        falls = self.terms.promises(self.free(names), [self.effects[n].parameters for n in offered])
        net = falls - [price_of(self.effects[n]) for n in offered]
        taken = list[Name]()
        for k in np.argsort(-net).tolist():
            if len(taken) == most:
                break
            if sum(other in self.effects[offered[k]].excludes for other in taken) < 2:
                taken.append(offered[k])
        return taken

    def _rest(self, names: Iterable[Name]) -> list[Name]:
        there = {*names}
        return [name for name in self.effects if name not in there]

    def step(self, trials: Iterable[Sequence[Name]], bound: float, rise: float = 0.0) -> bool:
        """Go on with the best of some sets whose score is below a bound, unless the score is no better, or rises by
        `rise` and more, once the channels are weighed by what it leaves; whether there was one."""
        best: Sequence[Name] | None = None
        for trial in trials:
            if frozenset(trial) not in self.worse and len(trial) <= MOST_EFFECTS:
                score = self.judge(trial)
                if score < bound:
                    best, bound = trial, score
        if best is None:
            return False
        before = self.current, self.terms, self.score
        self._take(list(best))
        if self.score >= before[2] + rise:
            self.worse.add(frozenset(best))
            self.current, self.terms, self.score = before
        return True

    def forward(self) -> bool:
        """Add the effect that helps most, if any pays."""
        offered = self._rest(self.current)
        names = self.shortlist(self.current, offered, SHORTLIST) if offered else []
        return self.step((self.with_needs(name, self.current) for name in names), self.score - self.least)

    def backward(self) -> bool:
        """Take the effect out that is missed least, if the rest scores as well without it."""
        trials = (self.without(name, self.current) for name in self.current)
        return self.step((each for each in trials if self.kept <= {*each}), self.score + AS_GOOD, AS_GOOD)

    def exchange(self) -> bool:
        """Put one effect in the place of another, or simpler ones together in that of one, if that scores better."""
        return self.step(self._exchanged(), self.score - self.least)

    def _exchanged(self) -> Iterator[list[Name]]:
        for name in [each for each in self.current if self.kept <= {*self.without(each, self.current)}]:
            rest = self.without(name, self.current)
            offered = self._rest([*rest, name])
            for other in self.shortlist(rest, offered, EXCHANGED) if offered else ():
                yield self.with_needs(other, rest)
            parts = [n for n in self.effects[name].simpler if n in self.effects and n not in rest]
            if parts:
                yield self.pruned([*rest, *parts], parts)

    def pair(self) -> bool:
        """Add two effects of which neither pays without the other, such as friction that grows with a load beside a
        mass that the model lacks."""
        return self.step(self._pairs(), self.score - 2.0 * self.least)

    def _pairs(self) -> Iterator[list[Name]]:
        offered = self._rest(self.current)
        for name in self.shortlist(self.current, offered, PAIRED) if offered else ():
            more = self.with_needs(name, self.current)
            rest = [n for n in self._rest(more) if n not in self.effects[name].excludes]
            for other in self.shortlist(more, rest, PAIRED) if rest else ():
                yield self.with_needs(other, more)

    def pruned(self, names: Sequence[Name], doubtful: Sequence[Name]) -> list[Name]:
        """These effects without those of the doubtful ones that do not pay."""
        best, kept = self.judge(names), list(names)
        while True:
            trials = [self.without(name, kept) for name in doubtful if name in kept]
            scores = [self.judge(trial) for trial in trials]
            if not scores or min(scores) >= best:
                return kept
            best, kept = min(scores), trials[int(np.argmin(scores))]

    def run(self) -> list[Name]:
        """Forward and backward steps until none helps, then exchanges, then again."""
        for _ in range(ROUNDS):
            while self.forward():
                while self.backward():
                    pass
            while self.backward():
                pass
            if not self.exchange() and not self.pair():
                break
        return self.current
