"""Changes of an arm without torque sensors, found in its work: gain, friction, payload; else nothing."""

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from drawn_creeps import DrawnCreep, draw_creep
from drawn_work import NOTHING, Change, work
from judged_creeps import creep_arm

from calib.arm.kinematics import gcomp_arm
from calib.daemon.state.events import describe
from calib.fit.creep_fit import fit_rows
from calib.observer.cause_test import CauseTest
from calib.observer.decision import Event
from calib.observer.evidence import ChangeHypothesis, Residuals
from calib.observer.gravity_belief import GravityBelief
from calib.observer.motor_belief import MotorBelief
from calib.observer.observer import Observer, observer_of
from calib.plan.creep_plan import plan_creep
from calib.records.records import CalibrationRecord, GravityRecord

SEED = 4
"""Four joints, the first upright."""
UNCHANGED, AFTER = 420, 300


@cache
def calibrated() -> tuple[Any, DrawnCreep, CalibrationRecord, GravityRecord]:
    arm = creep_arm(SEED)
    plan = plan_creep(arm)
    made = draw_creep(arm, plan, SEED, plan.reference_mass)
    fit = fit_rows(gcomp_arm(arm), made.rows, arm.require_link().rated_torques)
    record = fit.record(arm)
    return arm, made, record, fit.gravity.record(arm, record)


def observer() -> Observer:
    arm, _, record, gravity = calibrated()
    made = observer_of(gcomp_arm(arm), record, gravity, arm.require_link().rated_torques)
    assert isinstance(made._belief, MotorBelief)
    return made


@cache
def worked() -> tuple[dict[str, Any], float]:
    """An observer that has learned from work without a change, saved; and the arm's time then."""
    arm, made, record, _ = calibrated()
    watching, random = observer(), np.random.default_rng(1)
    rows = work(arm, made, record, random, UNCHANGED)
    assert [event for row in rows for event in watching.handle_row(row)] == []
    return watching.save(), made.simulated.time


def observed(change: Change, watching: Observer) -> list[Event]:
    (arm, made, record, _), (state, time) = calibrated(), worked()
    assert watching.restore(state)
    made.simulated.time = time
    rows = work(arm, made, record, np.random.default_rng(3), AFTER, change)
    return [event for row in rows for event in watching.handle_row(row)]


@pytest.mark.parametrize(
    ("change", "joint", "cause", "value", "text"),
    [
        (Change(gain=1.05, joint=1), "j2", "gain", 0.05, "j2: its drive reads +5"),
        (Change(friction=1.3, joint=2), "j3", "friction", 0.3, "j3: its friction has changed by +3"),
        (Change(payload=0.3), None, "payload", 0.3, "payload of 0."),
    ],
)
def test_a_change_is_told_as_what_it_is(change: Change, joint: str | None, cause: str, value: float, text: str) -> None:
    watching = observer()
    (event,) = observed(change, watching)
    assert (event.joint, event.evidence["cause"]) == (joint, cause)
    size, std = event.evidence["values"][0], event.evidence["std"][0]
    assert abs(size - value) < max(4 * std, 0.15 * value)
    assert describe(event)[1].startswith(text)
    assert event.finding is None, "nothing is proposed: constants are measured by creep sweeps"
    if cause == "gain":
        estimate = watching.estimate()
        assert abs(estimate.gain[1] - 1.05) < 4 * estimate.gain_std[1]


@pytest.mark.parametrize(("size", "cause"), [(0.0, "none"), (5.0, "gain")])
def test_a_change_that_hardly_explains_the_rows_is_none(size: float, cause: str) -> None:
    """Fifty rows of whitened noise, and a gain's column in them."""
    random = np.random.default_rng(6)
    gain, level = ChangeHypothesis("gain", 0, random.standard_normal((50, 1))), np.zeros(1)
    residual = random.standard_normal(50) + size * gain.columns[:, 0]
    known = Residuals(residual, np.eye(50), [gain], doubt=0.5, of_model=level, level=level, relative_level=level)
    belief = SimpleNamespace(residuals=lambda *_: known, misfit_limit=8.0, payload_rank=1)
    test = CauseTest(belief, SimpleNamespace())  # type: ignore[arg-type]
    assert test.verdict().cause == cause


def test_work_without_a_change_is_no_event_and_tells_what_would_be_noticed() -> None:
    watching = observer()
    assert observed(NOTHING, watching) == []
    assert not watching.held
    limits = watching.limits().gain
    assert np.nanmin(limits) < 0.03
    assert np.isnan(limits[0]) or limits[0] > 0.05, "gravity does not load an upright axis"


def test_saved_and_restored_it_goes_on_as_before() -> None:
    arm, made, record, _ = calibrated()
    rows = work(arm, made, record, np.random.default_rng(2), 200)
    before, after = observer(), observer()
    for row in rows[:150]:
        before.handle_row(row)
    assert after.restore(json.loads(json.dumps(before.save())))
    for row in rows[150:]:
        before.handle_row(row)
        after.handle_row(row)
    assert before.save() == after.save()
    assert before.rows == after.rows == 200
    assert not after.restore({"schema": 1})
    assert not after.restore({**before.save(), "window": [[9, [0.0] * 4, 0.0, 0.1, None]]})


def test_an_arm_with_torque_sensors_is_watched_at_rest() -> None:
    arm, _, record, gravity = calibrated()
    sensors = record.model_copy(
        update={"joints": tuple(joint.model_copy(update={"motor": None}) for joint in record.joints)}
    )
    found = observer_of(gcomp_arm(arm), sensors, gravity, arm.require_link().rated_torques)
    assert isinstance(found._belief, GravityBelief)


def test_a_state_saved_by_version_0_2_is_restored() -> None:
    """saved_state.json: j2 reads 5 % more since 200 rows, and that was told; then it is put right."""
    (arm, made, record, _), watching = calibrated(), observer()
    saved = json.loads((Path(__file__).parent / "saved_state.json").read_text(encoding="utf-8"))
    assert watching.restore(saved["state"])
    assert watching.rows == 620
    made.simulated.time = saved["time"]
    changed = work(arm, made, record, np.random.default_rng(4), 200, Change(gain=1.05, joint=1))
    assert [event for row in changed for event in watching.handle_row(row)] == []
    assert abs(watching.estimate().gain[1] - 1.05) < 4 * watching.estimate().gain_std[1]
    right = work(arm, made, record, np.random.default_rng(5), 400)
    (event,) = [event for row in right for event in watching.handle_row(row)]
    assert event.evidence["cause"] == "none"
