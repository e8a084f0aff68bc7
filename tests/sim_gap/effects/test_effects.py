"""Every effect's columns against the change of torque that MuJoCo gives when the effect is really there."""

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.effects.registry import LAWS, effects, library_without
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import Columns, layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term

LIBRARY = {
    "link.mass_moment", "link.inertia", "link.payload", "base.tilt", "position.offset", "position.gain",
    "position.eccentricity", "torque.offset", "torque.gain", "torque.drift", "timing.delay", "friction.coulomb",
    "friction.viscous", "friction.stribeck", "friction.asymmetric", "friction.load", "transmission.ripple",
    "transmission.spring", "transmission.coupling", "actuator.gain", "actuator.rotor_inertia",
}  # fmt: skip


def at(joint: int, value: float, other: float = 0.0) -> np.ndarray:
    return np.array([value if j == joint else other for j in range(3)])


def residuals(wrong: Wrong, channels=("tau", "tau_motor")) -> ResidualSet:
    nominal = load_model(model())
    signals = prepare(record(model(), wrong, noise=0.0, seconds=25, channels=channels), nominal.arm)
    return ResidualSet((signals,), layout_of([signals]))


def columns_of(data: ResidualSet, effect: str, place: int, shape: tuple[float, ...] = ()) -> Columns:
    return ColumnStore(data).columns(Term(effect, place, shape))


def inner(data: ResidualSet) -> np.ndarray:
    """Samples away from the ends, where the filters still ring."""
    return (data.time > 1.0) & (data.time < data.time.max() - 1.0)


CASES = {
    "friction.coulomb": (Wrong(coulomb=at(1, 0.8)), 1, (), [0.8]),
    "friction.viscous": (Wrong(viscous=at(1, 0.8)), 1, (), [0.8]),
    "friction.stribeck": (Wrong(breakaway=at(1, 0.8)), 1, (0.1,), [0.8]),
    "friction.load": (Wrong(load=at(0, 0.1)), 0, (), [0.1]),
    "actuator.rotor_inertia": (Wrong(rotor=at(2, 0.4)), 2, (), [0.4]),
    "actuator.gain": (Wrong(motor_gain=at(1, 1.25, 1.0)), 1, (), [1 / 1.25 - 1]),
    "torque.gain": (Wrong(gain=at(1, 1.1, 1.0)), 1, (), [0.1]),
    "torque.offset": (Wrong(offset=at(1, 0.5)), 1, (), [0.5]),
    "torque.drift": (Wrong(drift=at(1, 0.02)), 1, (), [0.02]),
    "transmission.spring": (Wrong(spring=at(1, 2.0)), 1, (), [2.0, 0.0]),
    "transmission.ripple": (
        Wrong(ripple=at(1, 0.6), cycles=9.0), 1, (9.0,), [0.6 * np.cos(0.4), 0.6 * np.sin(0.4)],
    ),
    "position.offset": (Wrong(position_offset=at(1, 0.02)), 1, (0.02,), [0.02]),
    "base.tilt": (Wrong(tilt=(2e-3, -1e-3)), 0, (), [2e-3, -1e-3]),
    "link.mass_moment": (Wrong(moved={1: (0.001, 0.002, 0.0)}), 1, (), [0.003, 0.006, 0.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_columns_times_the_true_parameters_are_the_residual(name: str):
    wrong, place, shape, coefficients = CASES[name]
    data = residuals(wrong)
    columns = columns_of(data, name, place, shape)
    for row in data.rows:
        expected = columns[row] @ np.array(coefficients) if row in columns else np.zeros(len(data.values[row]))
        valid = data.valid[row] & inner(data)
        error = data.values[row][valid] - expected[valid]
        assert rms(error) < 0.03 * max(rms(expected[valid]), 0.1), row


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def test_a_sensor_effect_shows_in_both_rows_with_opposite_sign_and_a_motor_effect_in_one():
    data = residuals(Wrong())
    sensor = columns_of(data, "torque.offset", 1)
    np.testing.assert_allclose(sensor["tau", 1], -sensor["tau_motor", 1])
    assert set(columns_of(data, "friction.coulomb", 1)) == {("tau_motor", 1)}
    assert set(columns_of(data, "link.mass_moment", 1)) == {("tau", 0), ("tau", 1)}


def test_the_library_holds_at_least_these_effects():
    assert set(effects()) >= LIBRARY
    for name in library_without([]):
        effect = effects()[name]
        assert effect.reported
        assert all(need in effects() for need in effect.needs)


def test_what_stands_upon_an_effect_that_is_taken_out_goes_with_it() -> None:
    whole = set(library_without([]))
    assert whole == {name for name in effects() if name not in LAWS}
    left = library_without(["friction.coulomb"])
    assert whole - set(left) == {"friction.coulomb", "friction.stribeck", "friction.asymmetric"}
    assert whole - set(library_without(["friction.stribeck"])) == {"friction.stribeck"}


@pytest.mark.parametrize("effect", ["position.offset", "position.gain"])
def test_a_position_error_moves_the_bodies_not_the_spring_that_was_found(effect: str) -> None:
    """The column over a small error is the model's change alone: a spring's torque divided by it mimics the spring."""
    store = ColumnStore(residuals(Wrong(spring=at(1, 2.0))))
    term = Term(effect, 0, (-0.002,))
    about = store.at({Term("transmission.spring", 1): np.array([2.0, 0.1])})
    for row, column in store.columns(term).items():
        assert about.columns(term)[row] == pytest.approx(column, abs=1e-3 * np.abs(column).max() + 1e-9)
