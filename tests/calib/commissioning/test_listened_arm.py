"""armlink doctor of an arm that another program commands."""

import pytest

from armlink.arm_file import load_arm
from calib.commissioning import doctor


def test_doctor_asks_nothing_of_an_arm_that_is_listened_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "open_link_bus", None)
    (found,) = doctor.bus_findings(load_arm("sarcos"), "ros2:/joint_states")
    assert found.level == "hint"
    assert "only listens" in found.what
