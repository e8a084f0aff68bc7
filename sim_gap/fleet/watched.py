"""Wear of every joint from one diagnosis: friction, gains and play, whether or not they are causes of the gap.

A search reports what is large enough to explain the gap, so that a small play is in no answer, and what is near the
threshold comes and goes from day to day. To follow wear, the same effects are fitted every day, all at once beside the
causes found: a change of a tenth of a degree of play is far below what a single diagnosis would name.
"""

from typing import Any

from sim_gap.attribution.answer import Internals
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.effects.registry import effects
from sim_gap.search.estimate import Estimate
from sim_gap.search.term import Term

WATCHED = ("friction.coulomb", "friction.viscous", "torque.gain", "actuator.gain", "transmission.backlash")
"""Effects that are followed. A ripple, whose number of cycles has to be found first, is followed among the causes."""
RIPPLE = "transmission.ripple"
MOVES = 0.05
"""Share of the samples in motion from which a joint's parameters are estimated."""


def watched(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Watched parameters with 95 % intervals, of each joint that moves; none without a torque channel."""
    made = diagnosis.internals
    if not isinstance(made, Internals) or made.nominal is None:
        return []
    fit, layout = made.nominal, made.train.layout
    moving = sum(s.moving.mean(0) for s in made.train.signals) / len(made.train.signals)
    main = {cause.effect for cause in diagnosis.causes} | {RIPPLE}
    kept = [term for term in fit.terms if term.effect in main and term.effect not in WATCHED]
    followed = [
        Term(effect, joint)
        for effect in WATCHED
        for joint in effects()[effect].signature.places(layout)
        if moving[joint] > MOVES
    ]
    whole = Estimate(fit.store, [*kept, *followed])
    out = []
    for term in whole.terms:
        if term.effect in WATCHED:
            for name, one in whole.parameters(term).items():
                where = {"effect": term.effect, "joint": diagnosis.names[term.place], "parameter": name}
                out.append({**where, "value": one.value, "ci95": [one.low, one.high], "unit": one.unit})
    return out
