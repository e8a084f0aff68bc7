"""Readings judge no record that was fitted to them: calibrate, identify, calibrate --apply on the same sweeps."""

from dataclasses import replace

import pytest
from sweep_arms import random_arm
from synthetic_sweeps import passes

from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.install import apply
from calib.install.apply import check_heldout, data_of, fitted_to
from calib.install.plausibility import Admitted


def test_a_record_is_not_judged_by_its_own_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = random_arm(1, 3)
    _, data = passes(arm, 1)
    fit = fit_sensors(arm, data)
    record = fit.record(arm)
    gravity = identify_gravity(arm, data, fit).record(arm, record)
    assert fitted_to(record, data_of(record))
    assert fitted_to(gravity, data_of(record))
    others = [replace(each, digest=f"{index}" * 64) for index, each in enumerate(data, start=1)]
    assert not fitted_to(record, {each.digest for each in others})

    judged: list[bool] = []

    def scores(*args: object, refit: bool, beta: object = None) -> str:
        if not refit:
            judged.append(beta is not None)
        return "errors"

    monkeypatch.setattr(apply, "heldout_scores", scores)
    monkeypatch.setattr(apply, "worse_joint", lambda new, old: None)
    check_heldout(record, record, arm, data, gravity)
    assert judged == []
    check_heldout(record, record, arm, others, gravity)
    assert judged == [True]
    check_heldout(record, record.model_copy(update={"sources": {}}), arm, data, gravity)
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
    assert fitted_to(after, data_of(same))
    assert not fitted_to(after, data_of(other)), "the same gravity record is no data"

    judged: list[str] = []
    monkeypatch.setattr(apply, "_keep", lambda *args: None)
    monkeypatch.setattr(apply, "admit", lambda record, *args: Admitted(record, arm, "all", after))
    monkeypatch.setattr(apply, "heldout_errors", lambda *args: (judged.append("judged"), "errors"))
    monkeypatch.setattr(apply, "worse_joint", lambda new, old: None)
    monkeypatch.setattr(apply, "_write", lambda *args: ())
    for record in (same, other):
        apply.apply_field(record, arm, None, None, None, None, apply.Apply("me"))  # type: ignore[arg-type]
        assert len(judged) == (record is other)
