"""Rivals of a cause: other effects that explain the recordings as well, and the motion that would separate them.

General laws (effects/registry.py) represent effects that the library lacks: a cause is tested against them, too.
"""

from collections.abc import Sequence
from functools import cached_property
from operator import itemgetter

import numpy as np

from gcomp.estimate.choice import AS_GOOD as NO_FALL
from gcomp.estimate.linear_terms import PRICE
from sim_gap.effects.registry import LAWS
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.gauss_newton import converge
from sim_gap.search.term import Term
from sim_gap.search.term_equations import MOST_MEASUREMENTS, TermChoice, TermEquations

AS_GOOD = 3.0 * PRICE / MOST_MEASUREMENTS
"""A rival is as good if its score, per independent measurement, is worse by no more than this: the price of three
coefficients of a long recording, for the background of every arm can favour either by that much."""
BARE = AS_GOOD / 3.0
"""A cause that brings no more than the price of a coefficient has as a rival any effect that brings some of it."""
NEAR = 0.3
"""A rival within this is fitted about itself, if the columns of either depend on the other."""
TRIED, LAWS_TRIED = 4, 3
"""Number of rivals, and of laws, tried in place of a term: the best of a first screening."""
SEPARATING_MOTION = {
    frozenset(
        {"friction.coulomb", "friction.load"}
    ): "record both directions at the same speed under clearly different loads (stretched out, folded, with a payload)",
    frozenset(
        {"friction.coulomb", "friction.stribeck"}
    ): "record constant speeds from creeping to fast, in both directions",
    frozenset({"friction.coulomb", "friction.viscous"}): "record constant speeds from slow to fast, in both directions",
    frozenset(
        {"friction.asymmetric", "torque.offset"}
    ): "record a rest under a known load, and motion in both directions under several loads",
    frozenset({"actuator.gain", "link.mass_moment"}): "record the same poses with a known payload attached",
    frozenset({"actuator.gain", "link.payload"}): "record the same poses with a known payload attached",
    frozenset({"torque.gain", "link.payload"}): "record the same poses with and without the payload",
    frozenset({"torque.gain", "link.mass_moment"}): "record the same poses with a known payload attached",
    frozenset({"actuator.lag", "actuator.delay"}): "record steps or a chirp up to 10 Hz at a high rate",
    frozenset({"transmission.backlash", "transmission.elasticity"}): "record slow reversals under load",
    frozenset({"transmission.elasticity", "actuator.rotor_inertia"}): "record fast motion with a payload",
    frozenset(
        {"position.offset", "base.tilt"}
    ): "record a turn of joint 1 with the arm stretched out, and measure the tilt of the base with a level",
    frozenset({"position.offset", "link.mass_moment"}): "record the same motion with a known payload attached",
    frozenset(
        {"actuator.rotor_inertia", "link.inertia"}
    ): "record fast motion of the joint with the links beyond it stretched out and folded",
    frozenset({"torque.hysteresis", "friction.coulomb"}): "record a slow change of load with the joint at rest",
}
GENERAL_MOTION = (
    "record each joint alone through its whole range, slow and fast, in both directions, with the other "
    "joints in two poses"
)


def separating_motion(effect: str, rivals: Sequence[str]) -> str | None:
    """A motion to record so that an effect and the first of its rivals differ; None without a rival."""
    return SEPARATING_MOTION.get(frozenset({effect, rivals[0]}), GENERAL_MOTION) if rivals else None


