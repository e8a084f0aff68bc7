"""Calibration in the field without a mass: intervals that hold, and no number where nothing can be separated."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from paper_arm import BETA

from armlink.arm_file import ArmFile, load_arm
from armlink.cli import run
from armlink.errors import BadInput, Refused
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.fit.field_fit import fit_field
from calib.fit.recorded_rows import rows_of_recording
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.readings import StaticReadings

ARM = load_arm("sarcos")
DESCRIBED = gcomp_arm(ARM)
N = DESCRIBED.n
BLANK = per_joint([UNCALIBRATED] * N)
RATED = ARM.require_link().rated_torques
MOMENT_STD = np.repeat([4.4e-3, 4.5e-3, 1.3e-3, 0.9e-3, 0.5e-3, 0.4e-3, 0.3e-3], 2)
"""Errors of β after a good calibration (docs/theory.md, section 6) [kg·m]."""
ZERO_STD = 5e-4
SIGMA = 0.05
WHEN = datetime(2026, 11, 21, tzinfo=UTC)


def calibration(arm: ArmFile = ARM, gain: float = 1.0) -> CalibrationRecord:
    names = arm.joint_names
    joints = tuple(
        JointCalibration(name=name, gain=gain, offset=0.0, position_gain=1.0, position_offset=0.0) for name in names
    )
    of = tuple(f"{name}.{parameter}" for name in names for parameter in ("gain", "offset", "position_offset"))
    spread = np.diag([2e-3**2, 0.02**2, ZERO_STD**2] * len(names))
    return CalibrationRecord(
        **provenance(arm, created=WHEN), joints=joints, covariance_of=of, covariance=matrix(spread)
    )


def gravity(beta: np.ndarray, std: np.ndarray = MOMENT_STD, arm: ArmFile = ARM) -> GravityRecord:
    return GravityRecord(
        **provenance(arm, created=WHEN),
        names=arm.joint_names,
        beta=tuple(beta.tolist()),
        covariance=matrix(np.diag(std**2)),
        identifiable=(True,) * len(beta),
        gravity=tuple(gcomp_arm(arm).gravity.tolist()),
    )


def rows(
    random: np.random.Generator,
    gain: np.ndarray,
    offset: np.ndarray,
    count: int = 40,
    pose: np.ndarray | None = None,
    beta: np.ndarray | None = None,
    zero: np.ndarray | float = 0.0,
    hysteresis: float = 0.0,
) -> StaticReadings:
    """Rests at random poses within the stops; `pose` (count, n) where they are given."""
    q = random.uniform(DESCRIBED.lower, DESCRIBED.upper, (count, N)) if pose is None else pose
    side = random.choice([-1.0, 1.0], q.shape)
    torque = gravity_torque(DESCRIBED, np.array(BETA) if beta is None else beta, q + zero)
    reading = gain * torque + offset + hysteresis * side + random.normal(0, SIGMA, q.shape)
    return StaticReadings(q, reading, np.full(q.shape, SIGMA), direction=side)


@pytest.mark.long
def test_its_intervals_hold_the_truth_by_monte_carlo() -> None:
    """Gravity parameters, position zeros and readings each drawn with the error that the records state: 150 trials."""
    random, inside = np.random.default_rng(0), {"gain": [], "offset": []}
    for _ in range(150):
        gain, offset = random.uniform(0.9, 1.1, N), random.normal(0, 0.5, N)
        believed = np.array(BETA) + random.normal(0, MOMENT_STD)
        drawn = rows(random, gain, offset, zero=random.normal(0, ZERO_STD, N), hysteresis=0.1)
        fit = fit_field(ARM, drawn, gravity(believed), calibration())
        for name, true in (("gain", gain), ("offset", offset)):
            low, high = fit.ci95(name).T
            known = np.isfinite(low)
            inside[name] += list(((low <= true) & (true <= high))[known])
    for name, hits in inside.items():
        assert len(hits) > 800, name
        assert 0.92 <= np.mean(hits) <= 0.98, f"{name}: {np.mean(hits):.3f} of {len(hits)}"


def test_its_covariance_is_the_plain_regression_s_where_nothing_else_is_uncertain() -> None:
    """docs/theory.md, section 4 (iii): var(k) = σ²/(K Var τ), var(o) = (σ²/K)(1 + τ̄²/Var τ), cov = −τ̄ σ²/(K Var τ)."""
    random = np.random.default_rng(1)
    drawn = rows(random, np.ones(N), np.zeros(N), count=400)
    of = tuple(f"{name}.position_offset" for name in ARM.joint_names)
    exact = calibration().model_copy(update={"covariance_of": of, "covariance": matrix(1e-14 * np.eye(N))})
    fit = fit_field(ARM, drawn, gravity(np.array(BETA), np.full(2 * N, 1e-9)), exact)
    torque = gravity_torque(DESCRIBED, np.array(BETA), drawn.position)
    variance, mean = torque.var(axis=0), torque.mean(axis=0)
    scale = np.maximum(np.nanstd(fit.residual, axis=0) / SIGMA, 1.0) ** 2 * SIGMA**2 / 400
    for j in range(N - 1):
        expected = scale[j] / variance[j] * np.array([[1, -mean[j]], [-mean[j], variance[j] + mean[j] ** 2]])
        np.testing.assert_allclose(
            fit.covariance_of([(j, "gain"), (j, "offset")]), expected, rtol=0.12, err_msg=f"joint_{j + 1}"
        )


def test_a_torque_that_does_not_vary_gives_no_gain_and_under_load_no_offset() -> None:
    """Rests within a thousandth of a radian of one pose: readings say gain · torque + offset and nothing of either."""
    random = np.random.default_rng(2)
    pose = (DESCRIBED.lower + DESCRIBED.upper) / 2 + random.uniform(-1e-3, 1e-3, (40, N))
    fit = fit_field(ARM, rows(random, np.ones(N), np.zeros(N), pose=pose), gravity(np.array(BETA)), calibration())
    assert np.isnan(fit.value("gain")).all()
    assert {name for (name, parameter) in fit.reasons if parameter == "gain"} == set(ARM.joint_names)
    assert "torque varies only by" in fit.reasons["joint_2", "gain"]
    torque = np.abs(gravity_torque(DESCRIBED, np.array(BETA), pose)[0])
    heavy = (
        torque * 0.05 > 0.006 * RATED
    )  # a drift of 5 % would be more than the 0.5 % of rated torque asked of an offset
    assert heavy.any()
    assert np.isnan(fit.value("offset")[heavy]).all()
    assert "cannot be separated from the gain" in fit.reasons[ARM.joint_names[int(np.argmax(heavy))], "offset"]


def test_an_axis_along_gravity_has_an_offset_and_no_gain() -> None:
    """Upright arm: nothing turns joint 1, so its gain is not there to be seen; its offset is."""
    upright = ARM.model_copy(update={"kinematics": ARM.kinematics.model_copy(update={"gravity": (0.0, 0.0, -9.80665)})})
    random, described = np.random.default_rng(3), gcomp_arm(upright)
    q = random.uniform(described.lower, described.upper, (60, N))
    side = random.choice([-1.0, 1.0], q.shape)
    reading = 1.04 * gravity_torque(described, np.array(BETA), q) + 0.3 + random.normal(0, SIGMA, q.shape)
    drawn = StaticReadings(q, reading, np.full(q.shape, SIGMA), direction=side)
    fit = fit_field(upright, drawn, gravity(np.array(BETA), arm=upright), calibration(upright))
    assert np.isnan(fit.value("gain")[0])
    assert "axis is vertical" in fit.reasons["joint_1", "gain"]
    assert fit.value("offset")[0] == pytest.approx(0.3, abs=0.05)
    assert ("joint_1", "offset") not in fit.reasons


def test_a_joint_approached_from_one_side_has_no_offset() -> None:
    drawn = rows(np.random.default_rng(4), np.ones(N), np.zeros(N))
    direction = drawn.direction.copy()
    direction[:, 2] = 1.0
    drawn = replace(drawn, direction=direction)
    fit = fit_field(ARM, drawn, gravity(np.array(BETA)), calibration())
    assert np.isnan(fit.value("offset")[2])
    assert "one side only" in fit.reasons["joint_3", "offset"]
    assert np.isfinite(fit.value("gain")[2])


def test_the_common_scale_is_as_uncertain_as_the_gravity_record_s() -> None:
    """β̂ wrong by 1 % as a whole, and known to 1 %: all gains come out 1 % wrong, and their intervals say so."""
    random, beta = np.random.default_rng(5), np.array(BETA)
    wide = gravity(1.01 * beta).model_copy(update={"covariance": matrix(1e-4 * np.outer(beta, beta))})
    fit = fit_field(ARM, rows(random, np.ones(N), np.zeros(N)), wide, calibration())
    assert fit.common_scale_std == pytest.approx(0.01, rel=0.15)
    assert fit.value("gain")[0] == pytest.approx(1 / 1.01, abs=2e-3)
    low, high = fit.ci95("gain")[0]
    assert low < 1.0 < high


def test_a_payload_is_not_taken_for_new_gains() -> None:
    fixed, by_point = payload_columns(DESCRIBED)
    loaded = np.array(BETA) + 0.5 * (fixed + by_point @ np.array([0.02, -0.03, 0.05]))
    drawn = rows(np.random.default_rng(6), np.ones(N), np.zeros(N), beta=loaded)
    with pytest.raises(Refused, match=r"a payload of 0\.[45]\d kg, or changed gains"):
        fit_field(ARM, drawn, gravity(np.array(BETA)), calibration())


def recording(random: np.random.Generator, gain: np.ndarray, offset: np.ndarray, speed: float) -> Recording:
    """Slow sinusoids of all joints at 33 Hz, at most `speed` [rad/s], ten minutes."""
    t = np.arange(0.0, 600.0, 0.03)
    middle, half = (DESCRIBED.lower + DESCRIBED.upper) / 2, 0.4 * (DESCRIBED.upper - DESCRIBED.lower)
    rate = speed / half * random.uniform(0.7, 1.0, N)
    q = middle + half * np.sin(rate * t[:, None] + random.uniform(0, 6, N))
    torque = gain * gravity_torque(DESCRIBED, np.array(BETA), q) + offset + random.normal(0, 0.2, q.shape)
    return Recording(t=t, position=q, torque=torque, names=DESCRIBED.names)


def test_slow_motion_gives_what_rests_give() -> None:
    random = np.random.default_rng(7)
    gain, offset = random.uniform(0.9, 1.1, N), random.normal(0, 0.5, N)
    taken = rows_of_recording(recording(random, gain, offset, 0.08), BLANK, 0, "slow")
    fit = fit_field(ARM, taken, gravity(np.array(BETA)), calibration())
    known = np.isfinite(fit.value("gain"))
    assert known[:6].all()
    assert np.abs(fit.value("gain") / gain - 1)[known].max() < 0.02
    assert (np.abs(fit.value("gain") - gain)[known] < 3.5 * fit.std("gain")[known]).all()


def test_what_the_controllers_held_is_taken_out_again() -> None:
    """They sent (v − offset)/gain: the fit finds the sensors' own pairs all the same."""
    random = np.random.default_rng(8)
    raw = recording(random, np.full(N, 1.1), np.full(N, 0.4), 0.08)
    assert raw.torque is not None
    sent = Recording(t=raw.t, position=raw.position, torque=(raw.torque - 0.2) / 0.9, names=raw.names)
    taken = rows_of_recording(sent, TorqueCalibration(np.full(N, 0.9), np.full(N, 0.2)), 0, "slow")
    fit = fit_field(ARM, taken, gravity(np.array(BETA)), calibration(gain=0.9))
    assert fit.value("gain")[:4] == pytest.approx([1.1] * 4, rel=5e-3)


