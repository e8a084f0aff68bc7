"""Test of causes against general laws (effects/laws.py), which represent effects that the library lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.laws import LAWS
from sim_gap.residuals.layout import ChannelLayout
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice, TermEquations

CONTAINED = 1e-6
"""A cause is a case of a law if at most this share of the power of its columns is outside the span of the law's."""

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
        laws = [law for law in self.laws if not self._holds(law, own)]
        for law in choice.shortlist(rest, laws, TRIED):
            beside = [term for term in rest if term.place == law.place and not term.form.signature.whole_arm]
            worse = choice.loss(choice.judge(choice.pruned([*rest, law], beside)))
            best = min(best, StandIn(worse, law.effect), key=lambda each: each.worse)
        return best

    def _holds(self, law: Term, own: Sequence[Term]) -> bool:
        """Whether these terms are of the law's own family and a case of it: then both say the same."""
        equations, linear = self.choice.equations, self.choice.terms
        family = LAWS[law.effect].family
        if any(_family(term, equations.layout) != family for term in own):
            return False
        at, of = equations.at[law], np.concatenate([equations.at[term] for term in own])
        law_gram, across, power = np.zeros((len(at), len(at))), np.zeros((len(at), len(of))), np.zeros(len(of))
        for variance, index, square in zip(linear.variance, linear.acting, linear.squares, strict=True):
            place = np.full(equations.size, -1)
            place[index] = np.arange(len(index))
            whole, ours, theirs = square.sum(0) / variance, place[at], place[of]
            shown = np.flatnonzero(theirs >= 0)
            power[shown] += np.diagonal(whole)[theirs[shown]]
            if ours[0] >= 0:
                law_gram += whole[np.ix_(ours, ours)]
                across[:, shown] += whole[np.ix_(ours, theirs[shown])]
        return bool(np.all(power - _explained(law_gram, across) <= CONTAINED * power))


def _family(term: Term, layout: ChannelLayout) -> str:
    """Family of a cause: without a torque sensor, an offset of the torque is the drive's."""
    return "actuator" if layout.sensor is None and term.effect == "torque.offset" else term.effect.split(".")[0]


def _explained(gram: Array, across: Array) -> Array:
    """Power of each of q columns in the span of p others with Gram matrix (p, p) and products `across` (p, q); (q,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    inverse = np.linalg.pinv(gram * scale * scale[:, None], rcond=1e-12, hermitian=True) * scale * scale[:, None]
    return np.asarray(np.einsum("ij,ik,kj->j", across, inverse, across))
