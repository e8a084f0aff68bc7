"""Columns and signals about an estimate, and single steps of search and fit, each against its own definition."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from gcomp.arm.inertials import point_mass
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import FLOOR, FLOOR_INNER, layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search import gauss_newton, model_selection
from sim_gap.search.column_store import ColumnStore, signals_about
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.gauss_newton import _closest, _positive, _shapes
from sim_gap.search.model_selection import relinearised_in_place, select_model
from sim_gap.search.term import Term

PAYLOAD, SPRING = Term("link.payload", 0), Term("transmission.spring", 1)
COULOMB, GAIN = Term("friction.coulomb", 1), Term("actuator.gain", 1)


@pytest.fixture(scope="module")
def data() -> ResidualSet:
    wrong = Wrong(coulomb=0.5, viscous=0.3, breakaway=0.4, payload=0.3, drift=0.02)
    read = prepare(record(model(), wrong, seed=1, seconds=12.0, rate=50.0), load_model(model()).arm)
    return ResidualSet((read,), layout_of([read]))


def test_an_estimate_with_a_payload_has_the_torque_of_the_arm_with_that_mass(data: ResidualSet) -> None:
    (read,) = data.signals
    c = np.array([0.4, 0.01, 0.02, 0.08])
    inertial = read.arm.inertial.copy()
    inertial[-1] += point_mass(0.4, c[1:])
    expected = replace(read.arm, inertial=inertial).torque(read.q, read.v, read.a)
    np.testing.assert_allclose(signals_about(read, data.layout, {PAYLOAD: c}).signals.model, expected, atol=1e-9)


def test_shares_of_springs_and_bodies_add_up_to_the_change_of_the_torque(data: ResidualSet) -> None:
    (read,) = data.signals
    width = next(iter(ColumnStore(data).columns(SPRING).values())).shape[1]
    found = signals_about(
        read, data.layout, {SPRING: np.array([5.0, 0.3])[:width], PAYLOAD: np.array([0.4, 0.0, 0.0, 0.1])}
    )
    total = np.zeros_like(read.q)
    for rows in found.shares.values():
        for (channel, joint), share in rows.items():
            total[:, joint] += share * (channel == data.layout.against_model)
    np.testing.assert_allclose(found.signals.model - read.model, total, atol=1e-9)
    assert np.abs(found.shares[SPRING][data.layout.against_model, 1]).max() > 0.1


def test_the_motor_of_an_estimate_makes_up_for_its_friction(data: ResidualSet) -> None:
    (read,) = data.signals
    found = signals_about(read, data.layout, {COULOMB: np.array([0.5])})
    share = found.shares[COULOMB][data.layout.motor_side, 1]
    np.testing.assert_allclose(found.signals.motor_model[:, 1] - read.motor_model[:, 1], share, atol=1e-9)
    moving = np.abs(read.v[:, 1]) > 0.2
    np.testing.assert_allclose(share[moving], 0.5 * np.sign(read.v[moving, 1]), atol=1e-9)


def test_between_motor_and_sensor_less_of_a_gap_is_worth_a_parameter(data: ResidualSet) -> None:
    for joint, usual in enumerate(data.usual_torque):
        for channel, share in (("tau", FLOOR), ("tau_motor", FLOOR_INNER)):
            floor = data.floor[channel, joint]
            least = data.least(0.01)
            expected = np.sqrt(floor**2 + (share * usual) ** 2 + least**2)
            assert data.relevance_floor[channel, joint] == pytest.approx(expected)
    assert FLOOR_INNER < FLOOR < 0.05


def test_what_an_effect_needs_is_at_hand_for_its_parameters(data: ResidualSet) -> None:
    """The asymmetry is told as a share of the Coulomb friction fitted beneath it."""
    terms = [COULOMB, Term("friction.asymmetric", 1)]
    estimate = EffectEstimate(ColumnStore(data), terms)
    asymmetric = next(term for term in estimate.terms if term.effect == "friction.asymmetric")
    (ratio,) = estimate.parameters(asymmetric).values()
    size = float(estimate.of(asymmetric)[0])
    coulomb = float(estimate.of(next(term for term in estimate.terms if term.effect == "friction.coulomb"))[0])
    assert ratio.value == pytest.approx(size / coulomb)


def test_friction_that_is_clearly_there_has_a_narrow_interval(data: ResidualSet) -> None:
    """Sound arms differ by some hundredths of a newton metre, not by all that a joint has."""
    estimate = EffectEstimate(
        ColumnStore(data), [COULOMB, Term("friction.viscous", 1), Term("friction.stribeck", 1, (0.1,))]
    )
    (torque,) = estimate.parameters(estimate.terms[0]).values()
    assert torque.low < 0.5 < torque.high
    assert torque.high - torque.low < 1.5


def test_constants_beside_any_mass_moments_are_known_to_an_error_that_all_masses_share() -> None:
    read = prepare(record(model(), Wrong(), 1, 12.0, 50.0, channels=("tau_motor",)), load_model(model()).arm)
    data = ResidualSet((read,), layout_of([read]))
    gains = [Term(GAIN.effect, joint) for joint in range(3)]
    for links in ((), range(3)):
        estimate = EffectEstimate(ColumnStore(data), [*gains, *(Term("link.mass_moment", link) for link in links)])
        (gain,) = estimate.parameters(next(term for term in estimate.terms if term.effect == GAIN.effect)).values()
        assert gain.low < 1.0 < gain.high
        assert gain.high - gain.low > 2 * 0.015


def test_what_is_not_there_may_be_nothing_by_its_interval(data: ResidualSet) -> None:
    terms = [COULOMB, Term("friction.viscous", 1), Term("friction.stribeck", 1, (0.1,)), GAIN]
    estimate = EffectEstimate(ColumnStore(data), terms)
    found = {term.effect: term for term in estimate.terms}
    (gain,) = estimate.parameters(found["actuator.gain"]).values()
    assert gain.low < 1.0 < gain.high
    assert estimate.may_be_nothing(found["actuator.gain"])
    assert not estimate.may_be_nothing(found["friction.coulomb"])


def test_a_body_that_cannot_exist_gives_way_to_the_closest_that_can() -> None:
    """Of a diagonal matrix 1 + x, the coefficient beyond −1 ends there and the other one stays."""
    best = _closest(np.array([-2.0, 0.3]), np.eye(2), lambda x: np.diag(1.0 + x))
    np.testing.assert_allclose(best, [-1.0, 0.3], atol=1e-2)
    assert best[0] > -1.0


@pytest.mark.parametrize("seed", [22, 24, 32])
def test_the_closest_body_can_exist_where_slsqp_ends_outside(seed: int) -> None:
    random = np.random.default_rng(seed)
    columns, own = random.normal(size=(30, 3)) * [1, 10, 100], random.normal(size=(3, 4, 4))

    def matrix(x: np.ndarray) -> np.ndarray:
        return np.diag([1e-3, 1e-3, 1e-3, 1.0]) + np.tensordot(x, own + own.swapaxes(1, 2), 1)

    assert _positive(matrix(_closest(random.normal(size=3), columns.T @ columns, matrix)))


def test_a_link_is_shaped_by_its_inertia_and_the_last_by_a_payload() -> None:
    assert _shapes(Term("link.inertia", 1), 1, 3)
    assert not _shapes(Term("link.inertia", 1), 2, 3)
    assert not _shapes(Term("link.mass_moment", 1), 1, 3)
    assert _shapes(PAYLOAD, 2, 3)
    assert not _shapes(PAYLOAD, 0, 3)
    assert not _shapes(Term("link.mass_moment", 2), 2, 3)


@dataclass(frozen=True)
class Bent:
    """A nonlinear term that counts how often it was linearised anew."""

    effect: str
    moves: bool
    times: int = 0

    @property
    def key(self) -> tuple[str, int]:
        return self.effect, 0

    @property
    def form(self) -> SimpleNamespace:
        signature = SimpleNamespace(moves=np.zeros if self.moves else None, offset=None)
        return SimpleNamespace(signature=signature, hints=SimpleNamespace(linearised_at=0.0))

    def relinearised(self, c: np.ndarray) -> "Bent":
        return Bent(self.effect, self.moves, self.times + 1)


def test_a_step_moves_positions_and_linearises_other_effects_where_they_are() -> None:
    turned, bent = Bent("position.offset", True), Bent("torque.hysteresis", False)
    terms, values = gauss_newton.relinearised_at({turned: np.array([0.3]), bent: np.array([0.7])})
    assert [term.times for term in terms] == [0, 1]
    assert values == {terms[0]: [0.3], terms[1]: [1.0]}  # a secant's size is in its shape


def test_nonlinear_effects_are_offered_at_the_size_that_they_have_in_place_of_a_chosen_one(monkeypatch) -> None:
    bent, chosen = Bent("torque.hysteresis", False), Bent("friction.coulomb", False)

    def choice(terms: list[Bent], current: list[Bent]) -> SimpleNamespace:
        return SimpleNamespace(
            current=current,
            effects=dict.fromkeys(terms),
            without=lambda term, names: [other for other in names if other != term],
            shortlist=lambda rest, offered, most: offered[:most],
            with_needs=lambda term, rest: [*rest, term],
            judge=lambda terms: 0.0,
            values=lambda terms: dict.fromkeys(terms, np.array([0.5])),
        )

    monkeypatch.setattr(model_selection, "TermEquations", lambda store, terms: terms)
    monkeypatch.setattr(model_selection, "TermChoice", choice)
    assert [term.times for term in relinearised_in_place(None, [chosen], [bent])] == [2]
    assert relinearised_in_place(None, [], [bent]) == [bent]


@pytest.mark.parametrize(("score", "kept", "other"), [(1.0, "several", 1.0), (3.5, "first", 1.5)])
def test_one_cause_in_place_of_several_errors_of_links_is_kept_if_it_scores_better(
    monkeypatch, score, kept, other
) -> None:
    def found(name: str, score: float) -> SimpleNamespace:
        store = SimpleNamespace(keep=lambda terms: None)
        return SimpleNamespace(name=name, score=score, current=[name], equations=SimpleNamespace(store=store))

    results = iter([found("first", 2.0), found("several", score)])
    monkeypatch.setattr(model_selection, "first_search", lambda store, library: ([], []))
    monkeypatch.setattr(model_selection, "search_again", lambda store, chosen, offered: next(results))
    monkeypatch.setattr(model_selection, "one_cause_of_gravity", lambda store, choice, offered: [[PAYLOAD]])
    monkeypatch.setattr(model_selection, "every_constant", lambda choice, offered: [])
    choice = select_model(SimpleNamespace(keep=lambda terms: None), [])
    assert choice.name == kept
    assert [each for each, _ in choice.others] == [other]