def test_fast_motion_and_missing_torque_are_refused_in_one_line() -> None:
    fast = recording(np.random.default_rng(9), np.ones(N), np.zeros(N), 1.0)
    with pytest.raises(BadInput, match="slow enough"):
        rows_of_recording(fast, BLANK, 0, "fast.csv")
    without = Recording(t=fast.t, position=fast.position, motor_torque=fast.torque, names=fast.names)
    with pytest.raises(BadInput, match="no joint torque"):
        rows_of_recording(without, BLANK, 0, "x")


@pytest.fixture
def kept(tmp_path: Path) -> tuple[str, CalibrationRecord, GravityRecord]:
    """A store with both records of the bundled arm; its path."""
    path = str(tmp_path / "records.db")
    store, installed, moments = RecordStore(path), calibration(), gravity(np.array(BETA))
    store.put(installed, ARM, by="ann", reason="sweeps")
    store.put(moments, ARM, by="ann", reason="sweeps")
    return path, installed, moments


def test_the_command_keeps_a_record_and_says_what_it_could_not_separate(kept, tmp_path, capsys) -> None:
    """Joint 7 stands still: its gain and offset have a reason and no number; its values are carried over."""
    path, installed, moments = kept
    random, gain = np.random.default_rng(10), np.array([1.03, 0.98, 1.02, 0.97, 1.0, 1.01, 1.0])
    moving = recording(random, gain, np.full(N, 0.2), 0.08)
    position = moving.position.copy()
    position[:, 6] = 0.1
    torque = gain * gravity_torque(DESCRIBED, np.array(BETA), position) + 0.2 + random.normal(0, 0.2, position.shape)
    save_recording(
        Recording(t=moving.t, position=position, torque=torque, names=moving.names), tmp_path / "slow.csv.gz"
    )
    arguments = ["recalibrate", "sarcos", str(tmp_path / "slow.csv.gz"), "--store", path, "--json", "-"]
    assert run(arguments) == 0
    out = capsys.readouterr()
    answer = json.loads(out.out)
    for found, (low, high), true in zip(answer["gain"]["estimated"][:4], answer["gain"]["ci95"], gain, strict=False):
        assert found == pytest.approx(true, abs=0.01)
        assert low - 0.002 < true < high + 0.002
    assert answer["offset"]["estimated"][6] is None
    assert ("joint_7", "offset") in {(each["joint"], each["parameter"]) for each in answer["not_separable"]}
    assert "factor common to all gains" in out.err
    store = RecordStore(path)
    new = store.get(answer["record"])
    assert isinstance(new, CalibrationRecord)
    assert new.joints[6].offset == installed.joints[6].offset
    assert "joint_7 offset" in new.note
    assert new.parent == installed.id
    assert list(new.sources) == ["slow.csv.gz", f"gravity record {moments.id}"]
    assert store.current(CalibrationRecord, ARM) == installed


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["recalibrate", "sarcos", "nowhere.csv"], 2, "nowhere.csv"),
        (["recalibrate", "nowhere", "x.csv"], 2, "no arm file nowhere"),
    ],
)
def test_what_cannot_be_used_is_one_line(kept, capsys, arguments, status, said) -> None:
    assert run([*arguments, "--store", kept[0]]) == status
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_without_a_gravity_record_it_says_how_to_make_one(tmp_path, capsys) -> None:
    assert run(["recalibrate", "sarcos", "x.csv", "--store", str(tmp_path / "empty.db")]) == 1
    assert ": armlink sweep " in capsys.readouterr().err
