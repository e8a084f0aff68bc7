"""Hard cases, one at a time: the fit names joint and cause, or its intervals still hold; sound data raise nothing."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from examined_sweeps import JOINT, bent, rated, swept, z_scores
from rank_test import undetermined
from sweep_arms import random_arm

from armlink.arm_file import ArmFile, load_arm
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.examination import _without_plateaus
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.fit.sweep_readings import sweep_readings
from calib.motion.encoder_check import missing_bit, stuck_bits
from calib.motion.static_reading import StaticReading
from gcomp.gravity.torque import gravity_torque
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

PUBLISHED = np.array([0.64, 1.01, 0.77, 0.65, 0.42, 0.20, 0.16])
"""RMS of a real arm's best model, joint by joint [N·m]."""


@pytest.fixture(scope="module")
def sound() -> tuple[ArmFile, Truth, list[SweepData]]:
    arm = random_arm(51, 3)
    truth = Truth.draw(arm, 51)
    return arm, truth, swept(arm, truth, 51)


def test_sound_data_raise_nothing(sound) -> None:
    arm, truth, data = sound
    fit = fit_sensors(arm, data)
    assert fit.findings == ()
    assert fit.doubtful == ()
    assert np.abs(z_scores(fit, truth, "gain")).max() < 4
    assert all(each.ratio < 3 for each in fit.goodness.left_out)
    assert {each.sweep for each in fit.goodness.left_out} >= {f"pass-0/{sweep.name}" for sweep in data[0].plan.sweeps}
    assert {key for key in fit.reasons if key[1] != "position_offset"} == undetermined(arm, data)


def test_a_cable_spring_is_named_and_taken_out(sound) -> None:
    arm, truth, data = sound
    stiffness = 0.04 * rated(arm)

    def pull(_: StaticReading, position: np.ndarray, torque: np.ndarray) -> None:
        torque[JOINT] += truth.gain[JOINT] * stiffness * position[JOINT]

    fit = fit_sensors(arm, bent(data, pull))
    assert fit.doubtful == ("j2",)
    (spring,) = fit.findings
    assert (spring.joint, spring.kind) == ("j2", "spring")
    assert spring.size == pytest.approx(stiffness, rel=0.1)
    assert np.abs(z_scores(fit, truth, "gain")).max() < 4


def test_hysteresis_is_measured_and_the_intervals_hold(sound) -> None:
    arm, truth, data = sound
    width = 0.03 * rated(arm)

    def lag(reading: StaticReading, _: np.ndarray, torque: np.ndarray) -> None:
        if reading.joint == JOINT:
            torque[JOINT] -= reading.direction[JOINT] * width

    fit = fit_sensors(arm, bent(data, lag))
    assert fit.doubtful == ()
    assert fit.findings[0].joint == "j2"
    assert fit.findings[0].kind in ("direction", "hysteresis")
    assert fit.hysteresis[JOINT] == pytest.approx(-width, rel=0.05)
    assert np.abs(z_scores(fit, truth, "gain")).max() < 4
    assert np.abs(z_scores(fit, truth, "offset")).max() < 4


def drawn_lag(seed: int, width: float) -> Callable[[StaticReading, np.ndarray, np.ndarray], None]:
    """A lag of the joint's sensor: nearly even along each of its sweeps, anywhere within the play where it holds."""
    random, by_sweep = np.random.default_rng(seed), dict[str, float]()

    def lag(reading: StaticReading, _: np.ndarray, torque: np.ndarray) -> None:
        if reading.joint == JOINT:
            size = by_sweep.setdefault(reading.sweep, random.uniform(0.6, 1.0))
            torque[JOINT] -= reading.direction[JOINT] * size * width * random.uniform(0.9, 1.0)
        elif reading.joint is None:
            torque[JOINT] += random.uniform(-width, width)
        else:
            torque[JOINT] += by_sweep.setdefault(f"{reading.sweep} held", random.uniform(-width, width))

    return lag


