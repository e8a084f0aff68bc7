"""A hint that the surer causes can do without does not make an explanation ambiguous."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution import diagnose
from sim_gap.attribution.causes import _Scorer
from sim_gap.attribution.diagnosis import Cause, Signs
from sim_gap.attribution.verdict import carries, is_founded
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

SIGNS = Signs(1.0, 0.0, 1.0, 0.0)


def cause(effect: str, fall: float, confidence: float) -> Cause:
    return Cause(effect, ("joint_1",), {}, 10.0, 10.0 - fall, confidence, fall, SIGNS)


def test_a_cause_carries_by_what_it_takes_off():
    found = [cause("link.payload", 10.0, 0.95), cause("friction.stribeck", 5.0, 0.1), cause("torque.drift", 1.0, 0.1)]
    assert [carries(each, found) for each in found] == [True, True, False]


def test_what_is_missed_without_a_term_is_what_no_other_takes():
    """Friction that grows with speed: dry friction takes part of it, and is hardly missed beside viscous."""
    recording = record(model(), Wrong(viscous=0.8), seed=1, seconds=30.0, rate=50.0, channels=("tau_motor",))
    signals = prepare(recording, load_model(model()).arm)
    data = ResidualSet((signals,), layout_of([signals]))
    dry, viscous = Term("friction.coulomb", 1), Term("friction.viscous", 1)
    scorer = _Scorer(EffectEstimate(ColumnStore(data), [dry, viscous]), data)
    alone = np.max(scorer.rms([]) - scorer.rms([dry]))
    assert alone > 0.1
    assert scorer.missed([dry]) < 0.1 * alone
    assert scorer.missed([dry, viscous]) > 0.9 * alone


def test_a_cause_that_its_rival_could_replace_is_founded_together_with_it():
    """That a rival does as well leaves no evidence for either alone: the answer is ambiguous, not unexplained."""
    replaceable = replace(SIGNS, evidence=0.001, left=0.05)
    assert not is_founded(replaceable)
    assert is_founded(replaceable, rivals=1)
    assert not is_founded(replace(replaceable, left=1.0, elsewhere=0.5), rivals=1)


@pytest.mark.sample(1)
@pytest.mark.parametrize(("within", "named"), [(False, True), (True, False)])
def test_within_the_margins_what_may_be_nothing_is_no_cause(monkeypatch, within, named):
    """Beyond them it is one all the same: something makes the gap."""
    wrong = Wrong(coulomb=0.6)
    recordings = [record(model(), wrong, seed=seed, seconds=12.0, rate=50.0) for seed in (1, 2)]
    monkeypatch.setattr(diagnose, "is_within", lambda data: within)
    monkeypatch.setattr(EffectEstimate, "may_be_nothing", lambda self, term: True)
    answer = diagnose.diagnose(model(), recordings[:1], recordings[1:])
    assert any(cause.effect == "friction.coulomb" for cause in answer.causes) == named
