"""Which effects are named as confounded with a cause, on searches whose scores are made by hand."""

from types import SimpleNamespace

import pytest

from sim_gap.attribution import rivals as module
from sim_gap.attribution.rivals import Rivals
from sim_gap.search.term import Term

LAG, DELAY = Term("actuator.lag", 0, (0.01,)), Term("actuator.delay", 0, (0.01,))
CLIPS = [Term("actuator.saturation", joint, (5.0,)) for joint in range(6)]


def rivals(scores: dict[Term | None, float]) -> tuple[str, ...]:
    """Rivals of a lag: the score with it is 0, with another in its place (None: nothing) as given, else infinite."""

    def judge(terms: list[Term]) -> float:
        return scores.get(terms[0] if terms else None, float("inf"))

    search = SimpleNamespace(
        active=[LAG],
        score=0.0,
        normal=SimpleNamespace(terms=[LAG, *CLIPS, DELAY]),
        weighted=SimpleNamespace(screen=lambda rest, others: [(1.0, other) for other in others]),
        judge=judge,
        without=lambda term, terms: [other for other in terms if other != term],
        with_beneath=lambda term, terms: [*terms, term],
    )
    return Rivals(search).weigh("actuator.lag", [LAG]).confounded_with


def test_what_does_nearly_as_well_is_a_rival_and_what_brings_little_is_not():
    assert rivals({None: 0.4, DELAY: 0.01}) == ("actuator.delay",)
    assert rivals({None: 0.4, DELAY: 0.2}) == ()


def test_an_effect_known_to_be_alike_is_tried_even_where_others_promise_more():
    """Of the six limits offered before it, four are tried; the delay is tried for what it is."""
    assert "actuator.delay" in rivals({None: 0.4, DELAY: 0.01, **dict.fromkeys(CLIPS, 0.3)})


def test_beside_a_cause_that_hardly_earns_its_place_whatever_brings_anything_is_a_rival():
    assert rivals({None: 0.007, DELAY: 0.004}) == ("actuator.delay",)
    assert rivals({None: 0.007, DELAY: 0.008}) == ()


def test_the_rivals_of_the_best_founded_place_stay_those_of_the_cause():
    """Joint 1 has much evidence of a lag, and of a delay as well; the little at joint 2 has no rival."""
    weak = Term("actuator.lag", 1, (0.01,))
    scores = {frozenset({weak}): 0.4, frozenset({weak, DELAY}): 0.03, frozenset({LAG}): 0.02}
    search = SimpleNamespace(
        active=[LAG, weak],
        score=0.0,
        normal=SimpleNamespace(terms=[LAG, weak, DELAY]),
        weighted=SimpleNamespace(screen=lambda rest, others: [(1.0, other) for other in others]),
        judge=lambda terms: scores.get(frozenset(terms), float("inf")),
        without=lambda term, terms: [other for other in terms if other != term],
        with_beneath=lambda term, terms: [*terms, term],
    )
    weighed = Rivals(search).weigh("actuator.lag", [LAG, weak])
    assert weighed.evidence == 0.03
    assert weighed.confounded_with == ("actuator.delay",)


@pytest.mark.parametrize(("kept", "worse"), [([DELAY], 0.2), ([], float("inf"))])
def test_a_rival_that_a_fit_about_itself_drops_is_none(monkeypatch, kept, worse):
    monkeypatch.setattr(module, "converged", lambda nominal, terms, start: (None, kept))
    monkeypatch.setattr(module, "NormalEquations", lambda about, terms: None)
    monkeypatch.setattr(module, "Search", lambda normal, terms, usual: SimpleNamespace(score=1.2))
    search = SimpleNamespace(
        score=1.0,
        usual=None,
        normal=SimpleNamespace(store=SimpleNamespace(nominal=None, values={})),
        with_beneath=lambda term, terms: [*terms, term],
    )
    assert Rivals(search)._refitted(DELAY, []) == pytest.approx(worse)
