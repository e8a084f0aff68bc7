"""Joints are matched by name; where that is not certain, nothing is diagnosed."""

import numpy as np
import pytest

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.check import match_joints

MODEL = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")


def recording(*names: str) -> Recording:
    values = np.arange(2.0 * max(len(names), 3)).reshape(2, -1)[:, : len(names) or 3]
    return Recording(t=np.array([0.0, 1.0]), position=values, torque=values, names=names)


def order(taken: Recording) -> list[float]:
    return taken.position[0].tolist()


def test_another_order_and_a_gripper():
    taken, found = match_joints(
        recording("elbow_joint", "gripper_left", "shoulder_lift_joint", "shoulder_pan_joint"), MODEL, AS_IT_IS, "r"
    )
    assert taken.names == MODEL
    assert order(taken) == [3.0, 2.0, 0.0]
    assert "gripper_left" in taken.warning
    assert found == []


def test_names_with_another_prefix_and_order_are_matched_and_said():
    taken, (finding,) = match_joints(recording("ur_elbow", "ur_shoulder_lift", "ur_shoulder_pan"), MODEL, AS_IT_IS, "r")
    assert order(taken) == [2.0, 1.0, 0.0]
    assert finding.finding == "order"
    assert "ur_elbow as elbow_joint" in finding.evidence


def test_numbers_match_in_any_notation():
    taken, _ = match_joints(recording("A3", "A1", "A2"), ("lbr_a1", "lbr_a2", "lbr_a3"), AS_IT_IS, "r")
    assert order(taken) == [1.0, 2.0, 0.0]


@pytest.mark.parametrize(
    "names", [("a", "b", "c"), ("elbow", "elbow_2", "shoulder"), ("left_elbow", "right_elbow", "x")]
)
def test_unknown_names_are_refused_with_the_option(names):
    with pytest.raises(BadInput, match=r"r: the recording has the joints .* --joints "):
        match_joints(recording(*names), MODEL, AS_IT_IS, "r")


def test_a_stated_order_counts():
    stated = parse_corrections(joints="a,b,c")
    taken, _ = match_joints(recording("a", "b", "c"), MODEL, stated, "r")
    assert taken.names == MODEL


def test_a_file_without_names_keeps_its_order():
    taken, found = match_joints(recording(), MODEL, AS_IT_IS, "r")
    assert (order(taken), found) == ([0.0, 1.0, 2.0], [])


def test_a_table_mapped_by_hand_keeps_its_order_where_names_do_not_match():
    stated = parse_corrections(columns=["q_1=pos_left,q_2=pos_mid,q_3=pos_right"])
    taken, found = match_joints(recording("left", "mid", "right"), MODEL, stated, "r")
    assert (order(taken), taken.names, found) == ([0.0, 1.0, 2.0], ("joint_1", "joint_2", "joint_3"), [])
