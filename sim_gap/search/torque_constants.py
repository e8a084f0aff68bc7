"""Torque constants of drives where motor torque alone is recorded.

Such recordings know torque constants and masses only up to a factor that all have in common: with links twice as heavy
and every constant twice as large, the drives report the same. The links are taken as the model has them, and then one
drive's constant is as doubtful as another's. A search that adds one effect after the other may end elsewhere, with one
drive's constant as the model has it and all masses changed in proportion. Where the constants of all drives are off by
one factor, the masses are named, and the answer says that they may be the constants.
"""

from collections.abc import Sequence

from gcomp.estimate.choice import PRICE
from sim_gap.effects.registry import effects
from sim_gap.residuals.layout import ChannelLayout
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice

CONSTANT = "actuator.gain"
CONSTANTS = frozenset({CONSTANT})
MASSES = "link.mass_moment"
LINKS = (MASSES, "link.inertia", "link.payload")
OFF = 0.05
"""A torque constant is off from this share on."""


def drives_are_off(choice: TermChoice) -> bool:
    """Whether drives of an arm without torque sensors have another torque constant than they take it for.

    Several have, or one has while links seem to be wrong.
    """
    if choice.equations.layout.sensor is not None:
        return False
    off, links = _count_off(choice), any(term.effect in LINKS for term in choice.current)
    return off > 1 or (off == 1 and links)


def most_are_off(choice: TermChoice) -> bool:
    """Whether most drives have another constant: those of an arm come from one maker, and are in doubt together."""
    return 2 * _count_off(choice) > choice.equations.layout.n


def _count_off(choice: TermChoice) -> int:
    return sum(abs(float(c[0])) > OFF for term, c in choice.values().items() if term.effect == CONSTANT)


def price_of_all() -> float:
    """Price of the constants of all drives together: that of one effect that few arms have."""
    return PRICE * (1 + effects()[CONSTANT].plausibility.prior_penalty)


def shares_a_factor(layout: ChannelLayout, terms: Sequence[Term]) -> bool:
    """Whether the terms have torque constants that are known only up to a factor common to them and all masses."""
    return layout.sensor is None and any(term.effect == CONSTANT for term in terms)


def masses_may_be_constants(layout: ChannelLayout, terms: Sequence[Term]) -> bool:
    """Whether mass moments of most links are named, and torque constants all off alike would look the same."""
    links = {term.place for term in terms if term.effect == MASSES}
    constants = any(term.effect == CONSTANT for term in terms)
    return layout.sensor is None and not constants and 2 * len(links) > layout.n


def every_constant(choice: TermChoice, offered: Sequence[Term]) -> list[Term]:
    """Where to search from again: every drive's constant free, the links as in the model, all else as found."""
    drives = [term for term in offered if term.effect == CONSTANT]
    return [*drives, *(term for term in choice.current if term.effect not in (CONSTANT, *LINKS))]
