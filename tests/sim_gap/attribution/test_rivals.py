"""Which effects are named as confounded with a cause, on searches whose scores are made by hand."""

from types import SimpleNamespace

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
