"""Recordings whose columns, units or clocks are wrong are corrected or refused; sound ones pass untouched."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from doubts import doubt
from wrong_arms import THREE, Wrong, model, motion, record

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, TIME_UNITS, parse_corrections
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording, take_joints
from sim_gap.attribution.diagnose import diagnose
from sim_gap.checks.check import check_recording
from sim_gap.checks.columns import find_wrong_columns
from sim_gap.checks.sound_arm import LEAST_RESIDUAL, ChannelMotion, measurements
from sim_gap.model.load import load_model

REAL = Wrong(
    coulomb=np.array([4.0, 2.0, 0.8]),
    viscous=np.array([1.5, 0.8, 0.3]),
    rotor=0.3,
    offset=0.2,
    gain=np.array([1.1, 0.9, 1.05]),
    payload=0.8,
)


@pytest.fixture(scope="module")
def arm():
    return load_model(model()).arm


@pytest.fixture(scope="module")
def motor() -> Recording:
    made = record(model(), REAL, seconds=30.0, rate=100.0)
    return replace(made, torque=None)


def check(arm, recording, stated=AS_IT_IS):
    return check_recording(arm, recording, "r.csv", stated)


def wrong_columns(arm, q, v, a, reading):
    """The finding on a motor's torque over 30 s."""
    size = reading.std(0)
    count = measurements(q, v, size, 30.0)
    channel = ChannelMotion(q, v, a, reading, "tau_motor", 30.0, size, count, LEAST_RESIDUAL * size, np.ones(3, bool))
    return find_wrong_columns(arm, channel, AS_IT_IS, ())


def turned(recording: Recording, channel: str, joints) -> Recording:
    values = getattr(recording, channel).copy()
    values[:, joints] *= -1.0
    return replace(recording, **{channel: values})


def test_a_wrong_arm_is_no_finding(arm, motor):
    assert check(arm, motor) == (motor, [])


@pytest.mark.parametrize("tilt", [0.1, 0.5])
def test_a_tilted_base_is_an_effect_and_no_finding(arm, tilt):
    made = record(model(), Wrong(coulomb=0.5, tilt=(tilt, -tilt)), seconds=30.0, rate=100.0)
    assert check(arm, replace(made, torque=None))[1] == []


@pytest.mark.parametrize(
    ("spoil", "kind", "option"),
    [
        (lambda r: turned(r, "motor_torque", [1]), "sign", "--sign tau_motor_2=-1"),
        (lambda r: turned(r, "motor_torque", [0, 1, 2]), "sign", "--sign tau_motor=-1"),
        (lambda r: turned(r, "position", [2]), "sign", "--sign q_3=-1"),
        (lambda r: replace(r, position=np.degrees(r.position)), "scale", "--units q=deg"),
        (lambda r: take_joints(r, [0, 2, 1], r.names), "order", None),
        (lambda r: replace(r, position=r.position + np.array([0.0, np.pi / 2, 0.0])), "zero", "--zero q_2=-1.57080"),
    ],
)
def test_certain_faults_are_corrected(arm, motor, spoil, kind, option):
    spoiled = replace(spoil(motor), velocity=None)
    corrected, (finding,) = check(arm, spoiled)
    assert (finding.finding, finding.corrected) == (kind, True)
    assert option is None or finding.option == option
    np.testing.assert_allclose(corrected.position, motor.position, atol=1e-4)
    np.testing.assert_allclose(corrected.motor_torque, motor.motor_torque, atol=1e-9)


def test_torque_far_from_its_time_is_moved_back(arm, motor):
    late = replace(motor, motor_torque=np.roll(motor.motor_torque, 40, axis=0), velocity=None)
    corrected, (finding,) = check(arm, late)
    assert finding.finding == "clock"
    assert float(finding.option.rpartition("=")[2]) == pytest.approx(-0.4, abs=0.03)
    assert np.isnan(corrected.motor_torque[-1]).all()


