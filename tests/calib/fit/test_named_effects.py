"""Small errors of one sensor, named with their size, and scatter that is none."""

from dataclasses import replace

import numpy as np
import pytest
from examined_sweeps import JOINT, bent, swept
from sweep_arms import random_arm

from armlink.arm_file import ArmFile
from calib.dataset import SweepData
from calib.fit.sensor_fit import fit_sensors
from calib.motion.static_reading import StaticReading
from sim_bus.truth import Truth


@pytest.fixture(scope="module")
def sound() -> tuple[ArmFile, Truth, list[SweepData]]:
    arm = random_arm(51, 3)
    truth = Truth.draw(arm, 51)
    return arm, truth, swept(arm, truth, 51)


def test_a_sensor_whose_gain_grows_with_torque_is_named_with_the_growth(sound) -> None:
    arm, truth, data = sound
    largest = max(abs(reading.torque[JOINT]) for each in data for reading in each.readings)
    growth = 0.08

    def bend(_: StaticReading, __: np.ndarray, torque: np.ndarray) -> None:
        own = torque[JOINT] - truth.offset[JOINT]
        torque[JOINT] += growth * own * abs(own) / largest

    (found,) = fit_sensors(arm, bent(data, bend)).findings
    assert (found.joint, found.kind, found.unit) == ("j2", "nonlinear", "1")
    assert found.size == pytest.approx(growth / truth.gain[JOINT], rel=0.25)


def test_readings_that_all_scatter_more_than_their_samples_say_are_kept(sound) -> None:
    """No reading is left out where each is off by as much as all the others are."""
    arm, _, data = sound
    random, told = np.random.default_rng(8), []
    for each in data:
        readings = [
            replace(reading, torque=reading.torque + 2.5 * error * random.standard_normal(3))
            for reading in each.readings
            for error in [reading.torque_std / np.sqrt(reading.count)]
        ]
        told.append(replace(each, readings=tuple(readings)))
    fit = fit_sensors(arm, told)
    assert not any(found.kind == "outliers" for found in fit.findings)
    assert (fit.noise_factor > 1.5).all()
