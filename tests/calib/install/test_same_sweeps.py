"""Readings judge no record that was fitted to them: calibrate, identify, calibrate --apply on the same sweeps."""

from dataclasses import replace

import pytest
from sweep_arms import random_arm
from synthetic_sweeps import passes

from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.install import apply
from calib.install.apply import check_heldout, fitted_to


def test_a_record_is_not_judged_by_its_own_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = random_arm(1, 3)
    _, data = passes(arm, 1)
    fit = fit_sensors(arm, data)
    record = fit.record(arm)
    gravity = identify_gravity(arm, data, fit).record(arm, record)
    assert fitted_to(record, data)
    assert fitted_to(gravity, data)
    others = [replace(each, digest=f"{index}" * 64) for index, each in enumerate(data, start=1)]
    assert not fitted_to(record, others)

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
