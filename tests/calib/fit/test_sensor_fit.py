"""The fit against MuJoCo's gravity: it finds what the sensors do, its intervals hold, and it invents nothing."""

from dataclasses import replace

import numpy as np
import pytest
from sweep_arms import random_arm, synthetic_pass, with_section
from synthetic_sweeps import passes, plans

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import BadInput, Refused
from calib.dataset import SweepData
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import SensorFit, fit_sensors
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


def scores(fit: SensorFit, truth: Truth) -> np.ndarray:
    """Estimate minus truth in half widths of the 95 % interval."""
    parameters = ("gain", "offset", "position_gain")
    return np.array([(fit.value(p) - getattr(truth, p)) / fit.half95(p) for p in parameters])


@pytest.mark.sample(1)
@pytest.mark.parametrize(("seed", "n"), [(1, 3), (2, 4), (3, 5), (4, 6)])
def test_random_arms_are_calibrated_and_identified(seed: int, n: int) -> None:
    arm = random_arm(seed, n)
    truth, data = passes(arm, seed)
    fit = fit_sensors(arm, data)
    assert fit.reasons == {}
    assert np.abs(fit.value("gain") / truth.gain - 1).max() < 0.005
    rated = arm.require_link().rated_torques
    assert np.all(np.abs(fit.value("offset") - truth.offset) < 0.003 * rated)
    assert np.abs(fit.value("position_gain") - truth.position_gain).max() < 0.003
    gravity = identify_gravity(arm, data, fit)
    poses = np.random.default_rng(0).uniform(*_range(arm), (200, n))
    true = SimulatedArm(arm, truth).gravity_torque(poses)
    assert np.all(_rms(_torque(arm, gravity.beta, poses) - true) < 0.005 * np.abs(true).max(axis=0))
    assert gravity.recursive is not None
    assert np.all(_rms(_torque(arm, gravity.recursive.beta, poses) - true) < 0.02 * np.abs(true).max(axis=0))


@pytest.mark.long
def test_intervals_hold_the_truth() -> None:
    arm = random_arm(41, 4)
    inside = []
    bare, loaded = plans(arm, Truth.draw(arm, 0), 0)
    mass = bare.reference_mass
    for seed in range(12):
        truth, random = Truth.draw(arm, seed), np.random.default_rng(seed)
        data = [synthetic_pass(arm, truth, bare, 0.0, random), synthetic_pass(arm, truth, loaded, mass, random)]
        inside.append(np.abs(scores(fit_sensors(arm, data), truth)) < 1)
    assert 0.90 <= float(np.mean(inside)) <= 0.99


def test_a_vertical_joint_is_named_and_gets_no_gain() -> None:
    arm = load_arm("parallel6")
    truth, data = passes(arm, 1)
    fit = fit_sensors(arm, data)
    assert {key for key in fit.reasons if key[1] == "gain"} == {("base", "gain")}
    assert np.isnan(fit.value("gain")[0])
    assert abs(fit.value("offset")[0] - truth.offset[0]) < 0.05
    record = fit.record(arm)
    assert record.joints[0].gain is None
    assert "gravity does not act" in record.joints[0].not_identifiable["gain"]
    assert np.abs(fit.value("gain")[1:] / truth.gain[1:] - 1).max() < 0.01


def test_one_joint_that_gravity_acts_on_does_not_tell_its_gain_nor_where_the_mass_hung() -> None:
    arm = random_arm(4, 2, vertical=True)
    _, data = passes(arm, 4)
    fit = fit_sensors(arm, data)
    assert {key for key in fit.reasons if key[1] == "gain"} == {("j1", "gain"), ("j2", "gain")}
    assert fit.attachment is not None
    assert np.isnan(fit.attachment[0]).all()
    assert fit.attachment_text == "the place of the reference mass is not observable"


def test_a_single_joint_tells_its_gain_once_it_is_known_where_the_mass_hangs() -> None:
    arm = random_arm(5, 1)
    truth, data = passes(arm, 5)
    reason = fit_sensors(arm, data).reasons["j1", "gain"]
    assert "load_point_x" in reason
    assert reason.endswith("measure where the reference mass hangs (sweep.reference_point in the arm file)")
    known = fit_sensors(with_section(arm, reference_point=tuple(truth.attachment)), data)
    assert abs(known.value("gain")[0] / truth.gain[0] - 1) < known.half95("gain")[0] < 0.03


