"""What the drives on an open bus say against the arm file."""

from types import SimpleNamespace

import pytest

from calib.commissioning import doctor as bus_checks


@pytest.mark.parametrize(
    ("present", "mismatch", "said"),
    [
        (False, "", ["no answer on virtual:test"]),
        (True, "joint_1: 100:1 gear, the arm file says 50:1", ["joint_1: 100:1 gear, the arm file says 50:1"]),
        (True, "", []),
    ],
)
def test_a_drive_that_is_silent_or_another_one_is_found(monkeypatch, present: bool, mismatch: str, said: list) -> None:
    drive = SimpleNamespace(joint=0, address="node 1", present=present, mismatch=mismatch)
    family = SimpleNamespace(examine=None)
    monkeypatch.setattr(bus_checks, "make_groups", lambda arm, opened: [SimpleNamespace(family=family)])
    monkeypatch.setattr(
        bus_checks, "Link", lambda arm, opened: SimpleNamespace(names=("joint_1",), scan=lambda: [drive])
    )
    monkeypatch.setattr(bus_checks, "_places", lambda link: ())
    found = list(bus_checks._drives(None, None, "virtual:test"))
    assert [finding.what for finding in found] == said
    assert all(finding.level == "error" and "joint_1 (node 1)" in finding.where for finding in found)
