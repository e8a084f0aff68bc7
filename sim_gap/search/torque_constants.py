"""Torque constants of drives where motor torque alone is recorded.

Such recordings know torque constants and masses only up to a factor that all have in common: with links twice as heavy
and every constant twice as large, the drives report the same. The links are taken as the model has them, and then one
drive's constant is as doubtful as another's. A search that adds one effect after the other may end elsewhere, with one
drive's constant as the model has it and all masses changed in proportion. Where the constants of all drives are off by
one factor, the masses are named, and the answer says that they may be the constants.
"""

from collections.abc import Sequence

from sim_gap.residuals.layout import ChannelLayout
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice

CONSTANT, MASSES, BODY = "actuator.gain", "link.mass_moment", "link.payload"
LINKS = (MASSES, "link.inertia", BODY)
OFF = 0.05
"""A torque constant is off from this share on."""


def most_are_off(choice: TermChoice) -> bool:
    """Whether most drives have another constant: those of an arm come from one maker, and are in doubt together."""
    off = [abs(float(c[0])) > OFF for term, c in choice.values().items() if term.effect == CONSTANT]
    return 2 * sum(off) > choice.equations.layout.n


def shares_a_factor(layout: ChannelLayout, terms: Sequence[Term]) -> bool:
    """Whether the terms have torque constants that are known only up to a factor common to them and all masses."""
    return layout.sensor is None and any(term.effect == CONSTANT for term in terms)


def masses_may_be_constants(layout: ChannelLayout, terms: Sequence[Term]) -> bool:
    """Whether mass moments of most links are named, and torque constants all off alike would look the same."""
    links = {term.place for term in terms if term.effect == MASSES}
    constants = any(term.effect == CONSTANT for term in terms)
    return layout.sensor is None and not constants and 2 * len(links) > layout.n
