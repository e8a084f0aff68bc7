"""Single figures of an answer: order of the causes, notes, shares, roll-outs."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.attribution import notes, rollout
from sim_gap.attribution.causes import order_of_effects
from sim_gap.attribution.diagnosis import Rollout
from sim_gap.attribution.position_answer import _where, running_free
from sim_gap.attribution.residual_laws import ResidualLaw, _LawCandidate
from sim_gap.attribution.rollout import RollOuts
from sim_gap.better_model.export import _line
from sim_gap.residuals.layout import ChannelLayout
from sim_gap.residuals.residual_set import Location, _features
from sim_gap.search.estimate import Value
from sim_gap.search.term import Term

COULOMB, OFFSET, PAYLOAD = Term("friction.coulomb", 0), Term("torque.offset", 0), Term("link.payload", 0)


def test_the_effect_that_takes_most_off_any_joint_comes_first() -> None:
    """The offset takes more off joint 1 than friction does off both."""
    falls = {COULOMB: np.array([0.2, 0.3]), OFFSET: np.array([0.5, 0.0])}
    scorer = SimpleNamespace(
        heldout=SimpleNamespace(layout=SimpleNamespace(n=2)),
        rms=lambda terms: np.ones(2) - sum((falls[term] for term in terms), np.zeros(2)),
        taken=lambda terms: sum((falls[term] for term in terms), np.zeros(2)),
    )
    steps = order_of_effects(SimpleNamespace(terms=(COULOMB, OFFSET)), scorer)
    assert [step.effect for step in steps] == ["torque.offset", "friction.coulomb"]
    np.testing.assert_allclose(steps[1].before, [0.5, 1.0])


def test_what_only_stands_for_another_effect_comes_after_it() -> None:
    """Alone, the offset takes off what the payload does; beside it, it is next to nothing."""
    alone = {PAYLOAD: np.array([0.6, 0.4]), OFFSET: np.array([0.7, 0.0])}
    own = {PAYLOAD: alone[PAYLOAD], OFFSET: np.array([0.02, 0.0])}
    scorer = SimpleNamespace(
        heldout=SimpleNamespace(layout=SimpleNamespace(n=2)),
        rms=lambda terms: np.ones(2) - np.max([np.zeros(2), *(alone[term] for term in terms)], axis=0),
        taken=lambda terms: sum((own[term] for term in terms), np.zeros(2)),
    )
    steps = order_of_effects(SimpleNamespace(terms=(OFFSET, PAYLOAD)), scorer)
    assert [step.effect for step in steps] == ["link.payload", "torque.offset"]


def test_a_remaining_gap_is_noted_with_its_regime_where_one_is_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Location("joint_1", "tau", "velocity", 0.5, 0.01, 0.6),
        Location("joint_2", "tau", "other", 0.4, 0.01, 0.0),
    ]
    monkeypatch.setattr(notes, "row_rms", lambda data, left: {("tau", 0): 0.5, ("tau", 1): 0.4})
    monkeypatch.setattr(notes, "locate", lambda data, left, above: found[: len(above)])
    said = notes._remaining(SimpleNamespace(margin={("tau", 0): 0.1, ("tau", 1): 0.1}), {})
    assert said[0].endswith("correlated with velocity (60%)")
    assert said[1].endswith("in no clear regime of motion")
    assert notes._remaining(SimpleNamespace(margin={("tau", 0): 0.9, ("tau", 1): 0.9}), {}) == ()


def test_a_joint_that_rests_tells_nothing_of_its_friction() -> None:
    moving = np.zeros((100, 2))
    moving[:10, 0] = 1.0
    layout = ChannelLayout(2, "tau", "tau_motor")
    signals = SimpleNamespace(moving=moving, arm=SimpleNamespace(names=("shoulder", "wrist")))
    (said,) = notes._at_rest(SimpleNamespace(signals=(signals,), layout=layout, rows=layout.rows))
    assert said.startswith("wrist hardly moves: its tau_motor")


def test_shares_of_the_position_gap_are_those_of_the_squares() -> None:
    found = SimpleNamespace(
        heldout_before=np.array([0.3, 0.4]),
        sim=SimpleNamespace(arm=SimpleNamespace(names=("shoulder", "elbow"))),
        search=SimpleNamespace(floor=np.array([0.001, 0.001])),
    )
    rows = _where(found)
    assert [row.joint for row in rows] == ["elbow", "shoulder"]
    assert [row.share for row in rows] == pytest.approx([0.64, 0.36])


def test_a_law_takes_the_share_of_the_squares_that_it_lowers() -> None:
    nothing = np.zeros(0)

    def law(before: float, after: float) -> ResidualLaw:
        return ResidualLaw("velocity", 0, "tau", False, nothing, nothing, nothing, before, after)

    assert law(2.0, 1.0).share == pytest.approx(0.75)
    assert law(0.0, 0.0).share == 0.0


def test_a_directed_law_turns_with_the_motion_and_is_nothing_at_rest() -> None:
    direction = np.array([[1.0], [0.5], [0.0], [-1.0]])
    half = np.full((4, 1), 0.5)
    signals = SimpleNamespace(q=half, v=half, model=half, direction=direction, filtered=lambda x: x)
    columns = _LawCandidate("position", True, np.array([0.0, 1.0])).columns(signals, 0)
    np.testing.assert_allclose(columns, 0.5 * direction * np.ones(2))


def test_reversals_are_where_a_joint_hardly_moves() -> None:
    """Within some hundredths of a radian a second; at 0.2 rad/s it is in full motion."""
    v = np.array([[0.0], [0.05], [0.2], [-0.2]])
    zero = np.zeros_like(v)
    signals = SimpleNamespace(t=np.arange(4.0), q=zero, v=v, a=zero + 1.0, direction=zero, model=zero)
    signals.filtered = lambda x: x
    np.testing.assert_allclose(_features(signals)["reversal"][:, 0, 0], [1.0, np.exp(-1.0), 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(("terms", "made"), [((PAYLOAD, OFFSET), [(1, 0.0), (2, 0.5)]), ((OFFSET,), [(0, 0.0)])])
def test_a_file_is_made_for_each_body_and_a_single_one_without(monkeypatch, terms, made) -> None:
    """Recordings 1 and 2 have the body, the second turned; the files without it are the same for both."""
    asked: list[tuple[int, float]] = []

    def arm(self: RollOuts, terms: list[Term], number: int, mount: float) -> tuple:
        asked.append((number, mount))
        return None, None

    monkeypatch.setattr(RollOuts, "_arm", arm)
    monkeypatch.setattr(rollout.forward_effects, "roll_out", lambda *given, windows: np.array([3.0, 4.0]))
    own = object.__new__(RollOuts)
    own.recordings = [SimpleNamespace(t=None, position=None, torque=None)] * 2
    own.bodies, own.channel, own.source = [(1, 0.0), (2, 0.5)], "torque", "sensor"
    np.testing.assert_allclose(own.of(terms, 4), [3.0, 4.0])
    assert asked == made


def test_the_line_of_an_effect_has_the_units_of_its_parameters() -> None:
    values = {"gain": Value(1.25, 1.2, 1.3, "1"), "offset": Value(0.5, 0.4, 0.6, "N·m")}
    estimate = SimpleNamespace(parameters=lambda term: values)
    sim = SimpleNamespace(arm=SimpleNamespace(names=("elbow",)))
    assert _line(sim, estimate, Term("torque.gain", 0)) == "torque.gain elbow gain 1.25, offset 0.5 N·m"


def test_a_written_model_that_runs_away_from_the_fit_is_said() -> None:
    """Joint b is off by more than three times its margin, joint a by less than three times what the fit leaves."""
    found = SimpleNamespace(
        heldout_after=np.array([0.02, 0.01]),
        margin=np.array([0.001, 0.05]),
        sim=SimpleNamespace(arm=SimpleNamespace(names=("a", "b"))),
    )
    far, near = (Rollout(6.0, np.full(2, np.nan), np.array([0.05, left]), closed_loop=True) for left in (0.2, 0.14))
    (note,) = running_free(found, far, gap=True)
    assert note.endswith("leaves a larger gap than the fit: b 0.2 rad (fit 0.01)")
    assert running_free(found, near, gap=True) == []
    assert running_free(found, None, gap=True) == []


def test_a_written_model_that_leaves_more_than_the_nominal_one_is_said() -> None:
    found = SimpleNamespace(
        heldout_after=np.array([0.02, 0.01]),
        margin=np.array([0.02, 0.02]),
        sim=SimpleNamespace(arm=SimpleNamespace(names=("a", "b"))),
    )
    better = Rollout(6.0, np.array([0.05, 0.02]), np.array([0.03, 0.03]), closed_loop=True)
    assert not better.worse
    assert running_free(found, better, gap=True) == []
    worse = Rollout(6.0, np.array([0.03, 0.03]), np.array([0.05, 0.02]), closed_loop=True)
    (note,) = running_free(found, worse, gap=False)
    assert note.endswith("use the nominal model")
    (note,) = running_free(found, worse, gap=True)
    assert note.startswith(
        "in a free-running simulation, the corrected model leaves a larger gap (0.0381 rad) than the nominal model "
        "(0.03 rad)"
    )
