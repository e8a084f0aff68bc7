"""Gains, friction and rotors at another scale: what a payload and larger gains stand for where rotors are lighter."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from sim_gap.model.load import load_model
from sim_gap.position_gap.controller import nominal_controller, nominal_point, scales_of
from sim_gap.position_gap.doubt import fits_at_other_scales, settle
from sim_gap.position_gap.fit import LoopFit, improve
from sim_gap.position_gap.search import LoopSearch
from sim_gap.position_gap.windows import windows_of

GAIN, ROTOR = 12.0, 0.02
REAL = model_text(kp=GAIN, friction=0.15)


def fitted_with(rotor: float) -> tuple[LoopSearch, LoopFit]:
    """A fit of gain and friction about a model that states such rotors [kg·m²]."""
    sim = load_model(mujoco.MjModel.from_xml_string(REAL.replace(f'armature="{ROTOR}"', f'armature="{rotor}"')))
    data = windows_of(sim.arm, [record(REAL, seed, 14.0, fast=2.0) for seed in (1, 2)], ["one", "two"])
    search = LoopSearch(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, 4e-4))
    names = ("kp", "coulomb", "viscous")
    return search, improve(data, LoopFit(search.nominal, (names, names)), search.scales, 12)


@pytest.fixture(scope="module")
def stated_too_heavy() -> tuple[LoopSearch, LoopFit]:
    return fitted_with(4 * ROTOR)


@pytest.mark.long
def test_rotors_that_are_stated_too_heavy_are_found(stated_too_heavy) -> None:
    search, fit = stated_too_heavy
    other = min(fits_at_other_scales(search, fit), key=lambda each: search.score(each).sum())
    assert other.point["armature"] == pytest.approx([ROTOR, ROTOR], rel=0.2)
    assert other.point["kp"] == pytest.approx([GAIN, GAIN], rel=0.05)
    assert (search.score(other) < search.score(fit)).all()
    found, _ = settle(search, fit, lambda stage: None)
    assert all("armature" in own for own in found.active)


def test_rotors_that_are_right_stay_as_stated() -> None:
    found, _ = settle(*fitted_with(ROTOR), lambda stage: None)
    assert not any("armature" in own for own in found.active)


def test_without_stated_rotors_or_with_them_withheld_there_is_no_other_scale(stated_too_heavy) -> None:
    search, fit = stated_too_heavy
    withheld = replace(search, excluded=frozenset({"actuator.rotor_inertia"}))
    assert list(fits_at_other_scales(withheld, fit)) == []
    weightless = replace(search, nominal={**search.nominal, "armature": np.zeros(2)})
    assert list(fits_at_other_scales(weightless, fit)) == []
    known = replace(fit, active=tuple((*own, "armature") for own in fit.active))
    assert list(fits_at_other_scales(search, known)) == []
