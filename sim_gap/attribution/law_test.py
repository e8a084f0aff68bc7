"""Test of causes against general laws (effects/laws.py), which represent effects that the library lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_gap.effects.laws import LAWS
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice, TermEquations

TRIED = 3
"""Laws that are tried in place of a cause."""


@dataclass(frozen=True)
class StandIn:
    worse: float
    """How much worse it scores, per independent measurement: ½ log of the mean square summed over the rows; negative is
    better, infinite without a law."""
    law: str
    """Its id; empty without a law."""


class LawTest:
    def __init__(self, store: ColumnStore, chosen: Sequence[Term]) -> None:
        layout = store.data.layout
        offered = [Term(name, place) for name, law in LAWS.items() for place in law.signature.places(layout)]
        self.choice = TermChoice(TermEquations(store, [*chosen, *offered]), chosen)
        self.laws = [law for law in offered if law in self.choice.effects]

    def best_law(self, terms: Sequence[Term]) -> StandIn:
        """The law that could best replace these terms.

        Either one law replaces all of them, or each term has its own: then the term with the worst replacement counts.
        """
        own = [term for term in self.choice.current if term in terms]
        apart = [self._instead([term]) for term in own]
        found = [max(apart, key=lambda each: each.worse)] if apart else [StandIn(np.inf, "")]
        return min([*found, self._instead(own)] if len(own) > 1 else found, key=lambda each: each.worse)

    def _instead(self, own: Sequence[Term]) -> StandIn:
        """The best law in place of these terms and of others at its joint that are then not missed."""
        choice, best = self.choice, StandIn(np.inf, "")
        rest = choice.current
        for term in own:
            rest = choice.without(term, rest)
        laws = [law for law in self.laws if not all(self._is_case(term, law) for term in own)]
        for law in choice.shortlist(rest, laws, TRIED):
            beside = [term for term in rest if term.place == law.place and not term.form.signature.whole_arm]
            worse = choice.loss(choice.judge(choice.pruned([*rest, law], beside)))
            best = min(best, StandIn(worse, law.effect), key=lambda each: each.worse)
        return best

    def _is_case(self, term: Term, of: Term) -> bool:
        """Whether a term is a case of a law: then both say the same."""
        layout, law = self.choice.equations.layout, LAWS[of.effect]
        place = layout.n - 1 if term.form.signature.body else term.place
        more = law.without_sensor if layout.sensor is None else law.with_sensor
        return term.effect in law.cases | more and place == of.place and not term.bound
