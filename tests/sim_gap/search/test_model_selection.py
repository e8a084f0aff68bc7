"""Steps of the search for causes, one by one."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from wrong_arms import Wrong, model, record

from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.model_selection import candidates, refine, replace_doubtful, restore_lost
from sim_gap.search.normal_equations import NormalEquations, Weighted
from sim_gap.search.stepwise_search import StepwiseSearch
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
    before = StepwiseSearch(normal, [payload(normal), offset])
    assert payload(normal) in before.active
    assert before.leaves_much(payload(normal))
    after = replace_doubtful(before)
    assert after.score < before.score
    assert {term.key for term in after.active} >= {("link.mass_moment", 0), ("link.mass_moment", 1), offset.key}
    assert payload(normal) not in after.active


def test_a_term_that_explains_its_rows_stays():
    normal = normal_equations(Wrong(payload=0.5))
    search = StepwiseSearch(normal, [payload(normal)])
    assert replace_doubtful(search) is search


def test_a_step_that_makes_it_worse_is_undone_and_not_tried_again():
    """A term is chosen with the rows weighed by what is left before it, and may turn out to be no better after it."""
    normal = normal_equations(Wrong(payload=0.5))
    search = StepwiseSearch(normal, [payload(normal)])
    score = search.score
    useless = next(term for term in normal.terms if term.key == ("torque.offset", 2))
    search.accept([payload(normal), useless])
    assert search.active == [payload(normal)]
    assert search.score == score
    assert search._best(search._judged([[payload(normal), useless]]), np.inf) is None


def test_a_cheap_effect_is_tried_though_many_dear_ones_would_take_more(monkeypatch):
    """Twelve limits that each take a little more than the Coulomb friction and do not earn their price."""
    cheap, limits = Term("friction.coulomb", 0), [Term("torque.saturation", joint, (5.0,)) for joint in range(12)]
    screened = [*((5.0, limit) for limit in limits), (4.0, cheap)]
    search = object.__new__(StepwiseSearch)
    search.active, search.added, search.undone, search.usual = [], Counter(), set(), frozenset()
    search.score, search.least = 0.0, 1e-4
    search.normal = SimpleNamespace(
        terms=[*limits, cheap], price=0.02, count=np.full((1, 1), 800.0), freedom=lambda _: 1.0
    )
    search.weighted = SimpleNamespace(screen=lambda _terms, _candidates: screened)
    monkeypatch.setattr(StepwiseSearch, "judge", lambda _self, terms: -0.01 if cheap in terms else 0.01)
    monkeypatch.setattr(StepwiseSearch, "reweigh", lambda self: setattr(self, "score", self.judge(self.active)))
    monkeypatch.setattr(StepwiseSearch, "with_beneath", lambda _self, term, terms: [*terms, term])
    assert search.forward()
    assert search.active == [cheap]


def test_a_limit_that_got_lost_comes_back_at_the_level_at_which_it_can_exist():
    """At a level that is far too low, only a part of what it would cut off is missing."""
    plain = record(model(), Wrong(), seed=1, seconds=40, rate=50.0, channels=("tau",))
    limit = 0.6 * float(np.abs(plain.torque[:, 1]).max())
    clipped = replace(plain, torque=np.clip(plain.torque, -limit, limit))
    signals = prepare(clipped, load_model(model()).arm, "a recording")
    data = ResidualSet((signals,), layout_of([signals]))
    terms = candidates(data, ["torque.saturation"])
    search = StepwiseSearch(NormalEquations(ColumnStore(data), terms), [])
    level = lambda term: abs(term.shape[0] - limit)  # noqa: E731
    search.take_back({("torque.saturation", 1)})
    assert [term.key for term in search.active] == [("torque.saturation", 1)]
    assert search.active[0] == min((term for term in terms if term.place == 1), key=level)
    (refined,) = refine(search.normal.store, search.active)
    assert level(refined) <= level(search.active[0])
    assert StepwiseSearch(NormalEquations(search.normal.store, [refined]), [refined]).active == [refined]
    far = Term("torque.saturation", 1, (1e-3 * limit,))
    _, kept = restore_lost(search.normal.store, [far], search.normal.store, [])
    assert [term.key for term in kept] == [far.key]
    assert level(kept[0]) < 0.05 * limit


def test_breakaway_that_got_lost_comes_back_with_the_friction_that_it_adds_to():
    """The search was ended by a KeyError if that friction had got lost, too."""
    wrong = Wrong(coulomb=np.array([0.0, 0.6, 0.0]), breakaway=np.array([0.0, 0.6, 0.0]))
    recording = record(model(), wrong, seed=1, seconds=40, rate=50.0, channels=("tau_motor",))
    signals = prepare(recording, load_model(model()).arm, "a recording")
    store = ColumnStore(ResidualSet((signals,), layout_of([signals])))
    lost = [Term("friction.coulomb", 1), Term("friction.stribeck", 1, (0.1,))]
    _, kept = restore_lost(store, lost, store, [])
    assert {term.key for term in kept} == {term.key for term in lost}


def test_errors_of_folds_predicted_from_the_others_are_those_of_fits_one_by_one():
    """Least squares of the columns themselves, weighted and with the prior."""
    normal = normal_equations(Wrong(payload=0.5, offset=np.array([0.4, 0.0, 0.0])))
    terms = [term for term in normal.terms if term.effect in ("torque.offset", "link.mass_moment")]
    data, store, rows = normal.store.data, normal.store, normal.rows
    weighted = Weighted(normal, np.zeros(len(rows)))
    squares = np.zeros(len(rows))
    for fold in range(normal.folds):
        stacked = [(store.wide(terms, row, normal.fixed), data.values[row], data.valid[row]) for row in rows]
        roots = np.sqrt(weighted.weights)
        x = np.concatenate([w * a[v & (data.folds != fold)] for w, (a, _, v) in zip(roots, stacked, strict=True)])
        y = np.concatenate([w * b[v & (data.folds != fold)] for w, (_, b, v) in zip(roots, stacked, strict=True)])
        index = normal.index(terms)
        root = np.sqrt(normal.prior[index])
        c = np.linalg.lstsq(np.vstack([x, np.diag(root)]), np.concatenate([y, normal.pull[index] / root]), rcond=None)[
            0
        ]
        for r, (a, b, v) in enumerate(stacked):
            pick = v & (data.folds == fold)
            squares[r] += np.sum((b[pick] - a[pick] @ c) ** 2)
    np.testing.assert_allclose(weighted.cross_validated(terms), squares / normal.count.sum(0), rtol=1e-5)


def test_what_columns_were_computed_from_is_freed_with_them():
    normal = normal_equations(Wrong(payload=0.5))
    (signals,) = normal.store.data.signals
    signals.sensitivity(0)
    normal.store.release()
    assert "_sensitivities" not in vars(signals)
    assert "_wrenches" not in vars(signals)
