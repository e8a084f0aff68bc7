"""Small troubles of a real arm: their columns against MuJoCo, their levels, and fits of realistic arms."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from drawn_arms import drawn_arm
from realistic_sweeps import RestingArm, both_passes, plans

from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.refinement import LEAST, RandomEffects, learn
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.fit.small_troubles import FAMILIES, UNITS, Lags, PositionField, Setting, kernel, troubles
from calib.fit.sweep_readings import SweepReadings
from calib.plan.types import SweepPlan
from gcomp.gravity.torque import gravity_regressor, gravity_torque
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from sim_bus.effects.state import Imperfections
from sim_bus.sim_section import with_realism
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

SEED = 5  # three joints
LARGEST = 5.0


@cache
def real(level: float) -> tuple[SensorFit, Truth, list[SweepData], RestingArm]:
    """An arm with troubles of this level, made and fitted once."""
    arm, truth = drawn_arm(SEED)
    now, data, resting = both_passes(with_realism(arm, level, SEED), truth, planned(), SEED)
    return fit_sensors(arm, data), now, data, resting


@cache
def planned() -> tuple[SweepPlan, SweepPlan]:
    return plans(*drawn_arm(SEED))


def test_a_field_in_columns_has_the_fields_covariance() -> None:
    poses = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 3))
    field = PositionField.over(poses, 2.0)
    columns = field.columns(poses)
    assert columns.shape[1] < 40
    assert np.abs(columns @ columns.T - kernel(poses, poses, 2.0)).max() < 0.02
    turned = poses + 2 * np.pi * np.array([1, 0, -1])
    assert field.columns(turned) == pytest.approx(columns)


def test_levels_of_drawn_effects_are_found() -> None:
    random, found = np.random.default_rng(1), []
    family = np.repeat([0, 1], 30)
    for _ in range(12):
        fixed, effects = random.normal(size=(120, 4)), random.normal(size=(120, 60))
        drawn = np.where(family == 0, 2.0, 0.4) * random.normal(size=60)
        target = fixed @ (10 * random.normal(size=4)) + effects @ drawn + random.normal(size=120)
        found.append(
            learn(RandomEffects.of(1e3 * fixed, effects, target, family, 2), np.ones(2), np.full(2, LARGEST)).level
        )
    assert np.mean(found, axis=0) == pytest.approx([2.0, 0.45], rel=0.15)


def test_nothing_to_find_leaves_what_the_readings_cannot_exclude_and_a_large_effect_the_largest_level() -> None:
    """A coefficient of 200 readings is known to 1/(3 √200) = 0.024, the level of forty to a fraction of that."""
    random = np.random.default_rng(2)
    effects, family = 3 * random.normal(size=(200, 40)), np.zeros(40, dtype=np.int64)
    for size, low, high in ((0.0, 1.1 * LEAST, 0.012), (60.0, LARGEST, LARGEST)):
        target = effects @ (size * random.normal(size=40)) + random.normal(size=200)
        found = RandomEffects.of(np.zeros((200, 1)), effects, target, family, 1)
        level = learn(found, np.ones(1), np.array([LARGEST])).level[0]
        assert low * (1 - 1e-9) <= level <= high * (1 + 1e-9)


def test_columns_of_turned_axes_are_the_changes_that_mujoco_gives() -> None:
    arm, truth = drawn_arm(SEED)
    described, n = gcomp_arm(arm), 3
    random = np.random.default_rng(3)
    q = random.uniform(described.lower, described.upper, (40, n))
    regressor = gravity_regressor(described, q).reshape(-1, 2 * n)
    plain = SimulatedArm(arm, truth).gravity_torque(q)
    beta = np.linalg.lstsq(regressor, plain.ravel(), rcond=None)[0]
    rows = _unloaded(q)
    fields = tuple(PositionField.over(q[:2], 1.0) for _ in range(n))
    setting = Setting(described, np.ones(n), fields, (0.0, 1.0), Lags.unknown(len(q), n))
    found = troubles(setting, rows, Parameters.nominal(n, beta=beta))
    assert gravity_torque(described, beta, q) == pytest.approx(plain, abs=1e-6)
    axes = found.columns[:, found.family == FAMILIES.index("axes")] / UNITS["axes"][0]
    assert axes.shape[1] == 2 * n
    for joint in range(n):
        for axis in range(2):
            simulated = SimulatedArm(arm, truth)
            state = Imperfections(arm.joint_names)
            state.frame_turn[joint, axis] = 1e-4
            simulated.plant.set_imperfections(state)
            change = (simulated.gravity_torque(q) - plain).ravel() / 1e-4
            columns = axes[:, 2 * joint : 2 * joint + 2]
            design = np.column_stack([regressor, columns])  # what mass moments can do is theirs
            left = change - design @ np.linalg.lstsq(design, change, rcond=None)[0]
            alone = change - regressor @ np.linalg.lstsq(regressor, change, rcond=None)[0]
            assert np.abs(left).max() < 2e-3 * np.abs(change).max() + 1e-6
            assert np.abs(alone).max() > 10 * np.abs(left).max() or np.abs(alone).max() < 1e-6


def _unloaded(q: np.ndarray) -> SweepReadings:
    nothing = np.full(q.shape, np.nan)
    return SweepReadings(
        readings=StaticReadings.of(q, np.zeros(q.shape), 1.0),
        sweeps=("one",),
        swept=np.full(len(q), -1),
        time=np.linspace(0, 1, len(q)),
        felt=nothing,
        motor_torque=nothing,
        target=nothing,
        position_sigma=np.zeros(q.shape[1]),
        resolution=np.zeros(q.shape[1]),
        warmest=np.full(q.shape[1], np.nan),
    )


@pytest.mark.sample(1)
@pytest.mark.parametrize("level", [1.0, 0.0, 3.0])
def test_a_realistic_arm_keeps_the_truth_within_its_intervals(level: float) -> None:
    fit, truth, *_ = real(level)
    assert fit.doubtful == ()
    for name in ("gain", "offset", "position_gain"):
        score = (fit.value(name) - getattr(truth, name)) / fit.std(name)
        assert np.nanmax(np.abs(score)) < 4, name


@pytest.mark.long
def test_the_told_discrepancy_grows_with_the_arms_and_is_what_new_poses_show() -> None:
    arm, _ = drawn_arm(SEED)
    rated, told, seen = arm.require_link().rated_torques, [], []
    for level in (0.0, 1.0, 3.0):
        fit, _, _, resting = real(level)
        record = fit.record(arm)
        assert (record.discrepancy("length") > 0.1).all()
        told.append(record.discrepancy("level") / rated)
        random, begin, free = np.random.default_rng(int(level)), resting.time, np.full(3, np.nan)
        errors = []
        for pose in random.uniform(resting.plant.lower + 0.1, resting.plant.upper - 0.1, (40, 3)):
            resting.time = begin
            shown, torque, _ = resting.read(resting.sensors.reading_of(pose), free, seconds=0.0)
            model = gravity_torque(gcomp_arm(arm), fit.fit.complete.beta, record.angle(shown))
            errors.append(record.torque_calibration().invert(torque) - model)
        seen.append(np.sqrt(np.mean(np.square(errors), axis=0)) / rated)
    assert (told[0] < 2e-4).all()
    assert (told[1] > 5e-4).all()
    assert (told[2] > 2 * told[1]).all()
    assert (seen[1] < 2.5 * told[1]).all()
    assert (seen[2] < 2.5 * told[2]).all()
    assert (np.mean(seen, axis=1) > 0.3 * np.mean(told, axis=1)).all()


@pytest.mark.long
def test_more_readings_of_the_same_poses_do_not_make_it_certain() -> None:
    """Four times the readings halve what differs from pass to pass, noise and drift; effects of the pose stay."""
    arm, _ = drawn_arm(SEED)
    fit, _, data, _ = real(3.0)
    again = [replace(each, path=Path(f"{each.path}-{copy}")) for copy in range(4) for each in data]
    repeated = fit_sensors(arm, again)
    assert (repeated.std("gain") > 0.6 * fit.std("gain")).all()
