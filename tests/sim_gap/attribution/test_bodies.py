"""Bodies that only some recordings have: found by what is left without them, and told apart by mass and moment."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.bodies import _turn, numbered_by_body, recordings_with_another_body
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import ABSENT, PreparedSignals, prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

BARE, LOADED = Wrong(), Wrong(payload=0.8)


def signals(wrong: Wrong, seed: int, number: int = 0) -> PreparedSignals:
    recording = record(model(), wrong, seed, seconds=12.0, rate=50.0, channels=("tau",))
    return replace(prepare(recording, load_model(model()).arm), number=number)


def data(*some: PreparedSignals) -> ResidualSet:
    return ResidualSet(some, layout_of(some))


@pytest.fixture(scope="module")
def loaded_second() -> EffectEstimate:
    """An estimate from two recordings, of which the second has a body."""
    train = data(signals(BARE, 1, 1), signals(LOADED, 2, 2))
    return EffectEstimate(ColumnStore(train), [Term("link.payload", 0, (2.0,))])


def test_another_recording_is_numbered_by_whether_the_body_explains_it(loaded_second: EffectEstimate) -> None:
    heldout = numbered_by_body(loaded_second, data(signals(LOADED, 3), signals(BARE, 4)))
    assert [s.number for s in heldout.signals] == [2, ABSENT]


def test_a_recording_with_a_body_that_no_training_recording_has_is_said() -> None:
    alone = EffectEstimate(ColumnStore(data(signals(BARE, 1, 1))), [Term("torque.offset", 0)])
    assert recordings_with_another_body(alone, data(signals(LOADED, 3), signals(BARE, 4))) == [0]


def test_a_body_is_turned_if_it_is_as_heavy_and_its_moment_as_large() -> None:
    s = SimpleNamespace(arm=SimpleNamespace(axis=np.array([[0.0, 0.0, 1.0]])))
    one, turned = np.array([1.0, 0.1, 0.0, 0.3]), np.array([1.0, 0.0, 0.1, 0.3])
    assert _turn(s, one, turned) == pytest.approx(np.pi / 2)
    assert _turn(s, turned, one) == pytest.approx(-np.pi / 2)
    assert _turn(s, one, 0.8 * turned) == pytest.approx(np.pi / 2)
    assert _turn(s, one, 0.4 * turned) == 0.0
    assert _turn(s, one, -turned) == 0.0
