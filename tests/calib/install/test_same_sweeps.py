"""Readings judge no record that was fitted to them: calibrate, identify, calibrate --apply on the same sweeps."""

from dataclasses import replace

import pytest
from sweep_arms import random_arm
from synthetic_sweeps import passes

from calib.fit import field_fit, gravity_fit
from calib.fit.field_fit import held_out_rows
from calib.fit.gravity_fit import held_out_steps, identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.records.records import HeldOut


def test_a_record_is_not_judged_by_its_own_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = random_arm(1, 3)
    _, data = passes(arm, 1)
    fit = fit_sensors(arm, data)
    record = fit.record(arm)
    gravity = identify_gravity(arm, data, fit).record(arm, record)
    assert record.is_fitted_to(record.data)
    assert gravity.is_fitted_to(record.data)
    others = [replace(each, digest=f"{index}" * 64) for index, each in enumerate(data, start=1)]
    assert not record.is_fitted_to({each.digest for each in others})

    judged: list[bool] = []

    def scores(*args: object, refit: bool, beta: object = None) -> str:
        if not refit:
            judged.append(beta is not None)
        return "errors"

    proof = HeldOut(against=record.id)
    monkeypatch.setattr(gravity_fit, "heldout_scores", scores)
    monkeypatch.setattr(gravity_fit, "held_out", lambda old, *errors: proof)
    assert held_out_steps(record, record, arm, data, gravity) == proof
    assert judged == []
    held_out_steps(record, record, arm, others, gravity)
    assert judged == [True]
    held_out_steps(record, record.model_copy(update={"sources": {}}), arm, data, gravity)
    assert judged == [True, False], "mass moments fitted to the same readings are estimated anew"


def test_nor_is_one_from_slow_motion_by_the_readings_of_the_record_before(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = random_arm(1, 3)
    _, data = passes(arm, 1)
    fit = fit_sensors(arm, data)
    before = fit.record(arm)
    from_gravity = {"gravity record 12345678": "12345678"}
    same = before.model_copy(update={"sources": {"unloaded": data[0].digest, **from_gravity}})
    other = before.model_copy(update={"sources": {"work.mcap": "f" * 64, **from_gravity}})
    after = before.model_copy(update={"sources": {**before.sources, **from_gravity}})
    assert after.is_fitted_to(same.data)
    assert not after.is_fitted_to(other.data), "the same gravity record is no data"

    judged: list[str] = []
    monkeypatch.setattr(field_fit, "heldout_errors", lambda *args: (judged.append("judged"), "errors"))
    monkeypatch.setattr(field_fit, "held_out", lambda old, *errors: HeldOut(against=old.id))
    for record in (same, other):
        assert held_out_rows(record, None, None, after) == HeldOut(against=after.id)  # type: ignore[arg-type]
        assert len(judged) == (record is other)
