"""The plan: every joint swept within its stops, resting joints pressed harder than gravity, never beyond the drive."""

import numpy as np
import pytest
from drawn_arms import drawn_arm
from sweep_arms import random_arm, synthetic_pass, with_section

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import BadInput
from calib.arm.kinematics import DriveLimits
from calib.plan.sweep_plan import plan_sweep, refuse_unbearable_mass
from calib.plan.types import APPROACH, SweepPlan
from calib.sweep.step_pass import rough_model
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


def scouted_plan(arm: ArmFile, truth: Truth) -> SweepPlan:
    data = synthetic_pass(arm, truth, plan_sweep(arm), 0.0, np.random.default_rng(0))
    return plan_sweep(arm, rough_model(arm, data.readings))


@pytest.mark.parametrize("name", ["sarcos", "parallel6"])
def test_the_plan_goes_from_tip_to_base_inside_the_stops(name: str) -> None:
    arm = load_arm(name)
    plan, limits = plan_sweep(arm), DriveLimits.of(arm)
    joints = [sweep.joint for sweep in plan.sweeps]
    assert joints == sorted(joints, reverse=True)
    assert set(joints) == set(range(len(arm.joint_names)))
    for sweep in plan.sweeps:
        assert limits.lower[sweep.joint] < sweep.steps[0] < sweep.steps[-1] < limits.upper[sweep.joint]
        assert sweep.stops[sweep.joint] == 0
        assert all(side != 0 for joint, side in enumerate(sweep.stops) if joint != sweep.joint)
    for pose in plan.scout:
        assert np.all((limits.lower < pose) & (pose < limits.upper))


def test_each_step_is_taken_from_both_sides() -> None:
    sweep = plan_sweep(random_arm(1, 3)).sweeps[0]
    targets = [sweep.target(index) for index in range(sweep.readings)]
    assert [position for position, side in targets if side > 0] == list(sweep.steps)
    assert [position for position, side in targets if side < 0] == list(reversed(sweep.steps))


def test_a_single_joint_has_no_other_to_be_held() -> None:
    arm = random_arm(5, 1)
    plan = scouted_plan(arm, Truth.of(arm))
    assert [sweep.stops for sweep in plan.sweeps] == [(0,)]
    assert not any("held" in note for note in plan.notes)


def test_combinations_that_hide_a_joint_from_gravity_are_avoided() -> None:
    plan = plan_sweep(load_arm("sarcos"))
    assert all(sweep.lever >= 0.3 for sweep in plan.sweeps)
    of_two = [sweep.stops for sweep in plan.sweeps if sweep.joint == 1]
    assert len(set(of_two)) == 2


def test_a_joint_along_gravity_is_swept_once_for_its_offset() -> None:
    plan = plan_sweep(load_arm("parallel6"))
    assert [sweep.lever for sweep in plan.sweeps if sweep.joint == 0] == pytest.approx([0.0], abs=1e-6)


@pytest.mark.parametrize(("seed", "n", "headroom"), [(1, 4, 1.8), (2, 5, 1.8), (3, 3, 1.3)])
def test_bias_exceeds_true_gravity_and_friction_and_never_the_limit(seed: int, n: int, headroom: float) -> None:
    """Checked with MuJoCo's gravity, which the plan has not seen."""
    arm = random_arm(seed, n, headroom=headroom)
    truth, limits = Truth.draw(arm, seed), DriveLimits.of(arm)
    simulated = SimulatedArm(arm, truth)
    pressed = 0
    for sweep in scouted_plan(arm, truth).sweeps:
        assert sweep.bias is not None
        bias, stops = np.array(sweep.bias), np.array(sweep.stops) * ~np.array(sweep.servo)
        assert np.all(np.abs(bias) <= limits.max_torque + 1e-9)
        poses = np.tile(sweep.rest, (30, 1))
        poses[:, sweep.joint] = np.linspace(sweep.steps[0], sweep.steps[-1], 30)
        spare = stops * (bias - simulated.gravity_torque(poses))
        assert np.all(spare[:, stops != 0] > 0.02 * limits.rated[stops != 0])
        pressed += int(np.count_nonzero(stops))
    assert pressed > 0


def test_joints_are_servo_held_where_the_bias_allowed_cannot_press_them() -> None:
    arm = with_section(random_arm(4, 4), bias_torque=(0.5, 0.5, 0.5, 0.5))
    plan = scouted_plan(arm, Truth.draw(arm, 4))
    assert any(any(sweep.servo) for sweep in plan.sweeps)
    assert any("held by their position loops" in note for note in plan.notes)
    assert all(abs(torque) <= 0.5 for sweep in plan.sweeps for torque in sweep.bias or ())