def test_where_all_axes_nearly_meet_it_says_so_and_a_measured_point_helps() -> None:
    """The mass has no lever but the one that is fitted with it: gains are right, but not to half a percent."""
    arm = random_arm(61, 3)
    rows = [row.model_copy(update={"a": 0.03, "d": 0.03}) for row in arm.kinematics.joints[:-1]]
    rows.append(arm.kinematics.joints[-1])
    arm = arm.model_copy(update={"kinematics": arm.kinematics.model_copy(update={"joints": tuple(rows)})})
    truth, data = passes(arm, 2)
    bare, plan = fit_sensors(arm, data), data[0].plan
    assert plan is not None
    assert "be found will be known to" in plan.notes[-1]
    assert set(bare.imprecise) == {"j1", "j2", "j3"}
    assert "measure where the reference mass hangs" in bare.imprecise["j1"]
    assert np.abs(scores(bare, truth)[0]).max() < 2
    measured = truth.attachment + np.array([4e-4, -4e-4, 3e-4])
    known = with_section(arm, reference_point=tuple(measured), reference_point_std=5e-4)
    cured = fit_sensors(known, data)
    assert cured.std("gain").max() < 0.4 * bare.std("gain").max()
    assert np.abs(scores(cured, truth)[0]).max() < 2
    assert known.description_hash == arm.description_hash


def test_without_a_reference_mass_only_ratios_are_told() -> None:
    arm = random_arm(5, 4)
    truth, data = passes(arm, 5)
    fit = fit_sensors(arm, data[:1])
    assert np.isnan(fit.value("gain")).all()
    assert "reference mass" in fit.reasons["j1", "gain"]
    assert np.isfinite(fit.value("offset")).all()
    assert fit.gain_ratio is not None
    np.testing.assert_allclose(fit.gain_ratio, truth.gain / truth.gain[-1], rtol=0.01)
    with pytest.raises(Refused, match="common factor"):
        identify_gravity(arm, data[:1], fit)


def test_a_calibration_record_lends_its_scale() -> None:
    arm = random_arm(6, 3)
    truth, data = passes(arm, 6)
    record = fit_sensors(arm, data).record(arm)
    gravity = identify_gravity(arm, data[:1], record)
    poses = np.random.default_rng(0).uniform(*_range(arm), (100, 3))
    true = SimulatedArm(arm, truth).gravity_torque(poses)
    assert np.all(_rms(_torque(arm, gravity.beta, poses) - true) < 0.01 * np.abs(true).max(axis=0))


def test_the_controllers_own_calibration_is_taken_out() -> None:
    arm = random_arm(7, 3)
    _, data = passes(arm, 7)
    applied = []
    for each in data:
        manifest = each.manifest.model_copy(update={"installed_gain": (1.25,) * 3, "installed_offset": (0.7,) * 3})
        readings = tuple(replace(row, torque=(row.torque - 0.7) / 1.25) for row in each.readings)
        applied.append(SweepData(each.path, manifest, readings, each.plan, each.resolution, each.digest))
    plain, other = fit_sensors(arm, data), fit_sensors(arm, applied)
    np.testing.assert_allclose(other.value("gain"), plain.value("gain"), rtol=1e-3)


def test_a_position_offset_that_is_known_better_than_readings_tell_stays_known_as_well() -> None:
    arm = random_arm(7, 3, sweep={"position_offset_std": 1e-5})
    fit = fit_sensors(arm, passes(arm, 7)[1])
    np.testing.assert_allclose(fit.fit.std.position_offset[:2], 1e-5, rtol=0.02)  # the last one cannot be told
    assert np.abs(fit.value("position_offset")).max() < 3e-5


def test_data_of_another_arm_are_refused() -> None:
    _, data = passes(random_arm(8, 3), 8)
    with pytest.raises(Refused, match="arm is random8"):
        fit_sensors(random_arm(9, 3), data)
    with pytest.raises(BadInput, match="no sweep readings"):
        fit_sensors(random_arm(9, 3), [])


def _range(arm: ArmFile) -> tuple[list[float], list[float]]:
    return [j.lower for j in arm.kinematics.joints], [j.upper for j in arm.kinematics.joints]


def _torque(arm: ArmFile, beta: np.ndarray, poses: np.ndarray) -> np.ndarray:
    from calib.arm.kinematics import gcomp_arm
    from gcomp.gravity.torque import gravity_torque

    return gravity_torque(gcomp_arm(arm), beta, poses)


def _rms(error: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(error**2, axis=0))
