"""A reference mass that was forgotten, or stated wrong, is noticed whatever the gains are; one that is there is not."""

import numpy as np
import pytest
from sweep_arms import random_arm, synthetic_pass
from synthetic_sweeps import passes, plans

from calib.arm.kinematics import gcomp_arm
from calib.fit.sensor_fit import felt_mass, mass_complaint
from calib.fit.sweep_readings import sweep_readings
from sim_bus.truth import Truth


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_mass_that_is_there_is_felt(seed: int) -> None:
    arm = random_arm(seed, 3 + seed % 3)
    _, data = passes(arm, seed)
    readings = sweep_readings(data).readings
    assert felt_mass(gcomp_arm(arm), readings) == pytest.approx(readings.load.max(), rel=0.3)
    assert mass_complaint(gcomp_arm(arm), readings) is None


@pytest.mark.sample(2)
@pytest.mark.parametrize("share", [0.0, 4.0, 0.1])
def test_a_mass_that_is_forgotten_or_another_is_named(share: float) -> None:
    arm = random_arm(5, 4)
    truth, random = Truth.draw(arm, 5), np.random.default_rng(5)
    bare, loaded = plans(arm, truth, 5)
    mass = bare.reference_mass
    data = [synthetic_pass(arm, truth, bare, 0.0, random), synthetic_pass(arm, truth, loaded, share * mass, random)]
    stated = data[1].manifest.model_copy(update={"reference_mass": mass})
    from dataclasses import replace

    readings = sweep_readings([data[0], replace(data[1], manifest=stated)]).readings
    assert felt_mass(gcomp_arm(arm), readings) == pytest.approx(share * mass, rel=0.3, abs=0.1 * mass)
    assert f"--reference-mass was {mass:g} kg" in (mass_complaint(gcomp_arm(arm), readings) or "")
