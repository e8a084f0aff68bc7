"""The creep fit: derivatives, recovery of drawn arms, what cannot be seen, sweeps with a contact."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_creeps import DrawnCreep, draw_creep, pushed, without
from judged_creeps import creep_arm

from armlink.arm_file import ArmFile, Kinematics, load_arm
from armlink.errors import Refused
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import CreepSection, SweepSection
from calib.fit.creep_fit import CreepFit, fit_rows
from calib.install.apply import Apply, apply_creep
from calib.install.plausibility import GateRefused
from calib.plan.creep_plan import plan_creep
from calib.plan.types import SweepPlan
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.verify import creep_complaint
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.motor_model import MotorModel

SIDEWAYS = (0.0, -9.80665, 0.0)
"""Along the first axis of OpenArm."""
QUICK = CreepSection(span=1.2, bin=0.12, speeds=(0.2, 0.1))


@cache
def arm(upright: bool = False) -> ArmFile:
    """OpenArm with short creeps; upright with its first axis along gravity."""
    found = load_arm("openarm").model_copy(update={"sweep": SweepSection(creep=QUICK)})
    if not upright:
        return found
    kinematics = Kinematics.model_validate({**found.kinematics.model_dump(exclude_unset=True), "gravity": SIDEWAYS})
    return found.model_copy(update={"kinematics": kinematics})


@cache
def plan(upright: bool = False) -> SweepPlan:
    return plan_creep(arm(upright))


def drawn(seed: int, order: str = "empty loaded empty", **changes: object) -> DrawnCreep:
    return draw_creep(without(arm(), **changes), plan(), seed, plan().reference_mass, order)


def fitted(made: DrawnCreep) -> CreepFit:
    return fit_rows(gcomp_arm(arm()), made.rows, arm().require_link().rated_torques)


def test_derivatives_agree_with_finite_differences() -> None:
    model, random = MotorModel(gcomp_arm(arm()), drawn(0).rows.readings), np.random.default_rng(0)
    x = 0.1 * random.standard_normal(model.size)
    x[model.slices["gain"]] = 1.1
    jacobian, step = model.linearised(x)[1], 1e-6
    for k in range(model.size):
        up, down = x.copy(), x.copy()
        up[k] += step
        down[k] -= step
        slope = (model.predict(up) - model.predict(down)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-6 * (1 + np.abs(slope).max()))


def test_an_arm_exactly_as_the_model_is_found_to_a_few_parts_in_ten_thousand() -> None:
    made = drawn(1, uneven=0.0, asymmetry=0.0, cogging=0.0, warming=0.0, heating=0.0)
    fit = fitted(made)
    off = np.abs(fit.value("gain") / made.truth.gain - 1)
    assert np.median(off) < 1e-3
    assert (off < 1.5 * fit.std("gain")).all()
    assert off.max() < 2.5e-3
    np.testing.assert_allclose(fit.value("coulomb"), made.state.coulomb, rtol=0.05, atol=0.01)
    np.testing.assert_allclose(fit.value("load"), made.state.uneven[:, 2], atol=0.01)
    assert not fit.findings


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", [2, 3])
def test_torque_constants_friction_and_gravity_of_a_drawn_arm(seed: int) -> None:
    made = drawn(seed)
    fit, described = fitted(made), gcomp_arm(arm())
    assert np.abs(fit.value("gain") / made.warm_gain - 1).max() < 0.015
    off = np.abs(fit.value("coulomb") - made.state.coulomb)
    assert (off < np.maximum(0.1, 0.15 * made.state.coulomb)).all()
    poses = np.random.default_rng(0).uniform(described.lower, described.upper, (200, 7))
    made.simulated.detach_mass()
    true = made.simulated.gravity_torque(poses)
    reading = poses - made.truth.position_offset
    found = gravity_torque(described, fit.beta, reading + fit.value("zero"))
    assert (np.sqrt(np.mean((found - true) ** 2, axis=0)) < 0.02 * np.abs(true).max(axis=0)).all()


def test_a_loaded_pass_alone_after_the_empty_one_passes_warming_off_as_scale() -> None:
    """Without temperatures the repeated empty pass tells how much the drives warmed up."""
    stds = {}
    for order in ("empty loaded", "empty loaded empty"):
        made = drawn(4, order, heating=0.0, warming_time=900.0)
        assert not made.rows.by_temperature
        fit = fitted(made)
        stds[order] = fit.std("gain") / made.warm_gain
        assert (np.abs(fit.value("gain") / made.warm_gain - 1) < 3 * stds[order]).all()
    worse = stds["empty loaded"] / stds["empty loaded empty"]
    assert worse.min() > 1
    assert worse.max() > 3


def test_without_a_mass_no_torque_constant_is_given() -> None:
    reasons = fitted(drawn(5, "empty empty")).reasons
    assert {joint for joint, parameter in reasons if parameter == "gain"} == set(arm().joint_names)
    assert "reference mass" in reasons[arm().joint_names[3], "gain"]


def test_a_vertical_axis_is_named_with_its_remedy() -> None:
    rated = arm(True).require_link().rated_torques
    assert any("openarm_right_joint1" in note and "tilted" in note for note in plan(True).notes)
    made = draw_creep(arm(True), plan(True), 6, plan(True).reference_mass)
    fit = fit_rows(gcomp_arm(arm(True)), made.rows, rated)
    reasons = fit.reasons
    assert "vertical" in reasons["openarm_right_joint1", "gain"]
    assert [joint for joint, parameter in reasons if parameter == "gain"] == ["openarm_right_joint1"]
    assert np.abs(fit.value("gain") / made.warm_gain - 1)[1:].max() < 0.015
    record = fit.record(arm(True))
    assert record.joints[0].gain is None
    assert not any(fit.gravity.record(arm(True), record).identifiable[:2])


@pytest.mark.long
def test_an_arm_whose_axes_meet_has_no_scale_until_the_place_of_the_mass_is_measured() -> None:
    wrist = creep_arm(16)
    planned = plan_creep(wrist)
    assert any("meet (nearly) in one point" in note for note in planned.notes)
    made = draw_creep(wrist, planned, 4, planned.reference_mass)
    rated = wrist.require_link().rated_torques
    fit = fit_rows(gcomp_arm(wrist), made.rows, rated)
    reasons = fit.reasons
    assert all("meet (nearly) in one point" in reasons[name, "gain"] for name in ("j2", "j3", "j4"))
    assert not fit.gravity.record(wrist, None).identifiable.count(True)
    measured = SweepSection(reference_point=tuple(made.truth.attachment + np.array([3e-4, -4e-4, 4e-4])))
    cured = fit_rows(gcomp_arm(wrist), made.rows, rated, measured.motor_doubt)
    assert [joint for joint, parameter in cured.reasons if parameter == "gain"] == ["j1"]
    off = cured.value("gain") / made.warm_gain - 1
    assert np.abs(off[1:] / (cured.std("gain") / made.warm_gain)[1:]).max() < 3
    assert np.abs(off[1:]).max() < 0.015
    assert len(plan_creep(wrist.model_copy(update={"sweep": measured})).notes) == 1


def test_a_push_on_one_sweep_is_named_and_left_out() -> None:
    made = drawn(7)
    rows = made.rows
    chosen = next(k for k, name in enumerate(rows.sweeps) if name == "pass 2, openarm_right_joint4 creep 1")
    place = rows.readings.position[:, 3]
    own = rows.readings.series == chosen
    beyond = np.maximum(place - np.median(place[own]), 0.0)
    touched = pushed(rows, np.where(own, 4.0 * beyond, 0.0))
    fit = fit_rows(gcomp_arm(arm()), touched, arm().require_link().rated_torques)
    assert [(each.kind, each.joint) for each in fit.findings] == [("contact", "openarm_right_joint4")]
    assert "pass 2, openarm_right_joint4 creep 1" in fit.findings[0].text
    assert np.abs(fit.value("gain") / made.warm_gain - 1).max() < 0.015


def test_records_keep_friction_and_temperature() -> None:
    made = drawn(8)
    record = fitted(made).record(arm())
    motor = record.joints[1].motor
    assert motor is not None
    assert motor.coulomb[0] == pytest.approx(made.state.coulomb[1], abs=0.1)
    assert motor.temperature is not None
    assert record.std("gain").max() < 0.01
    assert record.joints[-1].position_offset is None


def test_a_cable_that_pulls_in_every_sweep_is_named_and_no_constant_is_given(tmp_path: Path) -> None:
    made = drawn(9)
    rows = made.rows
    own = rows.swept == 3
    pull = np.where(own, 0.8 * (rows.readings.position[:, 3] - 1.0) * made.truth.gain[3], 0.0)
    fit = fit_rows(gcomp_arm(arm()), pushed(rows, pull), arm().require_link().rated_torques)
    assert [(each.kind, each.joint) for each in fit.findings] == [("spring", "openarm_right_joint4")]
    assert fit.findings[0].size == pytest.approx(0.8, abs=0.3)
    assert "cable" in fit.reasons["openarm_right_joint4", "gain"]
    store, how = RecordStore(str(tmp_path / "records.db")), Apply(by="ann", check=False)
    record = fit.record(arm())
    with pytest.raises(GateRefused, match=r"free the cable or spring.*--accept openarm_right_joint4"):
        apply_creep(record, arm(), store, how, fit.broken, None)
    assert store.current(CalibrationRecord, arm()) is None
    apply_creep(record, arm(), store, replace(how, accepted=("openarm_right_joint4",)), fit.broken, None)
    assert store.current(CalibrationRecord, arm()) == record
    assert not fitted(made).findings


def test_a_check_motion_decides_whether_a_record_comes_into_force(tmp_path: Path, monkeypatch) -> None:
    """Gates as for sensors; with --apply --bus, short creeps about the present pose have to agree with the fit."""
    fit, store, asked = fitted(drawn(8)), RecordStore(str(tmp_path / "records.db")), []
    how = Apply(by="ann", bus="socketcan:vcan7")
    record, ones = fit.record(arm()), np.ones(7)
    gravity = fit.gravity.record(arm(), record)
    check = partial(creep_complaint, arm=arm(), gravity=gravity, calibration=record)

    def opened(_: ArmFile, bus: str | None) -> object:
        asked.append(bus)
        link = SimpleNamespace(start=lambda: None, enable=lambda: None)
        return nullcontext(link)

    monkeypatch.setattr("calib.install.apply.open_arm", opened)
    for rms, fine in ((2 * ones, False), (0.5 * ones, True)):
        found = SimpleNamespace(names=arm().joint_names, rms=rms, tolerance=ones, passed=fine)
        monkeypatch.setattr("calib.sweep.verify.run_verify", lambda *_, found=found, **__: found)
        if fine:
            apply_creep(record, arm(), store, how, fit.broken, check)
        else:
            with pytest.raises(Refused, match=r"in the check motion the RMS difference to the model is 2 N·m"):
                apply_creep(record, arm(), store, how, fit.broken, check)
            assert store.current(CalibrationRecord, arm()) is None
    assert store.current(CalibrationRecord, arm()) == record
    assert asked == ["socketcan:vcan7"] * 2
    other = record.model_copy(
        update={"joints": tuple(each.model_copy(update={"gain": 1.3 * (each.gain or 1.0)}) for each in record.joints)}
    )
    with pytest.raises(GateRefused, match="--replaced"):
        apply_creep(other, arm(), store, replace(how, check=False), fit.broken, check)
    apply_creep(other, arm(), store, replace(how, check=False, replaced=arm().joint_names), fit.broken, check)
