"""Steps of the search for causes, one by one."""

from dataclasses import replace

import numpy as np
from wrong_arms import Wrong, model, record

from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.model_selection import candidates, refine, select_model
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermChoice, TermEquations


def equations_of(wrong: Wrong) -> TermEquations:
    signals = prepare(record(model(), wrong, seed=1, seconds=40, rate=50.0), load_model(model()).arm, "a recording")
    data = ResidualSet((signals,), layout_of([signals]))
    return TermEquations(ColumnStore(data), candidates(data, ["link.payload", "link.mass_moment", "torque.offset"]))


def payload(equations: TermEquations) -> Term:
    return next(term for term in equations.terms if term.effect == "link.payload")


def test_a_payload_that_leaves_much_gives_way_to_several_simpler_effects_at_once():
    """A payload and a link whose centre of mass is elsewhere, taken for a payload alone."""
    moved = Wrong(payload=0.5, moved={0: (0.0, 0.0, 0.05)}, offset=np.array([0.4, 0.0, 0.0]))
    equations = equations_of(moved)
    offset = next(term for term in equations.terms if term.key == ("torque.offset", 0))
    choice = TermChoice(equations, [payload(equations), offset])
    before = choice.score
    choice.run()
    assert choice.score < before
    assert {term.key for term in choice.current} >= {("link.mass_moment", 0), offset.key}


def test_a_payload_that_explains_its_rows_stays():
    store = equations_of(Wrong(payload=0.5)).store
    choice = select_model(store, ["link.payload", "link.mass_moment", "torque.offset"])
    assert [term.effect for term in choice.current] == ["link.payload"]


def test_a_step_that_makes_it_worse_is_undone_and_not_tried_again():
    """A term is chosen with the rows weighed by what is left before it, and may turn out to be no better after it."""
    equations = equations_of(Wrong(payload=0.5))
    choice = TermChoice(equations, [payload(equations)])
    score = choice.score
    useless = next(term for term in equations.terms if term.key == ("torque.offset", 2))
    assert choice.step([[payload(equations), useless]], np.inf)
    assert choice.current == [payload(equations)]
    assert choice.score == score
    assert not choice.step([[payload(equations), useless]], np.inf)


def test_a_limit_begun_far_off_is_found_at_the_level_at_which_it_clips():
    """At a level that is far too low, only a part of what it would cut off is missing."""
    plain = record(model(), Wrong(), seed=1, seconds=40, rate=50.0, channels=("tau",))
    limit = 0.6 * float(np.abs(plain.torque[:, 1]).max())
    clipped = replace(
        plain, torque=np.clip(plain.torque, *(side * np.array([np.inf, limit, np.inf]) for side in (-1, 1)))
    )
    signals = prepare(clipped, load_model(model()).arm, "a recording")
    data = ResidualSet((signals,), layout_of([signals]))
    terms = candidates(data, ["torque.saturation"])
    choice = TermChoice(TermEquations(ColumnStore(data), terms), [])
    choice.run()
    level = lambda term: abs(term.shape[0] - limit)  # noqa: E731
    assert [term.key for term in choice.current] == [("torque.saturation", 1)]
    assert choice.current[0] == min((term for term in terms if term.place == 1), key=level)
    (refined,) = refine(choice.equations.store, choice.current)
    assert level(refined) <= level(choice.current[0])
    assert level(refined) < 0.05 * limit


def test_breakaway_comes_with_the_friction_that_it_adds_to():
    wrong = Wrong(coulomb=np.array([0.0, 0.6, 0.0]), breakaway=np.array([0.0, 0.6, 0.0]))
    recording = record(model(), wrong, seed=1, seconds=40, rate=50.0, channels=("tau_motor",))
    signals = prepare(recording, load_model(model()).arm, "a recording")
    store = ColumnStore(ResidualSet((signals,), layout_of([signals])))
    coulomb, breakaway = Term("friction.coulomb", 1), Term("friction.stribeck", 1, (0.1,))
    choice = TermChoice(TermEquations(store, [coulomb, breakaway]))
    assert choice.with_needs(breakaway, []) == [coulomb, breakaway]
    assert choice.without(coulomb, [coulomb, breakaway]) == []


def test_no_breakaway_is_negative_though_friction_rises_with_speed():
    """Friction that sets in gradually looks like friction that is missing at low speed."""
    recording = record(model(), Wrong(viscous=np.array([0.0, 0.8, 0.0])), seed=2, seconds=40, rate=50.0)
    signals = prepare(recording, load_model(model()).arm, "a recording")
    store = ColumnStore(ResidualSet((signals,), layout_of([signals])))
    terms = [Term("friction.coulomb", 1), Term("friction.stribeck", 1, (0.5,))]
    found = TermEquations(store, terms).fitted()
    assert found[terms[1]][0] == 0.0
    assert found[terms[0]][0] > 0.0


def test_errors_of_folds_predicted_from_the_others_are_those_of_fits_one_by_one():
    """Least squares of the columns themselves, weighted and with the prior."""
    equations = equations_of(Wrong(payload=0.5, offset=np.array([0.4, 0.0, 0.0])))
    terms = [term for term in equations.terms if term.effect in ("torque.offset", "link.mass_moment")]
    data, store, rows, linear = equations.store.data, equations.store, equations.rows, equations.linear
    index = equations.index(terms)
    each = [linear.counts[r].sum() / max(data.valid[row].sum(), 1) for r, row in enumerate(rows)]
    squares = np.zeros(len(rows))
    for fold in range(int(data.folds.max()) + 1):
        stacked = [(store.wide(terms, row, equations.fixed), data.values[row], data.valid[row]) for row in rows]
        roots = np.sqrt(each / linear.variance)
        x = np.concatenate([w * a[v & (data.folds != fold)] for w, (a, _, v) in zip(roots, stacked, strict=True)])
        y = np.concatenate([w * b[v & (data.folds != fold)] for w, (_, b, v) in zip(roots, stacked, strict=True)])
        root = np.sqrt(linear.prior[index])
        pull = root * linear.expected[index]
        c = np.linalg.lstsq(np.vstack([x, np.diag(root)]), np.concatenate([y, pull]), rcond=None)[0]
        for r, (a, b, v) in enumerate(stacked):
            pick = v & (data.folds == fold)
            squares[r] += each[r] * np.sum((b[pick] - a[pick] @ c) ** 2)
    expected = 0.5 * linear.counts.sum(1) * np.log(squares / linear.counts.sum(1) + linear.floor**2)
    np.testing.assert_allclose(linear.cost(index.tolist()), expected, rtol=1e-5)


def test_what_columns_were_computed_from_is_freed_with_them():
    equations = equations_of(Wrong(payload=0.5))
    (signals,) = equations.store.data.signals
    signals.sensitivity(0)
    equations.store.release()
    assert "_sensitivities" not in vars(signals)
