"""Findings about gravity and the levers that it has on the joints."""

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.drives.findings import SetupFinding
from calib.commissioning.model_checks import model_findings


def found(*gravity: float) -> list[SetupFinding]:
    """Findings about the levers of a bundled arm under another gravity [m/s²]."""
    arm = load_arm("sarcos")
    kinematics = arm.kinematics.model_copy(update={"gravity": gravity})
    findings = model_findings(arm.model_copy(update={"kinematics": kinematics}))
    return [each for each in findings if "gravity" in each.what]


def test_levers_are_those_of_any_gravity_and_none_is_judged_without() -> None:
    usual, turned = found(0.0, 0.0, -9.81), found(0.0, -9.81, 0.0)
    assert not any("m/s²" in each.what for each in [*usual, *turned])
    assert usual != turned
    moon = found(0.0, 0.0, -1.62)
    with np.errstate(all="raise"):
        none = found(0.0, 0.0, 0.0)
    assert moon[0].what == "gravity is 1.62 m/s², not 9.81"
    assert moon[1:] == usual
    assert [each.what for each in none] == ["gravity is 0 m/s², not 9.81"]


def test_a_joint_whose_axis_is_vertical_is_named() -> None:
    dead = [each for gravity in ((0.0, 0.0, -9.81), (0.0, -9.81, 0.0), (-9.81, 0.0, 0.0)) for each in found(*gravity)]
    assert any("its axis is vertical, so" in each.what and each.where == "joint_1" for each in dead)


@pytest.mark.parametrize(("size", "said"), [(9.69, True), (9.71, False), (9.89, False), (9.91, True)])
def test_gravity_on_earth_is_not_mentioned(size: float, said: bool) -> None:
    assert any("m/s²" in each.what for each in found(0.0, 0.0, -size)) is said
