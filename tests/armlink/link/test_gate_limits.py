"""The gate's limits come from the arm file, exactly; what no frame of CiA 402 carries is refused."""

import math
from pathlib import Path

import numpy as np
import pytest

from armlink.arm_file import LinkJoint, load_arm, parse_arm
from armlink.drives.canopen.controller_setup import milliseconds
from armlink.drives.canopen.cyclic.wire import check_fits
from armlink.drives.canopen.units import Units
from armlink.errors import BadInput
from armlink.link.gate_limits import drive_limits, gate_limits, joint_ranges, target_window

UNITS = Units(torque=0.04, position=1e-5, velocity=1e-5, encoder_step=1e-6)


def joint(**keys):
    return LinkJoint(name="elbow", node=3, **{"rated_torque": 40.0, "max_torque": 30.0, **keys})


def tried(row, window, units=UNITS):
    """Limits of a joint, tried on frames with these units."""
    limits = drive_limits(row, window, 0.004, 0.1)
    check_fits(row, limits, units)
    return gate_limits(limits)


def test_limits_of_one_joint():
    limits = tried(joint(max_torque_rate=100.0, max_velocity=0.8), (-1.5, 2.5))
    assert limits.max_torque == 30.0
    assert limits.torque_step == pytest.approx(0.4)
    assert limits.position_step == pytest.approx(0.0032)
    assert (limits.lower, limits.upper) == (-1.5, 2.5)
    assert limits.overspeed == pytest.approx(1.12)  # refused from 1.4 times on: stopped before 1.5 times
    assert limits.servo_overspeed == 3.0  # a joint that sinks is caught
    assert tried(joint(max_velocity=2.0), (-1, 1)).servo_overspeed == pytest.approx(6.0)
    assert limits.following == 0.5
    assert limits.outside == 0.1
    assert limits.max_age == 0.1


def test_the_window_has_room_for_the_sensor_and_for_pressing():
    assert target_window(-2.0, 1.0) == pytest.approx((-2.0 - 0.09, 1.0 + 0.09))
    assert target_window(-1.0, 3.0) == pytest.approx((-1.0 - 0.11, 3.0 + 0.11))
    assert target_window(0.0, 0.0) == (-0.05, 0.05)
    assert target_window(-3.0, -1.0) == pytest.approx((-3.0 - 0.11, -1.0 + 0.11))
    assert target_window(1.0, 3.0) == pytest.approx((1.0 - 0.11, 3.0 + 0.11))


def test_a_torque_that_no_frame_carries_is_refused():
    most = 32767 * UNITS.torque
    assert tried(joint(max_torque=most), (-1, 1)).max_torque == most
    with pytest.raises(BadInput, match=r"elbow: max_torque is 1310\.7\d* N·m, but 6071h carries at most 1310\.68 N·m"):
        tried(joint(max_torque=most + 0.05), (-1, 1))


@pytest.mark.parametrize("side", [-1, 1])
def test_a_window_that_no_frame_carries_is_refused(side):
    far = side * (2**31 - 1) * 0.5
    window = (min(far, 0.0), max(far, 0.0))
    units = Units(0.04, 0.5, 0.5, 1e-6)
    assert tried(joint(), window, units).lower == window[0]
    beyond = (window[0] + min(side, 0) * 0.5, window[1] + max(side, 0) * 0.5)  # one user unit more
    with pytest.raises(
        BadInput, match=r"elbow: 607Ah cannot carry the range of this joint, since one user unit is only 0\.5 rad"
    ):
        tried(joint(), beyond, units)


def test_milliseconds_are_rounded_up_and_never_zero():
    assert [milliseconds(s) for s in (0.1, 0.0501, 0.05, 0.0001, 0.0)] == [100, 51, 50, 1, 1]
    assert milliseconds(0.1 * 3) == 300  # 0.30000000000000004 s is 300 ms
    assert milliseconds(2.0000001e-3) == 3


def test_ranges_of_denavit_hartenberg_joints_are_their_stops():
    joints = [{"name": "a", "lower": -1.0, "upper": 2.0}, {"name": "b", "lower": 0.5, "upper": 0.75}]
    rows = [{"name": name, "node": i, "rated_torque": 1.0, "max_torque": 1.0} for i, name in enumerate("ab", 1)]
    arm = parse_arm({"name": "x", "kinematics": {"joints": joints}, "link": {"joints": rows}}, Path("x.yaml"))
    assert joint_ranges(arm) == ((-1.0, 2.0), (0.5, 0.75))


MODEL = (
    '<mujoco><compiler angle="degree"/><worldbody><body><joint name="a" range="-90 45"/><geom size="1"/>'
    '<body><joint name="b" range="-10 10"/><geom size="1"/></body></body></worldbody></mujoco>'
)


def model_arm(folder, model, *names):
    (folder / "arm.xml").write_text(model)
    rows = "".join(
        f"    - {{name: {name}, node: {i}, rated_torque: 1.0, max_torque: 1.0}}\n" for i, name in enumerate(names, 1)
    )
    (folder / "arm.yaml").write_text(f"name: m\nkinematics: {{model: arm.xml}}\nlink:\n  joints:\n{rows}")
    return load_arm(folder / "arm.yaml")


def test_ranges_of_a_model_are_by_name_and_in_the_order_of_the_link(tmp_path):
    np.testing.assert_allclose(np.degrees(joint_ranges(model_arm(tmp_path, MODEL, "b", "a"))), [[-10, 10], [-90, 45]])


def test_what_a_model_lacks_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"link\.joints names the joint wrist, but .*arm\.xml has no such joint"):
        joint_ranges(model_arm(tmp_path, MODEL, "a", "wrist"))
    free = MODEL.replace(' range="-10 10"', "")
    with pytest.raises(BadInput, match=r"arm\.xml: joint b has no range: give its stops \[rad\]"):
        joint_ranges(model_arm(tmp_path, free, "a", "b"))
    with pytest.raises(BadInput, match=r"arm\.xml: "):
        joint_ranges(model_arm(tmp_path, "<mujoco><nonsense/></mujoco>", "a"))
    assert math.isfinite(joint_ranges(model_arm(tmp_path, MODEL, "a"))[0][0])


@pytest.mark.parametrize(
    ("key", "carried", "says"),
    [
        ("max_velocity", (2**32 - 1) * UNITS.position, "6081h carries at most 42949.7 rad/s"),
        ("max_torque_rate", (2**32 - 1) * UNITS.torque, r"6087h carries at most 1.71799e\+08 N·m/s"),
    ],
)
def test_a_rate_that_no_object_carries_is_refused(key, carried, says):
    tried(joint(**{key: carried}), (-1, 1))
    with pytest.raises(BadInput, match=f"elbow: {key} is .*, but {says}"):
        tried(joint(**{key: carried * 1.001}), (-1, 1))