def test_times_of_receipt_become_sample_times(arm, motor):
    scatter = np.random.default_rng(1).normal(0.0, 0.005, motor.t.size)
    received = np.maximum.accumulate(motor.t + np.clip(scatter, -0.02, 0.02)) + 1e-9 * np.arange(motor.t.size)
    corrected, (finding,) = check(arm, replace(motor, t=received, velocity=None))
    assert finding.finding == "jitter"
    even = corrected.t - corrected.t[0]
    assert np.std(even - (motor.t - motor.t[0])) < 2e-4


def test_rows_read_twice_are_left_out(arm, motor):
    twice = np.arange(motor.t.size)
    drawn = np.random.default_rng(2).random(twice.size) < 0.2
    twice[1:] -= drawn[1:]
    stale = replace(motor, **{name: values[twice] for name, values in motor.channels().items()})
    corrected, (finding,) = check(arm, replace(stale, velocity=None))
    assert finding.finding == "duplicate"
    assert 0.75 * motor.t.size < corrected.t.size < 0.9 * motor.t.size


@pytest.mark.parametrize(("factor", "kind"), [(np.degrees(1.0), "scale"), (-1.0, "sign")])
def test_a_velocity_that_is_not_the_derivative_is_left_out(arm, motor, factor, kind):
    rate = np.gradient(motor.position, motor.t, axis=0)
    corrected, (finding,) = check(arm, replace(motor, velocity=rate * factor))
    assert (finding.finding, finding.channel) == (kind, "dq")
    assert corrected.velocity is None


@pytest.mark.parametrize(
    ("holds", "option"),
    [
        ([1, 2, 0], "--map dq_2=dq_1,dq_3=dq_2,dq_1=dq_3"),
        ([0, 0, 0], "--units dq_2=rad,dq_3=rad (to keep the velocity)"),
        ([2, 1, 1], "--units dq_1=rad,dq_3=rad (to keep the velocity)"),
    ],
)
def test_velocities_of_other_joints_are_mapped_where_every_joint_has_one(arm, motor, holds, option):
    """A column of each joint is named once: what the option suggests can be pasted."""
    rate = np.gradient(motor.position, motor.t, axis=0)
    spoiled = replace(motor, velocity=rate[:, holds])
    corrected, (finding,) = check(arm, spoiled)
    assert (finding.finding, finding.option, corrected.velocity) == ("order", option, None)
    if option.startswith("--map"):
        stated = parse_corrections(columns=[option.removeprefix("--map ")])
        assert check(arm, stated.apply(spoiled, "r.csv"), stated)[1] == []


@pytest.mark.parametrize("constant", [0.08, 12.0])
def test_amperes_are_doubted_with_the_option(arm, motor, constant):
    amperes = replace(motor, motor_torque=motor.motor_torque / constant)
    doubt(check(arm, amperes), r"tau_motor of all joints: .*amperes.*--units tau_motor=A:K")
    check(arm, amperes, parse_corrections(units=["tau_motor=N·m"]))


def test_unsigned_torque_is_doubted(arm, motor):
    doubt(check(arm, replace(motor, motor_torque=np.abs(motor.motor_torque))), "never changes its sign")


def test_a_sign_that_the_user_states_is_left(arm, motor):
    spoiled = turned(motor, "motor_torque", [1])
    stated = parse_corrections(sign=["tau_motor_2=1", "q_2=1"])
    assert check(arm, spoiled, stated)[1] == []


def test_the_answer_lists_the_findings(motor):
    answer = diagnose(model(), [turned(motor, "motor_torque", [1])])
    (finding,) = answer.to_json()["checks"]
    assert finding["option"] == "--sign tau_motor_2=-1"
    assert {cause.effect for cause in answer.causes} >= {"friction.coulomb"}


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("folder", "file"),
    [("ur10e", "train_a"), ("panda", "recording"), ("tx40", "recording"), ("ur10", "recording"), ("lwr4", "other")],
)
def test_real_arms_as_recorded_are_no_finding(realdata, folder, file):
    recording = load_recording(realdata / folder / f"{file}.csv.gz")
    real = load_model(realdata / folder / "sim.xml", (), recording.n).arm
    assert check(real, recording)[1] == []


def with_range(low: float, high: float):
    """The arm, its second joint with a range [rad]."""
    limited = THREE.replace('name="joint_2"', f'name="joint_2" range="{low} {high}"')
    text = limited.replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
    return load_model(mujoco.MjModel.from_xml_string(text)).arm