@pytest.mark.long
def test_a_lag_of_another_size_in_each_sweep_stays_within_the_intervals(sound) -> None:
    arm, truth, data = sound
    scores = []
    for seed in range(8):
        fit = fit_sensors(arm, bent(data, drawn_lag(seed, 0.03 * rated(arm))))
        assert [finding.kind for finding in fit.findings] == ["direction"]
        assert fit.noise_factor[JOINT] < 2, "the scatter is the lag's, not the noise's"
        scores += [z_scores(fit, truth, "gain"), z_scores(fit, truth, "offset")]
    assert np.mean(np.abs(scores) < 1.96) > 0.9
    assert np.abs(scores).max() < 4


def test_a_saturated_sensor_is_named(sound) -> None:
    arm, _, data = sound
    limit = 0.6 * max(
        abs(reading.torque[JOINT]) for each in data for reading in each.readings if reading.joint == JOINT
    )

    def clip(_: StaticReading, __: np.ndarray, torque: np.ndarray) -> None:
        torque[JOINT] = np.clip(torque[JOINT], -limit, limit)

    fit = fit_sensors(arm, bent(data, clip))
    assert "j2" in fit.doubtful
    found = [finding for finding in fit.findings if (finding.joint, finding.kind) == ("j2", "saturation")]
    assert any("readings at different poses" in finding.text for finding in found)
    assert abs(found[0].size) == pytest.approx(limit, rel=1e-3)


def test_what_was_touched_is_left_out_and_named(sound) -> None:
    arm, truth, data = sound
    name = next(sweep.name for sweep in data[0].plan.sweeps if sweep.joint == JOINT)

    def knock(reading: StaticReading, _: np.ndarray, torque: np.ndarray) -> None:
        if reading.sweep == name and reading.index == 2:
            torque[JOINT] += 0.08 * rated(arm)

    fit = fit_sensors(arm, bent(data[:1], knock) + data[1:])
    (finding,) = fit.findings
    assert (finding.joint, finding.kind) == ("j2", "outliers")
    assert name in finding.text
    assert np.abs(z_scores(fit, truth, "gain")).max() < 4


@pytest.fixture(scope="module")
def upright() -> tuple[ArmFile, Truth, list[SweepData]]:
    """An arm whose first joint carries no gravity: all its readings are alike."""
    arm = random_arm(52, 3, vertical=True)
    truth = Truth.draw(arm, 52)
    return arm, truth, swept(arm, truth, 52)


def test_a_knock_does_not_make_a_joint_without_gravity_saturate(upright) -> None:
    arm, _, data = upright

    def knock(reading: StaticReading, _: np.ndarray, torque: np.ndarray) -> None:
        if reading.joint is None and reading.index == 0:
            torque[0] += 0.3 * rated(arm)

    fit = fit_sensors(arm, bent(data, knock))
    assert {finding.kind for finding in fit.findings} == {"outliers"}
    assert fit.doubtful == ()


def test_an_arm_that_swung_while_it_was_read_counts_by_its_swing(upright) -> None:
    arm, truth, data = upright
    random, swing = np.random.default_rng(4), 0.1 * rated(arm)
    swung = []
    for each in bent(data, lambda *_: None):
        readings = [
            replace(
                reading,
                settled=False,
                torque=reading.torque + swing * random.standard_normal(len(reading.torque)),
                torque_std=np.hypot(reading.torque_std, swing),
            )
            if reading.joint is None and reading.index < 2
            else reading
            for reading in each.readings
        ]
        swung.append(replace(each, readings=tuple(readings)))
    fit = fit_sensors(arm, swung)
    assert fit.findings == ()
    for parameter in ("gain", "offset", "position_gain"):
        assert np.nanmax(np.abs(z_scores(fit, truth, parameter))) < 4


def test_a_sensor_that_was_silent_while_the_arm_had_not_settled_tells_nothing_and_breaks_nothing(sound) -> None:
    arm, truth, data = sound
    first, *others = data[0].readings
    lost = np.where(np.arange(len(first.torque)) == 0, np.nan, 0.0)
    silent = replace(first, settled=False, torque=first.torque + lost, torque_std=first.torque_std + lost)
    fit = fit_sensors(arm, [replace(data[0], readings=(silent, *others)), *data[1:]])
    assert fit.findings == ()
    assert np.abs(z_scores(fit, truth, "gain")).max() < 4


