"""The text of a drafted arm file."""

from pathlib import Path

import pytest
import yaml

from calib.commissioning.arm_text import arm_text
from calib.commissioning.draft import Draft, JointDraft


@pytest.mark.parametrize("name", ["on", "null", "12", "1e3", "2026-01-01", "a, b", "joint: 1", "#1", "Gelenk_ü", "'"])
def test_a_name_is_read_back_as_it_is(name, tmp_path):
    joints = [JointDraft(each, node, 40.0, 30.0, 200.0, 1.0) for node, each in enumerate([name, "j-2.a"], start=1)]
    draft = Draft(name, Path("arm.urdf"), name, (0.0, 0.0, -9.81), joints, aside=(), notes=[])
    text = arm_text(draft, tmp_path / "arm.yaml")
    content = yaml.safe_load(text)
    assert (content["name"], content["kinematics"]["tip"]) == (name, name)
    assert [joint["name"] for joint in content["link"]["joints"]] == [name, "j-2.a"]
    assert [effect["joint"] for effect in content["sim"]["effects"]] == [name, "j-2.a"]
    assert "{name: j-2.a, node: 2," in text  # without quotes, as one would write it
