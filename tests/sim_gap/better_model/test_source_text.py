"""Names in written sources are literals: no name is run, and each comes back as it is."""

import ast
import re
import sys
from dataclasses import make_dataclass
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.arm.model_files import xml_comment
from sim_gap.better_model.export import module_text
from sim_gap.better_model.training_files import write_entries

HOSTILE = (
    '"]); import os; os.system("touch made") #',
    '"""\nRAN = 1\n"""',
    "\\",
    '\\"',
    "elbow\nRAN = 1",
    "EFFECTS: tuple[JointEffect, ...] = ()",
    "JOINTS: tuple[str, ...] = ()\\",
    "a.b[0]",
    "--><x/><!--",
    "\x00\x1b\u2028",
)
NAMES = st.one_of(st.sampled_from(HOSTILE), st.text(st.characters(exclude_categories=["Cs"]), max_size=30))


OTHER_FIELDS = [(name, float, 0.0) for name in ("stiffness", "damping", "min_delay", "max_delay")]


def entries_of(name: str, folder: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the written file makes with frameworks that keep what they are given; names of the file."""
    path = folder / "entries.py"
    row = {"stiffness": 1.0, "damping": 0.1, "least": 0.0, "most": 1.0}
    write_entries({name: row}, path, 0.002, about=name, left=[name])
    framework = ModuleType("isaaclab.actuators")
    framework.DelayedPDActuatorCfg = lambda **given: given  # type: ignore[attr-defined]
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "isaaclab", ModuleType("isaaclab"))
        patch.setitem(sys.modules, "isaaclab.actuators", framework)
        exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), names)
        return names["isaac_lab"](), names


@pytest.mark.parametrize("name", ["actuator_effort_limit", "effort_limit"])
def test_a_limit_has_the_name_that_the_installed_isaac_lab_knows(name, tmp_path, monkeypatch):
    """Isaac Lab 3 renamed it: https://isaac-sim.github.io/IsaacLab/release/3.0.0, `ActuatorBaseCfg`."""
    entry = make_dataclass("DelayedPDActuatorCfg", [("joint_names_expr", list), *OTHER_FIELDS, (name, float, 0.0)])
    framework = ModuleType("isaaclab.actuators")
    framework.DelayedPDActuatorCfg = entry  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "isaaclab", ModuleType("isaaclab"))
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", framework)
    row = {"stiffness": 1.0, "damping": 0.1, "limit": 2.5, "least": 0.0, "most": 1.0}
    write_entries({"elbow": row}, tmp_path / "entries.py", 0.002)
    names: dict[str, Any] = {}
    exec((tmp_path / "entries.py").read_text(encoding="utf-8"), names)
    assert getattr(names["isaac_lab"]()["elbow"], name) == 2.5


def test_names_of_actuator_entries_are_literals(tmp_path):
    @settings(deadline=None, max_examples=150, derandomize=True)
    @given(NAMES)
    def check(name: str) -> None:
        made, names = entries_of(name, tmp_path)
        assert list(made) == [name]
        (pattern,) = made[name]["joint_names_expr"]
        assert re.fullmatch(pattern, name)
        assert {key for key in names if not key.startswith("__")} == {"isaac_lab", "mjlab"}

    check()


@settings(deadline=None, max_examples=150, derandomize=True)
@given(NAMES, NAMES)
def test_names_of_the_effects_module_are_literals(name: str, model: str) -> None:
    sim: Any = SimpleNamespace(arm=SimpleNamespace(names=(name, "b")))
    text = module_text(sim, [("friction.coulomb", name, {"torque": 1.0})], model)
    values = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and node.targets[0].id in ("MODEL", "JOINTS", "EFFECTS", "RAN")
    }
    assert values == {
        "MODEL": model,
        "JOINTS": (name, "b"),
        "EFFECTS": (("friction.coulomb", name, {"torque": 1.0}),),
    }


@given(st.lists(NAMES, max_size=3))
def test_a_comment_of_xml_stays_one(names: list[str]) -> None:
    root = ElementTree.fromstring(f"{xml_comment(names)}<mujoco/>")
    assert (root.tag, len(root)) == ("mujoco", 0)
