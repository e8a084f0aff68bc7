"""Single parts of the blind check's plant against what their laws say: drives, friction, sensors, servos."""

from functools import partial
from pathlib import Path

import numpy as np

from sim_bus.effects.registry import imperfections
from sim_bus.effects.state import Imperfections
from sim_gap.blind import bench
from sim_gap.blind.arms import draw_arm
from sim_gap.blind.effects.drawn_effect import ArmSetting, DrawnEffect
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant import LATE_PHASE, Log, TrueArm, controller_bandwidth, record, true_arm
from sim_gap.blind.recipe import CaseRecipe, draw
from sim_gap.blind.scene import ServoLaw
from sim_gap.blind.servo_plant import STIFFEST, Bristles, record_servos, servo_targets

STEP = 5e-4
"""Of the plant of positions alone [s]."""


def truth(*effects: DrawnEffect) -> TrueArm:
    random = np.random.default_rng(0)
    return true_arm(draw_arm(random, 3), np.full(3, 10.0), random, effects)


def drawn(effect: str, **values: float) -> DrawnEffect:
    return DrawnEffect(effect, {"joint_2": values}, (ArmSetting(effect, "joint_2", values),))


def test_an_effect_is_added_to_the_small_errors_of_every_arm() -> None:
    sound, wrong = truth().state, truth(drawn("friction.coulomb", torque=2.0), drawn("actuator.gain", gain=1.2)).state
    np.testing.assert_allclose(wrong.coulomb - sound.coulomb, [0.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(wrong.actuator_gain, [sound.actuator_gain[0], 1.2, sound.actuator_gain[2]])
    assert (np.abs(sound.actuator_gain - 1.0) < 0.0031).all()


def test_a_late_drive_slows_the_controller_of_its_joint() -> None:
    arm = truth(drawn("actuator.lag", time=0.016))
    bandwidth = controller_bandwidth(arm)
    np.testing.assert_allclose(bandwidth, [arm.bandwidth, LATE_PHASE / (1.8 * 0.016), arm.bandwidth])
    assert bandwidth[1] < arm.bandwidth


def three_joints() -> Imperfections:
    return imperfections(("a", "b", "c"), ())


def test_breakaway_friction_falls_to_one_eth_at_stribecks_velocity() -> None:
    state = three_joints()
    state.coulomb[:], state.breakaway[:], state.stribeck_velocity[:] = 2.0, 1.0, 0.1
    bristles = Bristles(state, np.full(3, 0.1), STEP)
    for _ in range(400):
        force = bristles.force(np.full(3, 0.1), np.zeros(3))
    np.testing.assert_allclose(force, 2.0 + np.exp(-1.0), rtol=1e-3)


def test_bristles_of_a_light_link_are_soft_enough_for_the_time_step() -> None:
    state, inertia = three_joints(), np.full(3, 1e-3)
    state.coulomb[:] = 50.0
    assert (Bristles(state, inertia, STEP).bristle * STEP**2 / inertia <= STIFFEST * (1 + 1e-12)).all()


def test_a_sensor_reads_the_torque_in_whole_steps() -> None:
    arm = truth()
    arm.state.torque_gain[:], arm.state.torque_offset[:] = 1.0, 0.0
    torque = np.tile(np.array([7.0, -3.0, 0.1]), (500, 1))
    read = record(arm, torque, Log(*[torque] * 5), np.random.default_rng(0))
    step = 4.0 * 10.0 / 2**arm.encoder_bits
    np.testing.assert_allclose(read["tau"] / step, np.rint(read["tau"] / step), atol=1e-6)
    assert np.abs(read["tau"] - torque[0]).max() <= 6.0 * arm.torque_noise * 10.0


RAMP = 1e-3 * np.arange(200.0)[:, None]
"""The command of one joint, a milliradian a tick [rad]."""


def law(late: float = 0.0, slew: float = np.inf) -> ServoLaw:
    """Of one joint whose command arrives late [s] and is limited in speed [rad/s]."""
    zero = np.zeros(1)
    return ServoLaw(np.array([100.0]), zero, zero, np.array([late]), np.array([slew]), zero)


def test_a_servo_gets_its_command_late_by_a_number_of_ticks_that_need_not_be_whole() -> None:
    targets = servo_targets(law(late=2.25 / RATE), RAMP)
    np.testing.assert_allclose(targets[:, 0], 1e-3 * np.maximum(np.arange(200) - 2.25, 0.0), atol=1e-12)


def test_a_servo_follows_its_command_no_faster_than_its_slew() -> None:
    targets = servo_targets(law(slew=0.5e-3 * RATE), RAMP)
    np.testing.assert_allclose(targets[:, 0], 0.5e-3 * np.arange(200), atol=1e-12)


def test_positions_are_recorded_at_their_times_beside_the_command_of_their_turn() -> None:
    columns = record_servos(RAMP, RAMP, RATE / 5.0, 1e-4, np.random.default_rng(1))
    np.testing.assert_allclose(columns["q"][:, 0], 1e-3 * RATE * columns["t"], atol=2.5e-4)
    np.testing.assert_allclose(np.diff(columns["q_cmd"][:, 0]), 5e-3, atol=1e-12)


def test_servos_of_a_case_have_the_bandwidth_and_damping_of_hobby_servos() -> None:
    found = draw(CaseRecipe("case_0000", (), (4, 1), controller_known=True), 3.0, 3.0)
    assert found is not None
    law, inertia = found.scene.law, found.scene.inertia
    assert law is not None
    hz = np.sqrt(law.stiffness / inertia) / (2 * np.pi)
    assert ((hz >= 2.5) & (hz <= 5.0)).all()
    ratio = law.damping / (2.0 * np.sqrt(law.stiffness * inertia))
    assert ((ratio >= 0.7) & (ratio <= 1.1)).all()
    assert set(found.motions["train"]).isdisjoint(found.motions["heldout"])


def test_one_worker_diagnoses_in_this_process(tmp_path: Path) -> None:
    asked: list[str] = []

    def ask(name: str) -> dict[str, str]:
        asked.append(name)
        return {"verdict": name}

    digest = bench.seal_answers(tmp_path / "answers", {name: partial(ask, name) for name in "ab"}, workers=1)
    assert asked == ["a", "b"]
    assert [each["verdict"] for each in bench.verify(tmp_path / "answers", digest).values()] == asked
