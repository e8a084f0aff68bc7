"""Commands against the joints that follow them: the option of the refusal settles it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from servo_arm import JOINTS, model_text, record

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.checks.check import check_position_only
from sim_gap.model.load import load_model


@pytest.fixture(scope="module")
def servo() -> Recording:
    return record(model_text(kp=60.0, friction=0.1), 3, 14.0)


def check(recording, stated=AS_IT_IS):
    from mujoco import MjModel

    arm = load_model(MjModel.from_xml_string(model_text(kp=60.0, friction=0.1)), JOINTS, 2).arm
    return check_position_only(arm, [recording], ["r.csv"], stated)


@pytest.mark.parametrize(
    ("holds", "option"),
    [([1, 0], "--map q_cmd_2=q_cmd_1,q_cmd_1=q_cmd_2"), ([0, 0], "--map q_cmd_2=q_cmd_2")],
)
def test_the_option_settles_whose_command_it_is(servo, holds, option):
    spoiled = replace(servo, position_command=servo.position_command[:, holds])
    with pytest.raises(BadInput, match="belongs to q_") as refused:
        check(spoiled)
    if holds == [1, 0]:
        assert option in str(refused.value)
    else:
        assert "elbow: q_cmd_2 belongs to q_1" in str(refused.value)
        assert "--map q_cmd_2=COLUMN; if q_cmd_2 is right, confirm it with --map q_cmd_2=q_cmd_2" in str(refused.value)
    stated = parse_corrections(columns=[option.removeprefix("--map ")])
    assert check(stated.apply(spoiled, "r.csv"), stated)[1] == []


def test_per_cent_of_a_range_is_asked_about_with_the_ranges_and_read(realdata):
    """As LeRobot records an SO-101 unless `use_degrees` is set; 100 is the end of a joint's range."""
    sim = load_model(realdata / "so101" / "sim.xml", (), 6)
    recording = load_recording(realdata / "so101" / "random_waypoints.csv.gz")
    low, high = sim.arm.range.T
    begins, full = np.zeros(6), 0.5 * (high - low)
    begins[5], full[5] = low[5], high[5] - low[5]  # the gripper from 0
    normalised = replace(
        recording,
        position=100.0 * (recording.position - begins) / full,
        position_command=100.0 * (recording.position_command - begins) / full,
        velocity=None,
    )
    with pytest.raises(BadInput) as error:
        check_position_only(sim.arm, [normalised], ["run"], AS_IT_IS)
    ((units, zero),) = re.findall(r'--units "(q=percent:[^"]*)" --zero (\S*),', str(error.value))
    assert "--units q=deg,q_cmd=deg, or for per cent of the ranges" in str(error.value)
    stated = parse_corrections(units=[units], zero=[zero])
    (read,), found = check_position_only(sim.arm, [stated.apply(normalised, "run")], ["run"], stated)
    assert found == []
    np.testing.assert_allclose(read.position, recording.position, atol=2e-4)
    np.testing.assert_allclose(read.position_command, recording.position_command, atol=2e-4)


def test_degrees_that_no_per_cent_reaches_are_asked_about_as_degrees(realdata):
    sim = load_model(realdata / "so101" / "sim.xml", (), 6)
    t = np.arange(0.0, 20.0, 0.02)
    q = np.outer(np.sin(t), np.full(6, 105.0))
    with pytest.raises(BadInput, match="--units q=deg") as error:
        check_position_only(sim.arm, [Recording(t=t, position=q, position_command=q)], ["run"], AS_IT_IS)
    assert "percent" not in str(error.value)


def test_the_unit_of_a_joint_goes_before_that_of_all():
    """A gripper is recorded in per cent beside joints in degrees."""
    t = np.arange(0.0, 1.0, 0.1)
    q = np.full((len(t), 2), 50.0)
    recording = Recording(t=t, position=q, position_command=q)
    stated = parse_corrections(units=["q=deg,q_2=percent:120", "q_cmd_2=percent:120,q_cmd=deg"])
    read = stated.apply(recording, "run")
    for values in (read.position, read.position_command):
        np.testing.assert_allclose(values[0], np.radians([50.0, 60.0]))
    with pytest.raises(BadInput, match=r"tau=percent:3: expected N·m.*A:N·m-per-A"):
        parse_corrections(units=["tau=percent:3"])
    with pytest.raises(BadInput, match=r"q=percent: expected rad, deg, turn, counts:N or percent:DEGREES"):
        parse_corrections(units=["q=percent"])
    with pytest.raises(BadInput, match="numbers other than 0"):
        parse_corrections(units=["q=percent:0"])
