"""Steps of the search for causes, one by one."""

import numpy as np
from wrong_arms import Wrong, model, record

from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.model_selection import candidates, without_doubtful
from sim_gap.search.normal_equations import NormalEquations
from sim_gap.search.stepwise import Search
from sim_gap.search.term import Term


def normal_equations(wrong: Wrong) -> NormalEquations:
    signals = prepare(record(model(), wrong, seed=1, seconds=40, rate=50.0), load_model(model()).arm, "a recording")
    data = ResidualSet((signals,), layout_of([signals]))
    return NormalEquations(ColumnStore(data), candidates(data, ["link.payload", "link.mass_moment", "torque.offset"]))


def payload(normal: NormalEquations) -> Term:
    return next(term for term in normal.terms if term.effect == "link.payload")


def test_a_term_that_leaves_much_gives_way_to_several_simpler_ones_at_once():
    """A payload and a link whose centre of mass is elsewhere, taken for a payload alone."""
    moved = Wrong(payload=0.5, moved={0: (0.0, 0.0, 0.05)}, offset=np.array([0.4, 0.0, 0.0]))
    normal = normal_equations(moved)
    offset = next(term for term in normal.terms if term.key == ("torque.offset", 0))
    before = Search(normal, [payload(normal), offset])
    assert payload(normal) in before.active
    assert before.leaves_much(payload(normal))
    after = without_doubtful(before)
    assert after.score < before.score
    assert {term.key for term in after.active} >= {("link.mass_moment", 0), ("link.mass_moment", 1), offset.key}
    assert payload(normal) not in after.active


def test_a_term_that_explains_its_rows_stays():
    normal = normal_equations(Wrong(payload=0.5))
    search = Search(normal, [payload(normal)])
    assert without_doubtful(search) is search
