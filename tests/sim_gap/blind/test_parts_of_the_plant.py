"""Single parts of the blind check's plant against what their laws say: drives, friction, sensors, servos."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.blind import bench
from sim_gap.blind.arms import draw_arm
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant.controller import FINE, ServoLaw, ServoRun, Servos
from sim_gap.blind.plant.drive import STIFFEST, Bristles, PlantDrives
from sim_gap.blind.plant.sensors import record
from sim_gap.blind.servo_cases import ServoRecipe, draw, recorded
from sim_gap.blind.true_arm import Log, TrueArm, sound_arm

STEP = 5e-4
"""Of the plant [s]."""


def truth(rated: float = 10.0) -> TrueArm:
    random = np.random.default_rng(0)
    return sound_arm(draw_arm(random, 3), np.full(3, rated), random)


def test_a_drive_with_a_lag_follows_a_step_by_all_but_one_eth_in_that_time() -> None:
    arm = truth()
    arm.motor_lag[:] = 21 * STEP
    drives = PlantDrives([arm], np.full((1, 3), 0.1), np.zeros((1, 3)), [np.zeros(3)], STEP)
    for _ in range(21):
        drives._follow(np.ones((1, 3)))
    np.testing.assert_allclose(drives.current, 1.0 - np.exp(-1.0), rtol=1e-9)


def test_breakaway_friction_falls_to_one_eth_at_stribecks_velocity() -> None:
    arm = truth()
    arm.coulomb[:], arm.viscous[:], arm.breakaway[:], arm.stribeck_velocity[:] = 2.0, 0.0, 1.0, 0.1
    bristles = Bristles([arm], np.full((1, 3), 0.1), STEP)
    for _ in range(400):
        force = bristles.force(np.full((1, 3), 0.1), np.zeros((1, 3)))
    np.testing.assert_allclose(force, 2.0 + np.exp(-1.0), rtol=1e-3)


def test_bristles_of_a_light_link_are_soft_enough_for_the_time_step() -> None:
    arm, inertia = truth(), np.full((1, 3), 1e-3)
    arm.coulomb[:] = 50.0
    assert (Bristles([arm], inertia, STEP).bristle * STEP**2 / inertia <= STIFFEST * (1 + 1e-12)).all()


def test_a_sensor_reads_the_torque_in_whole_steps() -> None:
    arm = truth()
    arm.torque_noise[:], arm.torque_gain[:], arm.torque_offset[:] = 0.0, 1.0, 0.0
    torque = np.tile(np.array([7.0, -3.0, 0.1]), (500, 1))
    read = record(arm, Log(torque, torque, torque, torque, torque), 250.0, False, torque, np.random.default_rng(0))
    step = 4.0 * 10.0 / 2**16
    np.testing.assert_allclose(read["tau"] / step, np.rint(read["tau"] / step), atol=1e-6)
    assert np.abs(read["tau"] - torque[0]).max() <= 0.5 * step + 1e-12


def servo_run(late: float) -> ServoRun:
    """One joint with a ramp of 1 mrad a tick as its command, which arrives late [s]."""
    zero = np.zeros(1)
    law = ServoLaw(np.array([100.0]), zero, zero, np.array([late]), np.array([np.inf]), zero)
    ramp = 1e-3 * np.arange(200.0)[:, None]
    return ServoRun(SimpleNamespace(n=1, encoder_step=1e-4), ramp, 0.0 * ramp, np.ones(1), 1, law)


def test_a_servo_gets_its_command_late_by_a_number_of_ticks_that_need_not_be_whole() -> None:
    servos = Servos([servo_run(2.25 / RATE)], np.zeros((1, 1)), 1)
    torques = [float(servos.command(tick, np.zeros((1, 1)))[0, 0]) for tick in range(20)]
    np.testing.assert_allclose(torques, 0.1 * np.maximum(np.arange(20) - 2.25, 0.0), atol=100.0 * FINE)


def test_positions_are_recorded_at_their_times_beside_the_command_of_their_turn() -> None:
    run, random = servo_run(0.0), np.random.default_rng(1)
    hz = RATE / 5.0
    columns = recorded(run, Log(*[run.command] * 5), hz, random)
    np.testing.assert_allclose(columns["q"][:, 0], 1e-3 * RATE * columns["t"], atol=2.5 * run.truth.encoder_step)
    np.testing.assert_allclose(np.diff(columns["q_cmd"][:, 0]), 5e-3, atol=1e-12)


def test_servos_of_a_case_have_the_bandwidth_and_damping_of_hobby_servos() -> None:
    found = draw(ServoRecipe("case_0000", "", True, (4, 1)), (3.0, 3.0), 0)
    assert found is not None
    inertia = found.runs[0].inertia
    hz = np.sqrt(found.law.stiffness / inertia) / (2 * np.pi)
    assert ((hz >= 2.5) & (hz <= 5.0)).all()
    ratio = found.law.damping / (2.0 * np.sqrt(found.law.stiffness * inertia))
    assert ((ratio >= 0.7) & (ratio <= 1.1)).all()
    assert set(found.motions["train"]).isdisjoint(found.motions["heldout"])


def test_one_worker_diagnoses_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "answer_case", lambda diagnose, cases, case, withheld: (case, diagnose(case)))
    asked: list[str] = []
    assert list(bench._answers(asked.append, None, [("a", ""), ("b", "")], 1)) == [("a", None), ("b", None)]
    assert asked == ["a", "b"]
