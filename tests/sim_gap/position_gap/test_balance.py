"""Motion with servos that are switched off on the way: what the swing leaves does not hide what the servo leaves."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, written

from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import load_model
from sim_gap.position_gap.controller import nominal_controller, nominal_point
from sim_gap.position_gap.fit import LoopFit, evaluate
from sim_gap.position_gap.search import LEAST_COUNT, balance
from sim_gap.position_gap.windows import Windows, windows_of

GAIN, BRAKE, GEAR = 15.0, 0.8, 0.01
REAL = model_text(kp=GAIN, friction=0.01, damping=GEAR).replace(f'kp="{GAIN}"', f'kp="{GAIN}" kv="{BRAKE}"')
STIFFER = model_text(kp=8.0 * GAIN, friction=0.0, damping=0.0)
MOTORS = STIFFER.replace("<position", "<motor").replace(f' kp="{8.0 * GAIN}"', "")


@pytest.fixture(scope="module")
def swinging() -> tuple[Windows, LoopFit]:
    sim = load_model(mujoco.MjModel.from_xml_string(REAL))
    made = [record(REAL, 1, 18.0), record(REAL, 2, 12.0, released=4.0)]
    data = windows_of(sim.arm, made, ["held", "released"])
    point = nominal_point(data, nominal_controller(sim))
    return data, LoopFit({**point, "kp": 1.1 * point["kp"], "viscous": point["viscous"] + 0.02}, ((), ()))


def left(data: Windows, fit: LoopFit, off: np.ndarray) -> np.ndarray:
    """Mean square that a fit leaves of both kinds of windows as they are counted, (2, J)."""
    rms = evaluate(data, fit).rms
    count = data.weight.sum(0)
    seen = (data.weight > 0.0).sum(0)
    return np.array([(rms**2 * count * kind).sum(1) / (seen * kind).sum(1) for kind in (~off, off)])


def test_both_kinds_of_windows_count_as_much_where_a_swing_leaves_more(swinging) -> None:
    """The shoulder's leaves more, the elbow's less."""
    data, fit = swinging
    off = data.served.mean(0) < 0.5
    assert off.any(axis=1).all()
    assert not off.all(axis=1).any()
    held, free = left(data, fit, off)
    assert free[0] > 4.0 * held[0]
    assert free[1] < held[1]
    same = left(balance(data, fit), fit, off)
    np.testing.assert_allclose(same[:, 0], held[0], rtol=1e-9)
    np.testing.assert_array_equal(same[:, 1], (held[1], free[1]))
    np.testing.assert_array_equal(balance(data).weight > 0.0, data.weight > 0.0)
    assert (balance(data).weight[:, off] <= data.weight[:, off]).all()


def test_servos_that_are_never_off_or_always_change_nothing(swinging) -> None:
    data, fit = swinging
    on = replace(data, served=np.ones_like(data.served))
    assert balance(on, fit) is on
    never = balance(replace(data, served=np.zeros_like(data.served)), fit)
    np.testing.assert_array_equal(never.weight, data.weight)
    perfect = replace(data, measured=data.measured + 100.0 * (data.served.mean(0) < 0.5))
    off = data.served.mean(0) < 0.5
    assert balance(perfect, fit).weight[:, off].max() == pytest.approx(LEAST_COUNT)


@pytest.mark.long
@pytest.mark.parametrize("text", [STIFFER, MOTORS], ids=["servos in the model", "none"])
def test_a_swing_parts_friction_from_the_servos_brake_and_spoils_nothing(tmp_path: Path, text: str) -> None:
    """The servo's back-EMF brakes 80 times as much as the gear, which only the swing shows."""
    sim = written(tmp_path, text)
    train = [record(REAL, 1, 24.0), record(REAL, 2, 14.0, released=6.0)]
    answer = diagnose(sim, train, [record(REAL, 3, 18.0)])
    point = answer.internals.fit.point
    np.testing.assert_allclose(point["back_emf"], BRAKE, rtol=0.1)
    np.testing.assert_allclose(point["viscous"], GEAR, atol=0.02)
    np.testing.assert_allclose(point["kp"], GAIN, rtol=0.1)
    assert (answer.heldout_after < 0.004).all()
