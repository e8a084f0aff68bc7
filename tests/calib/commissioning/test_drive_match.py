"""Which drive moved with the joint that somebody turned."""

import pytest

from armlink.errors import BusFault
from calib.commissioning.drive_match import moved_node


def test_a_joint_counts_as_turned_from_a_tenth_of_a_radian_on():
    assert moved_node("j1", {1: 0.01, 2: -0.1, 3: 0.0}, "the bus") == 2
    with pytest.raises(BusFault, match="no drive read the motion of j1"):
        moved_node("j1", {1: 0.01, 2: -0.099, 3: 0.0}, "the bus")


def test_its_drive_read_three_times_what_any_other_did():
    assert moved_node("j1", {1: -0.125, 2: 0.375}, "the bus") == 2
    with pytest.raises(BusFault, match="nodes 2 and 1 both moved with j1"):
        moved_node("j1", {1: -0.126, 2: 0.375}, "the bus")
    assert moved_node("j1", {4: 0.2}, "the bus") == 4