class Rivals:
    def __init__(self, choice: TermChoice) -> None:
        self.choice = choice

    def weigh(self, effect: str, terms: Sequence[Term]) -> tuple[float, tuple[str, ...]]:
        """Score lost without a cause at the place where it is missed most, if best replaced, and its equally good
        rivals there."""
        choice = self.choice
        present = [term for term in choice.current if term in terms and term.effect == effect]
        missed = {term: choice.judge(choice.without(term, choice.current)) for term in present}
        most = max(present, key=lambda term: (missed[term], term.place, term.shape), default=None)
        evidence, rivals = self._replaced(most) if most else (0.0, [])
        return max(evidence, 0.0), tuple(dict.fromkeys([*self._elsewhere(present), *rivals]))

    def _elsewhere(self, present: Sequence[Term]) -> list[str]:
        """Effects with which searches that began elsewhere ended, as good, in place of one of these terms of one."""
        choice, own = self.choice, {term.key for term in present}
        there, effects = {term.key for term in choice.current}, {term.effect for term in present}
        ends = [terms for worse, terms in choice.others if worse < AS_GOOD * choice.equations.measurements]
        lacking = [term for terms in ends if own - {term.key for term in terms} for term in terms]
        return [term.effect for term in lacking if term.key not in there and term.effect not in effects]

    def _replaced(self, term: Term) -> tuple[float, list[str]]:
        """Score lost without a term, if best replaced, and the effects that are as good in its place."""
        choice = self.choice
        rest = choice.without(term, choice.current)
        lost = choice.loss(choice.judge(rest))
        enough = max(0.5 * lost, min(lost, BARE))
        weakest, rivals = lost, []
        for other in self._tried(term, rest):
            trial = choice.with_needs(other, rest)
            worse = choice.loss(choice.judge(trial))
            if AS_GOOD <= worse < NEAR and _bends(term) and _bends(other):
                worse = min(worse, self._refitted(trial, rest))
            weakest = min(weakest, worse)
            dearer = (choice.price(trial) - choice.price(choice.current)) / choice.equations.measurements
            alike = abs(worse - dearer) * choice.equations.measurements < NO_FALL  # but for their prices
            good = worse < AS_GOOD or alike
            if good and worse < enough and other.effect != term.effect:
                rivals.append(other.effect)
        return weakest, rivals

    def _tried(self, term: Term, rest: list[Term]) -> list[Term]:
        """The likeliest terms in place of one beside the rest, and those that are known to be alike."""
        others = [
            other
            for other in self.choice.effects
            if other.key != term.key
            and other not in rest
            and term.key not in other.beneath
            and not (term.effect == other.effect == "transmission.coupling")
        ]
        here = [other for other in others if other.place == term.place]
        known = [other for other in here if frozenset({term.effect, other.effect}) in SEPARATING_MOTION]
        return list(dict.fromkeys([*(self.choice.shortlist(rest, others, TRIED) if others else ()), *known]))

    def _refitted(self, trial: Sequence[Term], rest: Sequence[Term]) -> float:
        """How much worse terms score in place of those chosen, with all columns about their own fit."""
        store = self.choice.equations.store
        start = {term: c for term, c in store.values.items() if term in rest}
        about, kept = converge(store.nominal or store, trial, start)
        again = TermChoice(TermEquations(about, kept), kept, self.choice.usual)
        return self.choice.loss(again.score)


def _bends(term: Term) -> bool:
    """Whether the columns of other terms depend on this one's size."""
    return term.form.signature.side == "link" and term.effect != "transmission.spring"


StandIn = tuple[float, str]
"""How much worse a law scores, per independent measurement (negative is better), and its id."""
NO_LAW: StandIn = np.inf, ""


class LawTest:
    def __init__(self, store: ColumnStore, chosen: Sequence[Term]) -> None:
        layout = store.data.layout
        offered = [Term(name, place) for name, law in LAWS.items() for place in law.signature.places(layout)]
        self.choice = TermChoice(TermEquations(store, [*chosen, *offered]), chosen)
        self.laws = [law for law in offered if law in self.choice.effects]

    def best_law(self, terms: Sequence[Term]) -> StandIn:
        """The law that could best replace these terms: one for all, or one each, of which the worst counts; or one for
        them and all others that act on links, or that few arms have, which may be there to cancel at other joints."""
        own = [term for term in self.choice.current if term in terms]
        apart = [self._instead([term]) for term in own]
        found = [max(apart, key=itemgetter(0))] if apart else [NO_LAW]
        found += [self._instead(own)] if len(own) > 1 else []
        groups = [others for others in (self._on_links, self._rare) if {*own} < {*others}]
        return min([*found, *(self._instead(own, others) for others in groups)], key=itemgetter(0))

    @cached_property
    def _on_links(self) -> list[Term]:
        return [term for term in self.choice.current if term.form.signature.side == "link"]

    @cached_property
    def _rare(self) -> list[Term]:
        return [term for term in self.choice.current if not term.form.plausibility.every_joint]

    def _instead(self, own: Sequence[Term], gone: Sequence[Term] = ()) -> StandIn:
        """The best law in place of these terms, of others that are `gone` but no cases of the law, and of those at its
        joint that are then not missed."""
        choice, best = self.choice, NO_LAW
        rest = choice.current
        for term in gone or own:
            rest = choice.without(term, rest)
        laws = [law for law in self.laws if not all(self._is_case(term, law) for term in own)]
        for law in choice.shortlist(rest, laws, LAWS_TRIED):
            beside = [term for term in rest if term.place == law.place and not term.form.signature.whole_arm]
            cases = [term for term in gone if term not in own and self._is_case(term, law)]
            worse = choice.loss(choice.judge(choice.pruned([*rest, *cases, law], beside)))
            best = min(best, (worse, law.effect), key=itemgetter(0))
        return best

    def _is_case(self, term: Term, of: Term) -> bool:
        """Whether a term is a case of a law: then both say the same."""
        layout, law = self.choice.equations.layout, LAWS[of.effect]
        place = layout.n - 1 if term.form.signature.body else term.place
        more = law.without_sensor if layout.sensor is None else law.with_sensor
        return term.effect in law.cases | more and place == of.place and not term.bound
