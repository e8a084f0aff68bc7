"""What the drives of several families have in common."""

from types import SimpleNamespace

import pytest

from armlink.drives.base import BasicDrives


@pytest.mark.parametrize(("present", "missing"), [((True, True), []), ((True, False), [1]), ((False, False), [0, 1])])
def test_joints_whose_drive_does_not_answer_are_missing(present, missing):
    found = [SimpleNamespace(joint=joint, present=there) for joint, there in enumerate(present)]
    assert BasicDrives.missing(SimpleNamespace(identify=lambda ask: found), None) == missing