def test_a_joint_beyond_its_range_is_refused_unless_the_user_says_that_it_is_there(motor):
    least, most = motor.position[:, 1].min(), motor.position[:, 1].max()
    assert check(with_range(least - 0.01, most + 0.01), motor)[1] == []
    assert check(with_range(least - 0.01, most - 0.1), motor)[1] == []
    narrow = with_range(least - 0.01, most - 0.3)
    with pytest.raises(
        BadInput,
        match=r"q of joint_2: the recorded position goes from .* the joint of the model can only go from "
        r".*--zero q_2=0",
    ):
        check(narrow, motor)
    assert check(narrow, motor, parse_corrections(zero=["q_2=0"]))[1] == []


def test_rows_that_are_missing_are_said(arm, motor):
    kept = np.random.default_rng(6).random(motor.t.size) > 0.2
    gaps = replace(motor, **{name: values[kept] for name, values in motor.channels().items()}, t=motor.t[kept])
    corrected, (finding,) = check(arm, replace(gaps, velocity=None))
    assert (finding.finding, finding.corrected) == ("dropped", True)
    np.testing.assert_array_equal(corrected.t, gaps.t)


def test_counts_are_doubted_with_the_option(arm, motor):
    counts = replace(motor, position=np.round(motor.position * 4096 / (2.0 * np.pi)), velocity=None)
    with pytest.raises(BadInput, match=r"q of joint_1: the column holds whole numbers .*--units q=counts:TURN"):
        check(arm, counts)


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("run", "model_of"),
    [
        ("meas_elbow", "sim"),
        ("meas_elbow_half", "sim"),
        ("designc_elbow", "sim_design_c"),
        ("designc_shoulder", "sim_design_c"),
    ],
)
def test_an_idle_motor_whose_joint_is_dragged_along_has_no_sign(realdata, run, model_of):
    """What it reads is the difference of torques that nearly cancel: no evidence, in either sign or unit."""
    recording = load_recording(realdata / "double_pendulum" / f"{run}.csv.gz")
    real = load_model(realdata / "double_pendulum" / f"{model_of}.xml", (), 2).arm
    assert check(real, recording)[1] == []
    driven = 0 if run.endswith("shoulder") else 1
    both = turned(turned(recording, "motor_torque", [driven]), "torque_command", [driven])
    told = [finding.option for finding in check(real, both)[1]]
    assert any(option.startswith(f"--sign tau_motor_{driven + 1}=-1") for option in told)


def test_an_order_is_put_right_although_a_broken_sensor_is_explained_no_better(arm, motor):
    """With columns 1 and 3 exchanged, and the torque of what is then joint 1 read by a broken sensor."""
    random = np.random.default_rng(5)
    torque = motor.motor_torque.copy()
    torque[:, 2] = 3.0 * np.sin(2.0 * motor.t) * motor.position[:, 2] + random.normal(0.0, 0.1, motor.t.size)
    broken = replace(motor, motor_torque=torque)
    corrected, _ = check(arm, take_joints(broken, [2, 1, 0], motor.names))
    np.testing.assert_array_equal(corrected.position, motor.position)
    np.testing.assert_array_equal(corrected.motor_torque, torque)


def test_a_tool_that_outweighs_the_last_link_is_no_zero_of_its_joint():
    """Its mass moment points across the link's: a quarter turn of the joint would show alike, but for the mass."""
    nominal = mujoco.MjModel.from_xml_string(THREE)
    nominal.body_mass[-1] = 0.1
    nominal.body_ipos[-1] = (0.0, 0.03, 0.02)
    nominal.body_inertia[-1] = 2e-4
    nominal.jnt_axis[-1] = (0.0, 0.0, 1.0)
    arm = load_model(nominal).arm
    _, q, v, a = motion(3, 30.0, 100.0, seed=4)
    body = np.array([0.6, 0.05, 0.0, 0.05]) * [1.0, 0.6, 0.6, 0.6]
    loaded = arm.inertial.copy()
    loaded[-1, :4] += body
    reading = replace(arm, inertial=loaded).torque(q, v, a) + 0.2 * np.tanh(v / 0.01)
    assert wrong_columns(arm, q, v, a, reading) is None


