"""The report to file, the held-out gate and recalibration from sweeps: on one made-up arm of three joints."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sweep_arms import random_arm
from synthetic_sweeps import passes

from armlink.errors import Refused
from calib.dataset import SweepData
from calib.fit.calibration import interval_text
from calib.fit.field_fit import fit_field, held_out_rows
from calib.fit.gravity_fit import held_out_steps, heldout_scores, identify_gravity
from calib.fit.recorded_rows import rows_of_sweeps
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.install.apply import Apply, admit_fitted
from calib.install.plausibility import check_held_out, replaced_record
from calib.records.compare import differences
from calib.records.records import CalibrationRecord, JointCalibration
from calib.records.store import RecordStore
from calib.report.calibration import Calibrated, write_report
from calib.report.figures import sweep_rows, sweeps_of

ARM = random_arm(1, 3)
TRUTH, DATA = passes(ARM, 1)


@pytest.fixture(scope="module")
def fit() -> SensorFit:
    return fit_sensors(ARM, DATA)


@pytest.fixture(scope="module")
def record(fit: SensorFit) -> CalibrationRecord:
    return fit.record(ARM)


def changed(record: CalibrationRecord, joint: int, **pair: float) -> CalibrationRecord:
    """The record with one joint's gain (a factor) or offset (added) changed."""
    joints: list[JointCalibration] = list(record.joints)
    old = joints[joint]
    assert old.gain is not None
    assert old.offset is not None
    new = {"gain": old.gain * pair.get("gain", 1.0), "offset": old.offset + pair.get("offset", 0.0)}
    joints[joint] = old.model_copy(update=new)
    return record.model_copy(update={"joints": tuple(joints)})


def test_the_report_says_what_from_what_and_per_joint_and_opens_without_complaint(fit, record, tmp_path, look) -> None:
    before = changed(record, 1, gain=1.05, offset=0.5)
    path = tmp_path / "calibration.html"
    write_report(Calibrated(ARM, DATA, fit, record, before), path)
    seen = look(path, height=4000)
    assert seen.console == ()
    assert seen.colours() > 200
    document = seen.document.partition("<body>")[2]
    for said in (
        record.id,
        before.id,
        "SHA-256",
        "the model holds",
        "Before and after",
        "Figure 6",
        "cross-validation RMS",
        f"<code>armlink calibrate {DATA[0].path} {DATA[1].path} --apply</code>",
    ):
        assert said in document, said
    for name in ARM.joint_names:
        assert f"Sweeps of {name}" in document
    gain, half = fit.value("gain")[1], fit.half95("gain")[1]
    assert f"{gain:.4f}\u00a0±\u00a0{half:.4f}" in document.replace("&nbsp;", "\u00a0")
    change = next(
        each for each in differences(before, record) if (each.joint, each.parameter) == (ARM.joint_names[1], "gain")
    )
    assert f"{change.change:+.5f}" in document


def test_an_interval_is_shown_with_as_many_places_as_it_needs() -> None:
    assert interval_text(0.9081, 0.0009) == "0.9081\u00a0±\u00a00.0009"
    assert interval_text(0.00441, 0.000021) == "0.00441\u00a0±\u00a00.00002"
    assert interval_text(0.5, 0.0) == "0.5000"
    assert interval_text(np.nan, 1.0) == "not observable"


def test_a_first_report_compares_with_what_the_controllers_had(fit, record, tmp_path) -> None:
    path = tmp_path / "first.html"
    write_report(Calibrated(ARM, DATA, fit, record, None), path)
    assert "had no record before" in path.read_text(encoding="utf-8")


def test_held_out_steps_are_as_far_off_as_their_noise(fit, record) -> None:
    """Fitted without them, they scatter by one standard deviation, and by far more with an old pair that is wrong."""
    new = heldout_scores(record, ARM, fit.rows, refit=True)
    assert np.nanstd(new) == pytest.approx(1.0, abs=0.35)
    wrong = heldout_scores(changed(record, 0, offset=1.0), ARM, fit.rows, refit=False)
    own = fit.rows.own[:, 0]
    assert np.nanstd(wrong[own, 0]) > 3 * np.nanstd(new[own, 0])


def test_the_gates_let_a_right_calibration_pass_and_name_what_is_wrong(record, tmp_path) -> None:
    store = RecordStore(str(tmp_path / "records.db"))
    admit_fitted(record, ARM, store, Apply("ann"), {})  # the first of this arm
    store.put(changed(record, 2, gain=1.03, offset=0.2), ARM, by="ann", reason="sweeps")
    with pytest.raises(Refused, match=r"was not compared with record .* by held-out data"):
        admit_fitted(record, ARM, store, Apply("ann"), {})
    before = replaced_record(record, ARM, store)
    assert before is not None
    proved = record.model_copy(update={"held_out": held_out_steps(record, before, ARM, DATA)})
    admit_fitted(proved, ARM, store, Apply("ann"), {})
    jumped = changed(record, 0, gain=1.3)
    with pytest.raises(Refused, match=f"{ARM.joint_names[0]}: gain .* covariance and history allow"):
        admit_fitted(jumped, ARM, store, Apply("ann"), {})


