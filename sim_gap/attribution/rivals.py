"""Which other effects would have explained the recording as well, and which motion would tell them apart."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_gap.effects.registry import effects
from sim_gap.search.normal_equations import Term
from sim_gap.search.stepwise import Search, shortlist

AS_GOOD = 0.036
"""A rival is as good where it scores no more than this below the chosen effect (half a log of the mean square): the
price of three coefficients, for what every arm has besides may speak by so much for either."""
BARE = 0.012
"""A cause that brings no more than the price of a coefficient has a rival in whatever brings anything in its place."""
TRIED = 4
MOTION = {
    frozenset(
        {"friction.coulomb", "friction.load"}
    ): "both ways at the same speed under clearly different loads (stretched out, folded, with a payload)",
    frozenset({"friction.coulomb", "friction.stribeck"}): "constant speeds from creeping to fast, both ways",
    frozenset({"friction.coulomb", "friction.viscous"}): "constant speeds from slow to fast, both ways",
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
GENERAL = "each joint alone through its whole range, slow and fast, both ways, with the other joints in two poses"


@dataclass(frozen=True)
class Weighed:
    """What is lost without a cause, and what could stand in its place."""

    evidence: float
    confounded_with: tuple[str, ...]
    separate_by: str | None


class Rivals:
    """Tries every effect of the library in the place of a cause."""

    def __init__(self, search: Search) -> None:
        self.search = search

    @staticmethod
    def whole_arm(effect: str) -> bool:
        """Whether an effect belongs to the arm rather than to a joint."""
        return effects()[effect].whole_arm

    def weigh(self, effect: str, terms: Sequence[Term]) -> Weighed:
        """What is lost without a cause at its best-founded place, whatever stands in; and what does as well."""
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
            known = [o for o in others if o.place == term.place and frozenset({term.effect, o.effect}) in MOTION]
            for other in dict.fromkeys([*likely, *known]):
                worse = search.judge(search.with_beneath(other, rest)) - search.score
                weakest = min(weakest, worse)
                enough = max(0.5 * lost, min(lost, BARE))
                if worse < AS_GOOD and worse < enough and other.effect != effect:
                    own.append(other.effect)
            if weakest >= evidence or not rivals:
                evidence, rivals = max(evidence, weakest), own
        confounded = tuple(dict.fromkeys(rivals))
        motion = MOTION.get(frozenset({effect, confounded[0]}), GENERAL) if confounded else None
        return Weighed(evidence, confounded, f"record {motion}" if motion else None)