def test_the_reference_mass_overloads_no_joint() -> None:
    arm = random_arm(5, 5, headroom=1.4)
    truth, limits = Truth.draw(arm, 5), DriveLimits.of(arm)
    mass = scouted_plan(arm, truth).reference_mass
    simulated = SimulatedArm(arm, truth)
    simulated.attach_mass(mass)
    poses = np.random.default_rng(0).uniform(limits.lower, limits.upper, (300, 5))
    assert mass > 0.05
    assert np.all(np.abs(simulated.gravity_torque(poses)).max(axis=0) < limits.max_torque)


def test_servo_hold_presses_nothing() -> None:
    arm = with_section(random_arm(6, 3), hold="servo")
    for sweep in plan_sweep(arm).sweeps:
        assert sum(sweep.servo) == 2


@pytest.mark.parametrize("wrong", [0.98, 1.02])
def test_a_joint_held_by_its_servo_touches_no_stop_whatever_its_position_gain(wrong: float) -> None:
    """At 5.76 rad, where a Jaco's wrist has its stop, an encoder that reads 1 % too little is 0.06 rad off."""
    arm = with_section(random_arm(6, 3), hold="servo")
    joints = [joint.model_copy(update={"lower": 0.38, "upper": 5.76}) for joint in arm.kinematics.joints]
    arm = arm.model_copy(update={"kinematics": arm.kinematics.model_copy(update={"joints": joints})})
    for sweep in plan_sweep(arm).sweeps:
        angle = np.array(sweep.rest) / wrong
        assert np.all((angle > 0.39) & (angle < 5.75))


def test_held_joints_can_bear_the_reaction_of_the_one_that_moves() -> None:
    """Checked with MuJoCo's inertia, which the plan has not seen; this upright arm's first drive has little torque."""
    arm, truth = drawn_arm(9, upright=True, hold="servo")
    limits, simulated, slowed = DriveLimits.of(arm), SimulatedArm(arm, truth), 0
    for sweep in scouted_plan(arm, truth).sweeps:
        poses = np.tile(sweep.rest, (len(sweep.steps), 1))
        poses[:, sweep.joint] = sweep.steps
        reaction = np.array([np.abs(simulated.plant.inertia(pose)[sweep.joint]) for pose in poses])
        spare = limits.max_torque - np.abs(simulated.gravity_torque(poses))
        assert np.all(sweep.acceleration * reaction < spare) or sweep.acceleration == pytest.approx(0.3)
        slowed += sweep.acceleration < 3.0
    assert slowed > 0


def test_a_range_too_short_to_sweep_names_the_joint() -> None:
    with pytest.raises(BadInput, match=r"j1: of its range .* left to sweep, .* range_margin \(1\.5 rad\)"):
        plan_sweep(with_section(random_arm(7, 3), range_margin=1.5))


def test_a_step_is_approached_from_within_the_range_whatever_the_margin() -> None:
    arm = with_section(random_arm(7, 3), range_margin=1e-3)
    limits = DriveLimits.of(arm)
    for sweep in plan_sweep(arm).sweeps:
        assert limits.lower[sweep.joint] <= sweep.steps[0] - APPROACH
        assert sweep.steps[-1] + APPROACH <= limits.upper[sweep.joint]


def test_one_bias_torque_per_joint() -> None:
    with pytest.raises(BadInput, match=r"sweep\.bias_torque has 2 values, expected 3"):
        plan_sweep(with_section(random_arm(8, 3), bias_torque=(5.0, 5.0)))


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(4))
def test_a_reference_mass_beyond_the_drives_is_refused_before_anything_moves(seed: int) -> None:
    """Grams for kilograms above all; the mass that the message allows passes."""
    arm, _ = drawn_arm(seed)
    with pytest.raises(BadInput, match=r"no sweep of \w+ stays within max_torque: attach at most [\d.]+ kg") as refused:
        refuse_unbearable_mass(arm, 5000.0, None)
    most = float(str(refused.value).partition("at most ")[2].partition(" kg")[0])
    refuse_unbearable_mass(arm, 0.95 * most, None)
    with pytest.raises(BadInput, match="at most"):
        refuse_unbearable_mass(arm, 1.06 * most, None)
    assert plan_sweep(arm).reference_mass <= most