@pytest.mark.filterwarnings("error")
def test_a_joint_without_readings_shows_no_limit(sound) -> None:
    arm, _, data = sound
    rows = sweep_readings(data)
    torque = rows.readings.torque.copy()
    torque[:, JOINT] = np.nan
    silent = replace(rows, readings=replace(rows.readings, torque=torque))
    assert _without_plateaus(arm.joint_names, silent) == (silent, [])


@pytest.mark.sample(1)
@pytest.mark.parametrize(("bit", "level"), [(6, 0), (9, 1), (11, 0)])
def test_a_stuck_encoder_bit_is_named(sound, bit: int, level: int) -> None:
    arm, _, data = sound
    step = data[0].resolution[JOINT]

    def stick(_: StaticReading, position: np.ndarray, __: np.ndarray) -> None:
        count = round(position[JOINT] / step)
        count = count | (1 << bit) if level else count & ~(1 << bit)
        position[JOINT] = count * step

    fit = fit_sensors(arm, bent(data, stick))
    (finding,) = fit.findings
    assert (finding.joint, finding.kind) == ("j2", "encoder")
    assert f"bit {bit}" in finding.text


def test_a_sound_encoder_has_no_stuck_bit() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        position = random.uniform(-1, 1, (40, 1))
        assert not list(stuck_bits(np.round(position, 4), np.array([1e-4]), position))


@pytest.mark.parametrize("bit", [None, *range(2, 12)])
def test_a_motion_tells_a_stuck_bit_and_a_sound_encoder_none(bit: int | None) -> None:
    random = np.random.default_rng(1 if bit is None else bit)
    for _ in range(200 if bit is None else 10):
        goal = random.uniform(1, 3) * (1 if bit is None or bit > 8 else 0.3) * 2**14
        path = np.cumsum(np.hanning(random.integers(100, 1500)))
        path *= goal / path[-1]
        late = np.interp(np.arange(len(path)) - random.uniform(0, 10), np.arange(len(path)), path)
        stuck_by_friction = random.uniform(0, 8)  # the joint goes on only where it lags by so much
        held = np.floor(late / stuck_by_friction) * stuck_by_friction
        counts = np.rint(held + random.uniform(0, 2**14)).astype(int)
        seen = counts if bit is None else counts & ~(1 << bit)
        found = missing_bit(seen.astype(float), path)
        assert found == bit or (bit == 2 and found is None)  # four counts: a fast motion does not tell


@pytest.mark.long
def test_a_range_of_sixty_degrees_leaves_the_intervals_true() -> None:
    arm = random_arm(52, 3)
    kinematics = arm.kinematics.model_copy(
        update={
            "joints": tuple(
                joint.model_copy(update={"upper": joint.lower + np.pi / 3}) if joint.name == "j2" else joint
                for joint in arm.kinematics.joints
            )
        }
    )
    short = arm.model_copy(update={"kinematics": kinematics})
    truth = Truth.draw(short, 52)
    fit = fit_sensors(short, swept(short, truth, 52))
    assert fit.doubtful == ()
    for parameter in ("gain", "offset", "position_gain"):
        assert np.nanmax(np.abs(z_scores(fit, truth, parameter))) < 4


@pytest.mark.long
def test_held_out_torque_of_the_papers_arm_is_three_times_better_than_published() -> None:
    arm = load_arm("sarcos")
    truth = Truth.draw(arm, 7)
    data = swept(arm, truth, 7)
    fit = fit_sensors(arm, data)
    described = gcomp_arm(arm)
    poses = np.random.default_rng(8).uniform(described.lower, described.upper, (200, 7))
    reading = truth.gain * SimulatedArm(arm, truth).gravity_torque(poses) + truth.offset
    sensor = (reading - fit.value("offset")) / fit.value("gain")
    shown = poses / truth.position_gain * fit.value("position_gain") + fit.fit.complete.position_offset
    model = gravity_torque(described, identify_gravity(arm, data, fit).beta, shown)
    rms = np.sqrt(((sensor - model) ** 2).mean(axis=0))
    assert np.all(rms < PUBLISHED / 3)
