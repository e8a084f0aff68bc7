"""Which effects are named as confounded with a cause, on choices whose scores are made by hand."""

from types import SimpleNamespace
from typing import Any

import pytest

from sim_gap.attribution import rivals as module
from sim_gap.attribution.rivals import Rivals
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice

LAG, DELAY = Term("actuator.lag", 0, (0.01,)), Term("actuator.delay", 0, (0.01,))
CLIPS = [Term("actuator.saturation", joint, (5.0,)) for joint in range(6)]


def lag_choice(
    scores: dict[frozenset[Term], float], current: list[Term], *others: Term, dearer: float = 0.0, price: float = 0.012
) -> Any:
    """A choice of the current terms, at a score of 0 per measurement; that of others is as given, else infinite.

    Effects but the current ones are `dearer` by so many coefficients.
    """
    return SimpleNamespace(
        current=current,
        score=0.0,
        others=[],
        usual=frozenset(),
        effects=dict.fromkeys([*current, *CLIPS, DELAY, *others]),
        equations=SimpleNamespace(measurements=1.0, layout=None, store=SimpleNamespace(nominal=None, values={})),
        shortlist=lambda _rest, offered, most: offered[:most],
        price=lambda terms: price * sum(1.0 + dearer * (term not in current) for term in terms),
        judge=lambda terms: scores.get(frozenset(terms), float("inf")),
        without=lambda term, terms: [other for other in terms if other != term],
        with_needs=lambda term, terms: [*terms, term],
        loss=lambda score: score,
    )


def rivals(scores: dict[Term | None, float]) -> tuple[str, ...]:
    """Rivals of a lag, given the scores with another in its place (None: nothing)."""
    sets = {frozenset({term} if term else ()): score for term, score in scores.items()}
    return Rivals(lag_choice(sets, [LAG])).weigh("actuator.lag", [LAG])[1]


def test_what_does_nearly_as_well_is_a_rival_and_what_brings_little_is_not():
    assert rivals({None: 0.4, DELAY: 0.01}) == ("actuator.delay",)
    assert rivals({None: 0.4, DELAY: 0.2}) == ()


@pytest.mark.parametrize(("score", "named"), [(0.01, ("actuator.delay",)), (0.2, ())])
def test_what_a_search_from_elsewhere_ended_with_is_a_rival_if_it_is_as_good(score, named):
    choice = lag_choice({frozenset(): 0.4}, [LAG])
    choice.others = [(score, [DELAY])]
    assert Rivals(choice).weigh("actuator.lag", [LAG])[1] == named
    choice.others = [(score, [LAG, DELAY])]  # which has the lag as well
    assert Rivals(choice).weigh("actuator.lag", [LAG])[1] == ()


@pytest.mark.parametrize("price", [0.012, 0.04])
def test_what_fits_exactly_alike_is_a_rival_though_it_costs_more(price):
    """An asymmetric friction costs three coefficients more than the offset that reads as it does."""
    choice = lag_choice({frozenset(): 0.4, frozenset({DELAY}): 3.0 * price}, [LAG], dearer=3.0, price=price)
    assert Rivals(choice).weigh("actuator.lag", [LAG])[1] == ("actuator.delay",)
    choice = lag_choice({frozenset(): 0.4, frozenset({DELAY}): 3.5 * price}, [LAG], dearer=3.0, price=price)
    assert Rivals(choice).weigh("actuator.lag", [LAG])[1] == ()


def test_an_effect_known_to_be_alike_is_tried_even_where_others_promise_more():
    """Of the six limits offered before it, four are tried; the delay is tried for what it is."""
    assert "actuator.delay" in rivals({None: 0.4, DELAY: 0.01, **dict.fromkeys(CLIPS, 0.3)})


def test_beside_a_cause_that_hardly_earns_its_place_whatever_brings_anything_is_a_rival():
    assert rivals({None: 0.007, DELAY: 0.004}) == ("actuator.delay",)
    assert rivals({None: 0.007, DELAY: 0.008}) == ()


@pytest.mark.parametrize("turned", [False, True])
def test_the_rivals_are_those_of_the_best_founded_place_in_whatever_order(turned):
    """Joint 1 has much evidence of a lag, and of a delay as well; the little at joint 2 has no rival."""
    weak = Term("actuator.lag", 1, (0.01,))
    scores = {frozenset({weak}): 0.4, frozenset({weak, DELAY}): 0.03, frozenset({LAG}): 0.02}
    evidence, confounded = Rivals(lag_choice(scores, in_order([LAG, weak], turned))).weigh("actuator.lag", [LAG, weak])
    assert evidence == 0.03
    assert confounded == ("actuator.delay",)


@pytest.mark.parametrize("turned", [False, True])
def test_the_rivals_of_a_weak_place_are_none_of_the_best_founded_one_in_whatever_order(turned):
    """Joint 1 has much evidence of a lag alone; the little at joint 2 may be a delay."""
    weak, late = Term("actuator.lag", 1, (0.01,)), Term("actuator.delay", 1, (0.01,))
    scores = {frozenset({weak}): 0.4, frozenset({LAG}): 0.03, frozenset({LAG, late}): 0.01}
    evidence, confounded = Rivals(lag_choice(scores, in_order([LAG, weak], turned), late)).weigh(
        "actuator.lag", [LAG, weak]
    )
    assert evidence == 0.4
    assert confounded == ()


def test_terms_that_end_at_a_bound_have_no_evidence():
    """Their score is infinite, and so may be that of all others."""
    found = SimpleNamespace(score=float("inf"), equations=SimpleNamespace(measurements=100.0))
    assert TermChoice.loss(found, 3.0) == TermChoice.loss(found, float("inf")) == 0.0


def in_order(terms: list[Term], turned: bool) -> list[Term]:
    return terms[::-1] if turned else terms


def test_a_rival_whose_columns_bend_is_judged_about_its_own_fit(monkeypatch):
    monkeypatch.setattr(module, "converge", lambda nominal, terms, start: (None, [DELAY]))
    monkeypatch.setattr(module, "TermEquations", lambda about, terms: None)
    monkeypatch.setattr(module, "TermChoice", lambda equations, terms, usual: SimpleNamespace(score=0.2))
    assert Rivals(lag_choice({}, [LAG]))._refitted([DELAY], []) == pytest.approx(0.2)
