"""Which drive moved with the joint that somebody turned."""

from types import SimpleNamespace

import pytest

from armlink.drives.findings import FoundDrive
from armlink.errors import BadInput, BusFault
from calib.commissioning.drive_match import match_in_order, moved_drive


def test_in_the_order_of_their_ids_there_must_be_as_many_drives_as_joints():
    drives = [FoundDrive("canopen", node, f"node {node}", None, 1, 2, 40.0, 30.0, 1e-5) for node in (3, 5, 8)]
    matches = match_in_order(["j1", "j2", "j3"], SimpleNamespace(found=drives), "the bus")
    assert [(each.joint, each.drive.node, each.by_hand) for each in matches] == [
        ("j1", 3, False),
        ("j2", 5, False),
        ("j3", 8, False),
    ]
    with pytest.raises(BadInput, match=r"3 drives answer \(node 3, node 5, node 8\), the arm has 2 joints.*--by-hand"):
        match_in_order(["j1", "j2"], SimpleNamespace(found=drives), "the bus")
    with pytest.raises(BusFault, match=r"3 drives answer .*, the arm has 4 joints: check power"):
        match_in_order(["j1", "j2", "j3", "j4"], SimpleNamespace(found=drives), "the bus")


def test_a_joint_counts_as_turned_from_a_tenth_of_a_radian_on():
    assert moved_drive("j1", {"node 1": 0.01, "node 2": -0.1, "node 3": 0.0}, "the bus") == "node 2"
    with pytest.raises(BusFault, match="no drive read the motion of j1"):
        moved_drive("j1", {"node 1": 0.01, "node 2": -0.099, "node 3": 0.0}, "the bus")


def test_its_drive_read_three_times_what_any_other_did():
    assert moved_drive("j1", {"node 1": -0.125, "node 2": 0.375}, "the bus") == "node 2"
    with pytest.raises(BusFault, match="node 2 and node 1 both moved with j1"):
        moved_drive("j1", {"node 1": -0.126, "node 2": 0.375}, "the bus")
    assert moved_drive("j1", {"node 4": 0.2}, "the bus") == "node 4"
