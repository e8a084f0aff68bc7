"""The text of a drafted arm file: names come back as they are, and nothing in one becomes a line of the file."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.arm_file import SIMULATED, Bus, load_arm
from armlink.cli import run
from armlink.content.file_content import parse_yaml
from armlink.content.yaml_text import yaml_comment, yaml_document, yaml_entry, yaml_item
from armlink.drives.findings import FoundDrive
from armlink.errors import BadInput
from calib.commissioning.draft import Draft, JointDraft, arm_text
from calib.commissioning.drive_match import Match, wired_text
from calib.commissioning.drive_match import _text as bus_text

NAMES = [
    "on", "null", "12", "1e3", "2026-01-01", "a, b", "joint: 1", "#1", "Gelenk_ü", "'", '"', "a: {b: [c", "*a", "&a",
    "elbow\n  stops: {elbow: [-30.0, 30.0]}\n  #", "elbow\ndaemon: {policy: apply}", "a\rb", "a\u2028b", "a\u0085b",
    "a\u202eb", "\x1b[2J", "- a", "? a", "%a", "@a", "`a", "~", "", " a ", "a #b", "a\tb", "\ufeffa", "😀",
]  # fmt: skip
TEXTS = st.one_of(st.sampled_from(NAMES), st.text(st.characters(exclude_categories=["Cs"]), max_size=40))
STOPS = (-1.0, 1.0)


def drafted(name: str, other: str, note: str = "") -> Draft:
    joints = [
        JointDraft(each, node, 40.0, 30.0, 200.0, 1.0, 0.8, 0.01, STOPS) for node, each in enumerate([name, "j-2.a"], 1)
    ]
    joints[0].notes = [note] if note else []
    aside = ((other, "is a gripper"),)
    notes = [note] if note else []
    return Draft(name, Path("arm.urdf"), other, (0.0, 0.0, -9.81), joints, aside, notes, name, other, note or None)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_read_back_as_it_is(name, tmp_path):
    rows = enumerate([name, "j-2.a"], start=1)
    joints = [JointDraft(each, node, 40.0, 30.0, 200.0, 1.0, 0.8, 0.0) for node, each in rows]
    draft = Draft(name, Path("arm.urdf"), name, (0.0, 0.0, -9.81), joints, aside=(), notes=[])
    text = arm_text(draft, tmp_path / "arm.yaml")
    content = yaml.safe_load(text)
    assert (content["name"], content["kinematics"]["tip"]) == (name, name)
    assert [joint["name"] for joint in content["link"]["joints"]] == [name, "j-2.a"]
    assert [effect["joint"] for effect in content["sim"]["effects"]] == [name, "j-2.a"]
    assert "{name: j-2.a, node: 2," in text  # without quotes, as one would write it


@settings(deadline=None, max_examples=50, derandomize=True)
@given(TEXTS.filter(lambda name: name != "j-2.a"), TEXTS, TEXTS)
def test_no_text_from_outside_adds_to_the_file(name, other, note):
    """Whatever stands in names of joints, bodies, files, and in remarks."""
    content = yaml.safe_load(arm_text(drafted(name, other, note), Path("/nowhere/arm.yaml")))
    assert set(content) - {"sweep"} == {"name", "serial", "kinematics", "link", "sim"}
    assert set(content["kinematics"]) == {"model", "base", "tip", "gravity", "stops"}
    assert content["kinematics"]["stops"] == {name: [-1.0, 1.0], "j-2.a": [-1.0, 1.0]}
    assert (content["kinematics"]["base"], content["kinematics"]["tip"]) == (other, other)
    assert set(content["link"]) == {"bus", "rate", "joints"}
    assert (content["name"], content["serial"]) == (name, name)
    assert content.get("sweep", {"hold": "servo"}) == {"hold": "servo"}


@settings(deadline=None, max_examples=50, derandomize=True)
@given(TEXTS.filter(lambda name: name != "j-2.a"), TEXTS, TEXTS)
def test_no_text_of_a_drive_or_bus_adds_to_the_file_or_changes_the_rest(name, other, note):
    before = arm_text(drafted(name, other, note), Path("/nowhere/arm.yaml"))
    arm = SimpleNamespace(require_link=lambda: SimpleNamespace(bus=Bus(interface=SIMULATED)), model_path=None)
    matches = [
        Match(each, FoundDrive("acme", 7 + place, other, {"id": 7 + place, "model": name}, note=note), by_hand=False)
        for place, each in enumerate([name, "j-2.a"])
    ]
    bus = {"interface": other, "channel": name, "bitrate": 1}
    text, _ = wired_text(before, arm, matches, Path("/nowhere/arm.yaml"), bus, other)
    content, kept = yaml.safe_load(text), yaml.safe_load(before)
    assert content["link"]["bus"] == bus
    assert content["serial"] == (other or kept["serial"])
    for place, (row, old) in enumerate(zip(content["link"]["joints"], kept["link"]["joints"], strict=True)):
        del old["node"]
        assert row == old | {"drive": {"family": "acme", "id": 7 + place, "model": name}}
    for each in (content, kept):
        del each["serial"], each["link"]["bus"], each["link"]["joints"]
    assert content == kept


@settings(deadline=None, max_examples=100, derandomize=True)
@given(TEXTS, TEXTS)
def test_the_file_of_a_bus_alone_has_what_the_bus_is_called(channel, name):
    drive = FoundDrive("canopen", 3, "node 3", vendor=1, product=2, rated_torque=10.0, max_torque=20.0, unit=1e-4)
    text = bus_text([Match("joint_1", drive, by_hand=False)], [(-1.0, 1.0)], channel, {"channel": channel}, name)
    content = yaml.safe_load(text)
    assert set(content) == {"name", "serial", "kinematics", "link", "sweep"}
    assert (content["name"], content["link"]["bus"]) == (name, {"channel": channel})


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.recursive(TEXTS | st.integers() | st.floats(allow_nan=False) | st.booleans() | st.none(), st.lists), TEXTS)
def test_values_and_remarks_are_one_line_and_come_back(value, note):
    for line in (yaml_entry("key", value, 2, note), yaml_item(value, 2, note), yaml_comment(note)):
        assert len(line.splitlines()) == 1
    assert yaml.safe_load(yaml_entry("key", value, note=note)) == {"key": value}
    assert yaml.safe_load(yaml_item(value, 0, note)) == [value]
    assert yaml.safe_load(yaml_comment(note)) is None
    assert yaml.safe_load(yaml_document({"key": value})) == {"key": value}


MODEL = """<mujoco model="m"><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" range="-60 60"
 limited="true"/><geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="2"/><body name="fore" pos="0.4 0 0">
