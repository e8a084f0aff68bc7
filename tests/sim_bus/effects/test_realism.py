"""A realistic arm: drawn troubles, their size, and what they do to plant and sensors."""

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.errors import BadInput
from sim_bus.effects.realism import add_realism
from sim_bus.effects.state import Imperfections
from sim_bus.physics.joint_torques import Cables
from sim_bus.sim_section import with_realism
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ARM = load_arm("sarcos")
RATED = ARM.require_link().rated_torques
FIELDS = ("eccentricity", "cubic", "hysteresis", "crosstalk", "warm_up", "cable", "compliance", "frame_turn", "uneven")


def drawn(level: float, seed: int = 3) -> Imperfections:
    state = Imperfections(ARM.joint_names)
    add_realism(state, RATED, level, seed)
    return state


def test_level_0_is_a_perfect_arm_and_every_trouble_is_there_at_level_1() -> None:
    none, good = drawn(0), drawn(1)
    for name in (*FIELDS, "frame_shift", "tilt"):
        assert not getattr(none, name).any(), name
        assert getattr(good, name).any(axis=-1).all(), name


def test_sizes_grow_with_the_level_and_the_seed_draws_another_arm() -> None:
    good, bad = drawn(1), drawn(3)
    for name in ("cubic", "hysteresis", "crosstalk", "compliance", "frame_turn", "frame_shift", "tilt"):
        assert getattr(bad, name) == pytest.approx(3 * getattr(good, name)), name
    assert not np.allclose(drawn(1, seed=4).cubic, good.cubic)


def test_a_level_beyond_the_range_is_one_clear_line() -> None:
    with pytest.raises(BadInput, match="realism 11: key level"):
        with_realism(ARM, 11)


def test_kinematics_and_base_change_gravity_torque_by_a_small_share() -> None:
    poses = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 7))
    exact = SimulatedArm(ARM, Truth.of(ARM)).gravity_torque(poses)
    real = SimulatedArm(with_realism(ARM, 1.0, 2), Truth.of(ARM)).gravity_torque(poses)
    change = np.sqrt(np.mean((real - exact) ** 2, axis=0))
    assert (change > 0).all()
    assert (change < 0.01 * np.abs(exact).max()).all()


def test_zeros_move_while_the_arm_warms_up_and_the_truth_says_so() -> None:
    simulated = SimulatedArm(with_realism(ARM, 3.0, 2), Truth.of(ARM))
    cold = simulated.true_sensors.offset
    simulated.time = 1e5
    warm = simulated.true_sensors.offset
    assert np.abs(warm - cold) == pytest.approx(np.abs(simulated.plant._imperfections.warm_up[:, 0]))
    assert warm == pytest.approx(np.zeros(7))


def test_a_cable_pulls_back_and_lags() -> None:
    state = Imperfections(("a", "b"))
    state.cable[0] = 2.0, 0.5, 0.0, 1.0, 0.2
    cables = Cables(state, np.zeros(2), np.zeros(2))
    up = cables.torque(np.array([1.0, 0.0]))
    down = cables.torque(np.array([0.9, 0.0])), cables.torque(np.array([0.0, 0.0]))
    assert up == pytest.approx([-3.0, -1.5])  # 2·1 of the spring, and the whole pull that lags; half of it on the next
    assert down[0] == pytest.approx(np.array([-1.0, -0.5]) * (1.8 + 0.5))
    assert down[1] == pytest.approx([1.0, 0.5])


def test_the_arm_still_holds_and_reads_what_its_troubles_make_of_it() -> None:
    simulated = SimulatedArm(with_realism(ARM, 1.0, 1), Truth.of(ARM))
    simulated.advance(0.2)
    plant = simulated.plant
    assert np.abs(plant.velocity).max() < 1e-3  # the brakes hold
    assert plant.motor_position - plant.position == pytest.approx(
        plant._imperfections.compliance * plant.link_torque, abs=1e-6
    )
