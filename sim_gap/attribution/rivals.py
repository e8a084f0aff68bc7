"""Rivals of a cause: other effects that explain the recordings as well, and the motion that would separate them."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_gap.search.gauss_newton import converged
from sim_gap.search.normal_equations import NormalEquations
from sim_gap.search.stepwise import Search, shortlist
from sim_gap.search.term import Term
from sim_gap.search.torque_constants import CONSTANT, MASSES, masses_may_be_constants

AS_GOOD = 0.036
"""A rival is as good if its score (½ log of the mean square) is worse by no more than this: the price of three
coefficients, for the background of every arm can favour either by that much."""
BARE = 0.012
"""A cause that brings no more than the price of a coefficient has as a rival any effect that brings some of it."""
NEAR = 0.3
"""A rival within this is fitted about itself, if the columns of either depend on the other."""
TRIED = 4
"""Number of rivals tried in place of a term: the best of a first screening."""
SEPARATING_MOTION = {
    frozenset(
        {"friction.coulomb", "friction.load"}
    ): "both directions at the same speed under clearly different loads (stretched out, folded, with a payload)",
    frozenset({"friction.coulomb", "friction.stribeck"}): "constant speeds from creeping to fast, both directions",
    frozenset({"friction.coulomb", "friction.viscous"}): "constant speeds from slow to fast, both directions",
    frozenset(
        {"friction.asymmetric", "torque.offset"}
    ): "a rest under a known load, and both directions at several loads",
    frozenset({"actuator.gain", "link.mass_moment"}): "the same poses with a known payload attached",
    frozenset({"torque.gain", "link.payload"}): "the same poses with and without the payload",
    frozenset({"torque.gain", "link.mass_moment"}): "the same poses with a known payload attached",
    frozenset({"actuator.lag", "actuator.delay"}): "steps or a chirp to 10 Hz, logged fast",
    frozenset({"transmission.backlash", "transmission.elasticity"}): "slow reversals under load",
    frozenset({"transmission.elasticity", "actuator.rotor_inertia"}): "fast motion with a payload",
    frozenset(
        {"position.offset", "base.tilt"}
    ): "a turn of joint 1 with the arm stretched out, and a level on the base",
    frozenset({"position.offset", "link.mass_moment"}): "the same motion with a known payload attached",
    frozenset(
        {"actuator.rotor_inertia", "link.inertia"}
    ): "fast motion of the joint with the links beyond it stretched out and folded",
    frozenset({"torque.hysteresis", "friction.coulomb"}): "a slow change of load with the joint at rest",
}
GENERAL_MOTION = (
    "each joint alone through its whole range, slow and fast, both directions, with the other joints in two poses"
)


@dataclass(frozen=True)
class Weighed:
    """Score lost without a cause, and the effects that could replace it."""

    evidence: float
    confounded_with: tuple[str, ...]
    separate_by: str | None


class Rivals:
    """Tries every effect of the library in place of a cause."""

    def __init__(self, search: Search) -> None:
        self.search = search

    def weigh(self, effect: str, terms: Sequence[Term]) -> Weighed:
        """Score lost without a cause at its best-founded place, if best replaced, and its equally good rivals."""
        search = self.search
        present = [term for term in search.active if term in terms and term.effect == effect]
        evidence = 0.0
        rivals: list[str] = []
        for term in present:
            rest = search.without(term, search.active)
            lost = search.judge(rest) - search.score
            weakest, own = lost, []
            others = [
                other
                for other in search.normal.terms
                if other.key != term.key
                and other not in rest
                and term.key not in other.beneath
                and not (term.effect == other.effect == "transmission.coupling")
            ]
            likely = [other for _, other in shortlist(search.weighted.screen(rest, others))[:TRIED]]
            here = [other for other in others if other.place == term.place]
            known = [other for other in here if frozenset({term.effect, other.effect}) in SEPARATING_MOTION]
            for other in dict.fromkeys([*likely, *known]):
                worse = search.judge(search.with_beneath(other, rest)) - search.score
                if AS_GOOD <= worse < NEAR and _bends(term) and _bends(other):
                    worse = min(worse, self._refitted(other, rest))
                weakest = min(weakest, worse)
                enough = max(0.5 * lost, min(lost, BARE))
                if worse < AS_GOOD and worse < enough and other.effect != effect:
                    own.append(other.effect)
            if weakest >= evidence or not rivals:
                evidence, rivals = max(evidence, weakest), own
        if effect == MASSES and masses_may_be_constants(search.normal.layout, search.active):
            rivals = [CONSTANT, *rivals]
        confounded = tuple(dict.fromkeys(rivals))
        if not confounded:
            return Weighed(evidence, (), None)
        motion = SEPARATING_MOTION.get(frozenset({effect, confounded[0]}), GENERAL_MOTION)
        return Weighed(evidence, confounded, f"record {motion}")

    def _refitted(self, other: Term, rest: list[Term]) -> float:
        """How much worse another term scores in place of one, with all columns about that fit."""
        terms = self.search.with_beneath(other, rest)
        store = self.search.normal.store
        nominal, start = store.nominal or store, store.values
        about, kept = converged(nominal, terms, {term: c for term, c in start.items() if term in rest})
        if other.key not in {term.key for term in kept}:
            return float("inf")
        again = Search(NormalEquations(about, kept), kept, usual=self.search.usual)
        return again.score - self.search.score


def _bends(term: Term) -> bool:
    """Whether the columns of other terms depend on this one's size."""
    return term.form.signature.side == "link" and term.effect != "transmission.spring"