<joint name="elbow" axis="0 1 0" range="-60 60" limited="true"/><geom type="capsule" size="0.03"
 fromto="0.1 0 0 0.3 0 0" mass="1"/><body name="hand" pos="0.4 0 0"><joint name="{name}" type="slide" axis="1 0 0"
 range="0 0.04" limited="true"/><geom type="sphere" size="0.01" mass="0.1"/></body></body></body>
</worldbody></mujoco>"""
INJECTED = "grip&#10;  stops: {{shoulder: [-30.0, 30.0], elbow: [-30.0, 30.0]}}&#10;  #"


@pytest.mark.parametrize("injected", [INJECTED, "grip&#10;sweep: {{hold: stops}}&#10;daemon: {{policy: apply}}&#10;#"])
def test_a_hostile_model_injects_nothing(injected, tmp_path, capsys):
    """A gripper whose name has lines of an arm file in it: new sets it aside, and says so in a comment."""
    model, out = tmp_path / "m.xml", tmp_path / "m.yaml"
    model.write_text(MODEL.format(name=injected.replace("{{", "{").replace("}}", "}")))
    assert run(["new", str(model), "--out", str(out)]) == 0
    arm = load_arm(str(out))
    assert not arm.kinematics.stops
    assert arm.daemon is None
    assert all(each.isprintable() or each == "\n" for each in "".join(capsys.readouterr()))


def test_a_hostile_name_of_a_joint_of_the_arm_is_one_line(tmp_path, capsys):
    model, out = tmp_path / "m.xml", tmp_path / "m.yaml"
    hostile = "elbow&#10;  stops: {shoulder: [-30.0, 30.0]}&#10;  #"
    model.write_text(MODEL.format(name="grip").replace('name="elbow"', f'name="{hostile}"'))
    assert run(["new", str(model), "--out", str(out)]) == 2
    assert not out.exists()
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"armlink: {out}: key ")


def test_text_that_is_no_yaml_is_one_line():
    with pytest.raises(BadInput, match=r"^arm\.yaml: not YAML: "):
        parse_yaml("a: [", Path("arm.yaml"))
