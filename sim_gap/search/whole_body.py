"""A payload in place of the mass moments of several links, which approximate it before it is fitted about itself.

Linear in its mass and first moment, a payload lacks the inertia that its mass has where it hangs; mass moments of all
links together then fit a little better, and no single exchange leads back.
"""

from collections.abc import Sequence

from sim_gap.search.column_store import ColumnStore
from sim_gap.search.gauss_newton import converged
from sim_gap.search.normal_equations import NormalEquations
from sim_gap.search.stepwise import Search
from sim_gap.search.term import Term

MOMENTS, BODY = "link.mass_moment", "link.payload"
SEVERAL = 2
"""Number of links with a mass moment from which one body may be meant."""


def one_body(store: ColumnStore, search: Search, offered: Sequence[Term]) -> list[Term] | None:
    """The active terms with a payload in place of the mass moments, if that fits as well about itself; else None.

    `store` has the columns about the nominal model.
    """
    active = search.active
    bodies = [term for term in offered if term.effect == BODY and not term.shape]
    moments = [term for term in active if term.effect == MOMENTS]
    if len(moments) < SEVERAL or not bodies or any(term.effect == BODY for term in active):
        return None
    about, kept = converged(store, [*(term for term in active if term not in moments), bodies[0]])
    found = Search(NormalEquations(about, kept), kept)
    there = any(term.effect == BODY for term in found.active)
    return found.active if there and found.score < search.score else None