@pytest.mark.parametrize("slow", ["drift", "spring"])
def test_a_reading_that_drifts_in_a_motion_with_few_reversals_is_no_motors(slow):
    nominal = mujoco.MjModel.from_xml_string(THREE)
    nominal.opt.gravity[:] = 0.0
    t = np.arange(0.0, 20.0, 0.02)
    q = np.outer(0.5 * np.cos(2 * np.pi * t / 20.0), np.ones(3))
    made = Recording(t=t, position=q, torque=0.02 * t[:, None] + 0.0 * q if slow == "drift" else -2.0 * q)
    assert check(load_model(nominal).arm, made)[1] == []


def test_a_joint_whose_friction_outweighs_the_models_torque_tells_no_zero():
    """What is left beside its friction may fit any change, with a coefficient of hundreds."""
    nominal = mujoco.MjModel.from_xml_string(THREE)
    nominal.body_mass[-1], nominal.body_inertia[-1] = 1e-3, 1e-6
    arm = load_model(nominal).arm
    _, q, v, a = motion(3, 30.0, 100.0, seed=4)
    reading = arm.torque(q, v, a) + np.tanh(v / 0.01)
    reading[:, 2] += 300.0 * arm.torque(q + np.array([0.0, 0.0, np.pi / 2]), v, a)[:, 2]
    assert wrong_columns(arm, q, v, a, reading) is None


def test_friction_tells_the_sign_where_the_model_says_nothing(arm, motor):
    """A joint of which friction is all that its motor reads: its sign, which is likelier than a position's."""
    lone = motor.motor_torque.copy()
    moves = np.gradient(motor.position[:, 2], motor.t)
    lone[:, 2] = 3.0 * np.tanh(moves / 0.01) + 0.4 * moves
    massless = replace(arm, inertial=arm.inertial * np.array([1.0, 1.0, 1e-6])[:, None])
    sound = replace(motor, motor_torque=lone, velocity=None)
    assert [each.joint for each in check(massless, sound)[1]] == []
    corrected, (finding,) = check(massless, turned(sound, "motor_torque", [2]))
    assert finding.option == "--sign tau_motor_3=-1"
    np.testing.assert_array_equal(corrected.motor_torque, lone)


def test_torque_stamped_early_is_moved_back(arm, motor):
    early = replace(motor, motor_torque=np.roll(motor.motor_torque, -11, axis=0), velocity=None)
    _, (finding,) = check(arm, early)
    assert finding.finding == "clock"
    assert float(finding.option.rpartition("=")[2]) == pytest.approx(0.11, abs=0.02)


def test_positions_that_are_held_are_filled_in(arm, motor):
    rows = np.arange(motor.t.size) // 5 * 5
    held = motor.position[rows]
    corrected, (finding,) = check(arm, replace(motor, position=held, velocity=None))
    assert (finding.finding, finding.channel) == ("duplicate", "q")
    assert np.std(corrected.position - motor.position) < 0.2 * np.std(held - motor.position)


