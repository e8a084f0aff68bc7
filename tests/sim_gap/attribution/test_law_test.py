"""General laws replace causes that look the same in this motion, for the library may lack the true effect."""

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.rivals import LawTest
from sim_gap.effects.registry import LAWS, effects, library_without
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term


def law_test(wrong: Wrong, *active: Term) -> LawTest:
    signals = prepare(record(model(), wrong, seed=1, seconds=40, rate=50.0), load_model(model()).arm, "a recording")
    return LawTest(ColumnStore(ResidualSet((signals,), layout_of([signals]))), active)


def test_laws_are_in_no_library():
    assert not set(LAWS) & set(library_without([]))
    assert set(LAWS) < set(effects())


def test_mass_moments_of_two_links_that_are_one_payload_are_no_better_than_a_body():
    moments = Term("link.mass_moment", 1), Term("link.mass_moment", 2)
    worse, law = law_test(Wrong(payload=1.0), *moments).best_law(moments)
    assert law == "law.body"
    assert worse < 0.1


def test_a_payload_is_a_body_and_loses_nothing_by_it():
    payload = (Term("link.payload", 0),)
    assert law_test(Wrong(payload=1.0), *payload).best_law(payload)[0] > 0.5


def test_friction_is_like_no_law():
    friction = (Term("friction.coulomb", 1),)
    assert law_test(Wrong(coulomb=np.array([0.0, 0.8, 0.0])), *friction).best_law(friction)[0] > 0.5


def test_where_a_law_does_for_a_crowd_of_small_causes_the_crowd_gives_way():
    """A sensor's offset, fitted as a spring and asymmetric friction of the same joint."""
    spring = Term("transmission.spring", 1)
    crowd = spring, Term("friction.coulomb", 1), Term("friction.asymmetric", 1)
    wrong = Wrong(offset=np.array([0.0, 0.6, 0.0]), coulomb=np.array([0.0, 0.4, 0.0]))
    worse, law = law_test(wrong, *crowd).best_law([spring])
    assert law == "law.load"
    assert worse < 0.0


def test_where_a_law_does_for_all_that_few_arms_have_none_of_it_is_certain():
    """A sensor's gain, fitted as the motor's and a mass that makes up for it in the sensor's reading."""
    crowd = Term("actuator.gain", 1), Term("link.mass_moment", 1), Term("link.mass_moment", 0)
    test = law_test(Wrong(gain=np.array([1.0, 0.9, 1.0])), *crowd)
    for term in crowd:
        worse, law = test.best_law([term])
        assert law == "law.load"
        assert worse < 0.0


HIDDEN = (("link.payload", Wrong(payload=1.0)), ("base.tilt", Wrong(tilt=(0.05, 0.04))))


@pytest.mark.long
@pytest.mark.parametrize(("withheld", "wrong"), HIDDEN)
def test_what_a_law_says_as_well_is_not_said_with_confidence(withheld, wrong):
    recordings = [record(model(), wrong, seed=seed, seconds=40, rate=50.0) for seed in (1, 2)]
    answer = diagnose(model(), recordings[:1], recordings[1:], withhold=[withheld])
    assert not [cause for cause in answer.causes if cause.confidence > 0.8]
    assert any("would look the same" in note or "remains (noise" in note for note in answer.notes)
    whole = diagnose(model(), recordings[:1], recordings[1:])
    assert whole.causes[0].effect == withheld
    assert whole.causes[0].confidence > 0.8
