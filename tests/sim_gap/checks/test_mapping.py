"""When a change of the columns that makes the model fit better is a finding."""

import numpy as np
import pytest
from wrong_arms import model

from armlink.recording.corrections import AS_IT_IS
from sim_gap.checks import mapping
from sim_gap.checks.rigid_fit import ChannelMotion, RigidFit
from sim_gap.model.load import load_model


def found(
    monkeypatch: pytest.MonkeyPatch, fall: float, explained: tuple[float, ...], slight: float = 0.0
) -> list[mapping.RecordingFinding]:
    """Findings if exchanging joints 2 and 3 lowers the cost by `fall` and explains this much of each joint.

    A zero that is slightly off lowers it by `slight`.
    """
    arm, rows = load_model(model()).arm, np.zeros((8, 3))
    ones = np.ones(3)
    fit = RigidFit(np.array(explained), ones, ones, np.array([0.9, 0.1, 0.1]), 0.0 * ones, ones)
    exchanged = mapping.Hypothesis(
        "order", ("q",), (1, 2), "is in another order", "--map q_2=q_3", lambda motion: motion
    )
    answers = [mapping.HypothesisTest(exchanged, fit, fall, doubted=False), None]
    monkeypatch.setattr(mapping, "_as_an_arm", lambda *_: fit)
    monkeypatch.setattr(mapping, "_best", lambda *_: answers.pop(0))
    monkeypatch.setattr(mapping, "least_cost", lambda *_: (float(fit.cost.sum()) - slight, 1, 0.2))
    return mapping.find_mapping(arm, ChannelMotion(rows, rows, rows, rows, "tau"), AS_IT_IS, (), arm)


def test_a_slight_fall_counts_only_if_every_joint_concerned_is_explained_then(monkeypatch):
    assert [each.corrected for each in found(monkeypatch, 0.37, (0.99, 0.9, 0.9))] == [True]
    assert found(monkeypatch, 0.37, (0.99, 0.59, 0.94)) == []
    assert found(monkeypatch, 0.37, (0.99, 0.55, 0.55)) == []


def test_a_clear_fall_is_corrected_or_asked_about(monkeypatch):
    assert [each.corrected for each in found(monkeypatch, 1.0, (0.99, 0.59, 0.94))] == [True]
    assert [each.corrected for each in found(monkeypatch, 1.0, (0.99, 0.55, 0.55))] == [False]


def test_an_order_that_a_slight_zero_explains_as_well_is_no_finding(monkeypatch):
    assert len(found(monkeypatch, 1.0, (0.99, 0.9, 0.9), slight=0.9)) == 1
    assert found(monkeypatch, 1.0, (0.99, 0.9, 0.9), slight=0.96) == []