def test_pieces_put_together_are_refused(arm, motor):
    rows = np.r_[0 : motor.t.size // 4, motor.t.size // 2 : motor.t.size]
    pieces = replace(motor, **{name: values[rows] for name, values in motor.channels().items()}, t=motor.t[: rows.size])
    with pytest.raises(BadInput, match=r"jumps by .* rad from one row to the next"):
        check(arm, replace(pieces, velocity=None))


def test_positions_that_wrap_around_are_turned_on(arm, motor):
    far = motor.position + np.array([np.pi, 0.0, 0.0])
    wrapped = (far + np.pi) % (2.0 * np.pi) - np.pi
    corrected, found = check(arm, replace(motor, position=wrapped, velocity=None))
    assert {each.finding for each in found} <= {"zero"}
    assert np.abs(np.diff(corrected.position[:, 0])).max() < 0.5


def test_rows_stamped_together_are_put_on_even_times_or_refused(arm, motor):
    together = motor.t[np.minimum(np.arange(motor.t.size) // 4 * 4 + 3, motor.t.size - 1)]
    stamped = together + 1e-9 * np.arange(motor.t.size)
    corrected, (finding,) = check(arm, replace(motor, t=stamped, velocity=None))
    assert finding.finding == "jitter"
    assert np.diff(corrected.t).min() > 0.009
    with pytest.raises(BadInput, match="did several rows get the same time stamp"):
        check(arm, replace(motor, t=stamped, velocity=None), parse_corrections(clock=["t=0"]))


def test_torques_exchanged_midway_are_doubted(arm, motor):
    exchanged = motor.motor_torque.copy()
    exchanged[motor.t.size // 2 :] = exchanged[motor.t.size // 2 :][:, [0, 2, 1]]
    doubt(
        check(arm, replace(motor, motor_torque=exchanged, velocity=None)),
        r"after 50% of the recording.* --map tau_motor_2=tau_motor_3",
    )


@pytest.mark.parametrize(("share", "late"), [(0.3, True), (0.7, True), (0.7, False)])
def test_torques_exchanged_in_a_part_of_the_rows_are_doubted_with_their_place(arm, motor, share, late):
    rows = (motor.t > motor.t[0] + share * np.ptp(motor.t)) == late
    exchanged = motor.motor_torque.copy()
    exchanged[rows] = exchanged[rows][:, [2, 1, 0]]
    place = rf"{'after' if late else 'before'} {share:.0%} of the recording.* --map tau_motor_1=tau_motor_3"
    doubt(check(arm, replace(motor, motor_torque=exchanged, velocity=None)), place)


@pytest.mark.parametrize(("joint", "constant"), [(0, 12.0), (1, 0.2), (1, 15.0), (2, 0.1)])
def test_amperes_of_one_joint_are_asked_about(arm, motor, joint, constant):
    torque = motor.motor_torque.copy()
    torque[:, joint] /= constant
    column = f"tau_motor_{joint + 1}"
    error = doubt(
        check(arm, replace(motor, motor_torque=torque)), rf"amperes, or in another unit.*--units {column}=A:K"
    )
    assert f"{column}=N·m" in error
    assert check(arm, replace(motor, motor_torque=torque), parse_corrections(units=[f"{column}=N·m"]))[1] == []
    assert check(arm, motor, parse_corrections(units=[f"{column}=N·m"]))[1] == []


@pytest.mark.parametrize("payload", [0.0, 1.0, 4.0])
def test_a_load_that_counts_many_times_at_a_slim_wrist_is_no_unit(arm, payload):
    carried = replace(record(model(), replace(REAL, payload=payload), seconds=30.0, rate=100.0), torque=None)
    assert check(arm, carried)[1] == []


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_times_in_a_smaller_unit_are_asked_about(arm, motor, unit):
    fine = replace(motor, t=motor.t / TIME_UNITS[unit])
    with pytest.raises(BadInput, match=rf"travel .* --units t={unit}, or t=s if this is right"):
        check(arm, fine)
    in_seconds = parse_corrections(units=[f"t={unit}"])
    assert check(arm, in_seconds.apply(fine, "r"), in_seconds)[1] == []


@pytest.mark.sample(1)
@pytest.mark.parametrize(("joint", "angle"), [(1, 0.25), (1, -0.3)])
def test_a_zero_that_is_off_by_tenths_of_a_radian_is_an_effect_of_the_arm(arm, motor, joint, angle):
    position = motor.position.copy()
    position[:, joint] += angle
    off = replace(motor, position=position, velocity=None)
    assert check(arm, off)[1] == []
    (cause,) = [cause for cause in diagnose(model(), [off]).causes if cause.effect == "position.offset"]
    assert cause.joints == (f"joint_{joint + 1}",)


@pytest.mark.parametrize("moved", [{1: (0.03, 0.0, 0.02)}, {0: (0.0, 0.03, 0.03)}, {2: (0.04, 0.04, 0.0)}])
def test_a_mass_that_is_elsewhere_is_no_zero(arm, moved):
    made = replace(record(model(), replace(REAL, moved=moved), seconds=30.0, rate=100.0), torque=None)
    assert check(arm, made)[1] == []
