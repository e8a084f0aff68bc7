"""Words of the control pipe."""

import pytest

from armlink.errors import BadInput
from sim_bus.bus.control_pipe import _turn


def test_a_hand_turns_a_joint_to_an_angle():
    assert _turn("joint_2:0.5") == ("joint_2", 0.5)
    assert _turn("left:joint_2:-1e-1") == ("left:joint_2", -0.1)


@pytest.mark.parametrize("wrong", ["joint_2", "0.5", "joint_2:", "joint_2:far"])
def test_a_hand_without_joint_or_angle_is_refused(wrong):
    with pytest.raises(BadInput, match=f"hand '{wrong}': expected JOINT:ANGLE in rad"):
        _turn(wrong)