def test_a_joint_on_which_the_model_does_not_hold_is_not_written(record, tmp_path) -> None:
    store, name = RecordStore(str(tmp_path / "records.db")), ARM.joint_names[1]
    cable = {name: f"{name}: a spring of 0.8 N·m/rad pulls on it: is a cable caught?"}
    admit_fitted(record, ARM, store, Apply("ann", accepted=[name]), cable)
    with pytest.raises(Refused, match=f"^{name}: the sensor model does not hold: a spring of"):
        admit_fitted(record, ARM, store, Apply("ann"), cable)


def test_sweeps_that_disagree_with_one_another_do_not_replace_a_good_record(fit, record) -> None:
    """At every other step one joint reads 30 % more: what is fitted to one half fails on the other."""
    spoilt = []
    for data in DATA:
        mine = [reading for reading in data.readings if reading.joint == 1]
        steps = {r.sweep: sorted({round(o.position[1], 2) for o in mine if o.sweep == r.sweep}) for r in mine}
        readings = []
        for reading in data.readings:
            torque = reading.torque.copy()
            if reading.joint == 1 and steps[reading.sweep].index(round(reading.position[1], 2)) % 2:
                torque[1] *= 1.3
            readings.append(replace(reading, torque=torque))
        spoilt.append(replace(data, readings=tuple(readings), digest="f" * 64))
    gravity = identify_gravity(ARM, DATA, fit).record(ARM, record)

    def judged(sweeps: Sequence[SweepData]) -> None:
        new = record.model_copy(update={"note": "new"})
        proof = held_out_steps(new, record, ARM, sweeps, gravity)
        check_held_out(new.model_copy(update={"held_out": proof}), record)

    judged(DATA)
    with pytest.raises(Refused, match=f"{ARM.joint_names[1]}: the error on held-out data is"):
        judged(spoilt)


def test_sweeps_without_a_mass_recalibrate_against_the_gravity_record(fit, record) -> None:
    """The unloaded pass alone and an older gravity record: gains and offsets of every joint, within their intervals."""
    gravity = identify_gravity(ARM, DATA, fit).record(ARM, record)
    later = changed(record, 1, gain=1.03, offset=0.3)
    rows = rows_of_sweeps(DATA[0], 0)
    found = fit_field(ARM, rows, gravity, later, {"pass": DATA[0].digest})
    for name in ("gain", "offset"):
        true, value, std = getattr(TRUTH, name), found.value(name), found.std(name)
        known = np.isfinite(value)
        assert known.any()
        assert (np.abs(value - true)[known] < 4 * std[known]).all()
    new = found.record(ARM, later)
    assert new.parent == later.id
    assert new.joints[1].gain == pytest.approx(TRUTH.gain[1], rel=0.01)
    for joint, parameter in found.reasons:
        assert f"{joint} {parameter}" in new.note  # carried over, and said so
    check_held_out(new.model_copy(update={"held_out": held_out_rows(new, rows, found, later)}), later)


def test_a_pass_with_a_mass_is_not_taken_for_the_bare_arm() -> None:
    with pytest.raises(Exception, match="swept with a reference mass"):
        rows_of_sweeps(DATA[1], 0)


def test_a_figure_shows_each_reading_in_its_own_sweep_once(fit) -> None:
    shown = np.concatenate([sweep_rows(fit, joint, sweep) for joint in range(3) for sweep in sweeps_of(fit, joint)])
    assert sorted(shown.tolist()) == np.flatnonzero(fit.rows.swept >= 0).tolist()
    for sweep in sweeps_of(fit, 1):
        at = sweep_rows(fit, 1, sweep)
        assert {fit.rows.sweeps[row] for row in fit.rows.readings.series[at]} == {sweep}
        assert (np.diff(fit.rows.readings.position[at, 1]) >= 0).all()


def test_pages_are_written_whole(tmp_path: Path, fit, record) -> None:
    path = tmp_path / "report.html"
    write_report(Calibrated(ARM, DATA, fit, record, None), path)
    text = path.read_text(encoding="utf-8")
    assert text.rstrip().endswith("</html>")
    assert "http://" not in text.partition("</script>")[2].replace("http://www.w3.org", "")
