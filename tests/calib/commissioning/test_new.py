"""From a model to an arm file: chain, limits, drives found by hand, and what is assumed says so."""

import copy
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from armlink import cli
from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.drives.canopen.check.scan import FoundNodes
from armlink.drives.searched_bus import SearchedBus
from armlink.errors import BadInput, BusFault
from calib.arm.kinematics import gcomp_arm
from calib.commissioning.drive_match import arm_of_bus
from calib.commissioning.new_arm import NewArm, new_arm
from calib.plan.collisions import Geometry, check_plan
from calib.plan.rough_gravity import guess_of_file
from calib.plan.sweep_plan import plan_sweep
from gcomp.errors import BadModel
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

MODELS = Path(__file__).parents[2] / "models"


@pytest.fixture(scope="module")
def planned(tmp_path_factory) -> NewArm:
    return new_arm(MODELS / "arm4.urdf", tmp_path_factory.mktemp("made") / "arm4.yaml")


@pytest.fixture
def made(planned, tmp_path) -> NewArm:
    """Of its own for each test, beside a copy of the model."""
    shutil.copy(MODELS / "arm4.urdf", tmp_path)
    draft = replace(copy.deepcopy(planned.draft), model=tmp_path / "arm4.urdf")
    return NewArm(tmp_path / "arm4.yaml", draft)


def test_gripper_and_mimic_joints_are_set_aside(made):
    assert [joint.name for joint in made.draft.joints] == ["j1", "j2", "j3", "j4"]
    assert dict(made.draft.aside).keys() == {"grip_l", "grip_r"}
    assert made.draft.tip == "l4"


def test_limits_torques_and_speeds_are_the_model_s(made):
    arm = gcomp_arm(made.parsed())
    np.testing.assert_allclose(arm.lower, [-2.5, -2.0, -2.2, -2.9])
    np.testing.assert_allclose(arm.upper, [2.5, 1.0, 2.2, 2.9])
    link = made.parsed().require_link()
    assert [joint.rated_torque for joint in link.joints] == [40, 40, 20, 8]
    assert all(joint.max_velocity == 1.0 for joint in link.joints)


def test_every_assumed_value_is_a_comment_of_the_file(made):
    assert re.search(r"^  gravity: .*# .*assumed", made.text, re.MULTILINE)
    assert made.draft.assumed
    for each in made.draft.assumed:
        assert f"# {each.partition(': ')[2]}" in made.text


def test_a_joint_without_stops_is_not_pressed_on_any(made, tmp_path):
    assert made.parsed().sweep.hold == "servo"
    assert "# assumed: j4 has no stop to be pressed on" in made.text
    given = new_arm(MODELS / "arm4.urdf", tmp_path / "arm4.yaml", stops={"j4": (-1.5, 1.0)})
    assert given.parsed().sweep is None
    assert gcomp_arm(given.parsed()).upper[3] == 1.0


def test_prismatic_fingers_are_set_aside_and_a_range_that_a_plan_keeps_clear_stays_whole(tmp_path):
    made = new_arm(MODELS / "own.xml", tmp_path / "own.yaml")
    assert [joint.name for joint in made.draft.joints] == ["yaw", "pitch", "elbow", "roll"]
    assert all(joint.stops is None for joint in made.draft.joints)
    made.write()
    arm = load_arm(made.out)
    for seed in range(2):
        check_plan(arm, plan_sweep(arm, guess_of_file(arm), seed=seed))


def test_a_range_is_chosen_where_nothing_touches(tmp_path):
    """With its shoulder 20 cm above the ground the arm cannot be swept over its whole range."""
    low = tmp_path / "low.xml"
    low.write_text((MODELS / "own.xml").read_text().replace('pos="0 0 0.3"', 'pos="0 0 0.2"'))
    made = new_arm(low, tmp_path / "low.yaml")
    made.write()
    marked = [each for each in comments(made.out) if each.startswith("stops assumed")]
    assert len(marked) == sum(joint.stops is not None for joint in made.draft.joints) == 4
    arm = load_arm(made.out)
    geometry, limits = Geometry(arm), gcomp_arm(arm)
    poses = np.random.default_rng(5).uniform(limits.lower, limits.upper, (300, limits.n))
    assert geometry.free(poses).mean() > 0.99
    whole = gcomp_arm(
        parse_arm({"name": "own", "kinematics": {"model": str(MODELS / "own.xml"), "tip": "wrist"}}, made.out)
    )
    poses = np.random.default_rng(5).uniform(whole.lower, whole.upper, (300, limits.n))
    assert geometry.free(poses).mean() < 0.9  # the floor is there


def test_limits_more_than_a_turn_apart_are_no_stops(tmp_path, monkeypatch):
    monkeypatch.setattr("calib.commissioning.new_arm.sweep_problem", lambda arm_file: None)
    made = new_arm(MODELS / "ur10e.urdf", tmp_path / "ur10e.yaml")
    assert made.parsed().sweep.hold == "servo"
    limits = gcomp_arm(made.parsed())
    assert (limits.upper - limits.lower <= 2 * np.pi).all()
    asked = []
    questions = SimpleNamespace(stops=lambda joint: asked.append(joint.name) or (-3.0, 3.0))
    told = new_arm(MODELS / "ur10e.urdf", tmp_path / "ur10e.yaml", questions=questions)
    assert asked == [joint.name for joint in told.draft.joints if joint.stops == (-3.0, 3.0)] != []
    assert told.parsed().sweep is None


def test_two_arms_in_a_model(tmp_path, monkeypatch):
    monkeypatch.setattr("calib.commissioning.new_arm.sweep_problem", lambda arm_file: None)
    text = (MODELS / "own.xml").read_text()
    body = text[text.index('<body name="turret"') : text.index("  </worldbody>")]
    second = body
    for word in (
        "turret",
        "upper",
        "fore",
        "wrist",
        "palm",
        "left",
        "right",
        "yaw",
        "pitch",
        "elbow",
        "roll",
        "slide_",
    ):
        second = second.replace(f'"{word}', f'"other_{word}')
    model = tmp_path / "two.xml"
    model.write_text(
        text.replace("  </worldbody>", second.replace('pos="0 0 0.3"', 'pos="0 3 0.3"') + "  </worldbody>")
    )
    first = new_arm(model, tmp_path / "two.yaml")
    assert first.draft.joints[0].name == "yaw"
    assert "other_wrist" in " ".join(first.draft.notes)
    named = new_arm(model, tmp_path / "two.yaml", tip="other_wrist")
    assert named.draft.joints[0].name == "other_yaw"


def test_a_lift_and_a_waist_before_the_arm(tmp_path, monkeypatch):
    """The arm begins after a lift, which is none of its joints, and after a waist with --base, which may be one."""
    monkeypatch.chdir(tmp_path)
    Path("m.xml").write_text(
        '<mujoco><worldbody><body name="column"><joint name="lift" type="slide" axis="0 0 1" range="0 0.3"/>'
        '<geom size="0.1" mass="9"/>'
        '<body name="torso"><joint name="waist" axis="0 0 1" range="-90 90"/><geom size="0.1" mass="9"/>'
        '<body name="upper" pos="0.3 0 0"><joint name="shoulder" axis="0 1 0" range="-90 90"/><geom size="0.03" '
        'pos="0.2 0 0" mass="2"/></body></body></body></worldbody></mujoco>'
    )
    for base, names in (("column", ["waist", "shoulder"]), ("torso", ["shoulder"])):
        made = new_arm(Path("m.xml"), Path("a.yaml"), base=base)
        parsed = made.parsed()
        assert list(parsed.joint_names) == names
        assert parsed.kinematics.base == base
        assert gcomp_arm(parsed).names == tuple(names)
        assert ("lift", "is prismatic") in made.draft.aside
    made = new_arm(Path("m.xml"), Path("a.yaml"))
    assert (list(made.parsed().joint_names), made.parsed().kinematics.base) == (["waist", "shoulder"], "column")
    with pytest.raises(
        BadInput, match="--base shoulder: there is no such body that carries a joint; expected one of world, column"
    ):
        new_arm(Path("m.xml"), Path("a.yaml"), base="shoulder")


def test_joints_of_an_attached_model_keep_the_slash_in_their_names(tmp_path, monkeypatch):
    monkeypatch.setattr("calib.commissioning.new_arm.sweep_problem", lambda arm_file: None)
    text = (MODELS / "own.xml").read_text()
    (tmp_path / "left.xml").write_text(text.replace('name="yaw', 'name="left/yaw'))
    made = new_arm(tmp_path / "left.xml", tmp_path / "left.yaml")
    made.write()
    assert load_arm(made.out).joint_names[0] == "left/yaw" == gcomp_arm(made.parsed()).names[0]


def test_a_small_arm_has_drives_of_its_own_strength(tmp_path, monkeypatch):
    """0.06 N·m of load, not the 2 N·m that a wrist of a larger arm has at least: friction is a share of that."""
    monkeypatch.setattr("calib.commissioning.new_arm.sweep_problem", lambda arm_file: None)
    (tmp_path / "small.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" axis="0 1 0" range="-1 1"/>'
        '<inertial pos="0.1 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/><body pos="0.1 0 0">'
        '<joint name="b" axis="0 0 1" range="-1 1"/><inertial pos="0 0 0.01" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>'
        "</body></body></worldbody></mujoco>"
    )
    small = new_arm(tmp_path / "small.xml", tmp_path / "small.yaml").parsed()
    assert [joint.rated_torque for joint in small.require_link().joints] == pytest.approx([0.18, 0.18], rel=0.1)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('name="j2" type="revolute"', 'name="j2" type="prismatic"', "j2 is prismatic and lies between the base"),
        ('<joint name="j1" type="revolute">', '<joint name="" type="revolute">', "joint 1 of the chain"),
        ('<mass value="2"/>', '<mass value="two"/>', "MuJoCo refuses this file"),
    ],
)
def test_a_model_that_cannot_be_used_names_the_joint(old, new, says, tmp_path):
    text = (MODELS / "arm4.urdf").read_text()
    assert old in text
    model = tmp_path / "bad.urdf"
    model.write_text(text.replace(old, new))
    with pytest.raises((BadInput, BadModel), match=says):
        new_arm(model, tmp_path / "bad.yaml")


def real_arm(made: NewArm, folder: Path, nodes: list[int], position_gain: list[float]) -> SimulatedArm:
    """An arm on the bus as somebody wired it: other node ids, other ratings, signs and gears."""
    content = yaml.safe_load(made.text)
    for row, node in zip(content["link"]["joints"], nodes, strict=True):
        row |= {"node": node, "rated_torque": row["rated_torque"] * 1.1, "max_torque": row["max_torque"] * 1.2}
    content["sim"]["sensors"] = {"position_gain": position_gain}
    path = folder / "real.yaml"
    path.write_text(yaml.safe_dump(content))
    arm = load_arm(path)
    return SimulatedArm(arm, Truth.of(arm))


def hands(arm: SimulatedArm, made: NewArm):
    """A person who does what is asked."""
    limits = {each.name: each for each in made.draft.joints}
    known = gcomp_arm(made.parsed())
    ends = dict(zip(known.names, zip(known.lower, known.upper, strict=True), strict=True))

    def ask(text: str) -> None:
        joint = text.partition(":")[0]
        assert joint in limits
        arm.turn_by_hand(joint, ends[joint]["upper" in text])

    return ask


def comments(path: str) -> list[str]:
    lines = (line.strip() for line in Path(path).read_text().splitlines())
    return [line.removeprefix("# ") for line in lines if line.startswith("#")]


def test_permuted_ids_a_turned_sign_and_another_gear_are_found_by_hand(made, tmp_path):
    arm = real_arm(made, tmp_path, nodes=[12, 10, 11, 13], position_gain=[1.0, -1.0, 2.0, 1.01])
    drives = FoundNodes(SearchedBus(LockStepBus(arm=arm)))
    made.wire(drives, "the bus", hands(arm, made))
    assert [(each.level, each.where) for each in made.findings] == [
        ("error", "j2 (node 10)"),
        ("error", "j3 (node 11)"),
    ]
    assert "polarity" in made.findings[0].remedy
    assert "factor 0.5" in made.findings[1].remedy
    link = made.parsed().require_link()
    assert [joint.node for joint in link.joints] == [12, 10, 11, 13]
    assert [joint.rated_torque for joint in link.joints] == pytest.approx([44, 44, 22, 8.8])


def test_the_command_finds_other_ids_by_hand_and_its_file_passes_the_check(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm = real_arm(made, tmp_path, nodes=[12, 10, 11, 13], position_gain=[1.0] * 4)
    monkeypatch.setattr("calib.commands.setup.new.open_named", lambda bus: LockStepBus(arm=arm))
    monkeypatch.setattr("calib.commands.setup.terminal.hand", lambda by_hand, interactive: hands(arm, made))
    line = ["new", "arm4.urdf", "--out", "found.yaml", "--bus", "armlink_sim:real.yaml", "--by-hand"]
    assert cli.run(line) == 0
    assert "next: armlink check found.yaml" in capsys.readouterr().err
    assert cli.run(["check", "found.yaml"]) == 0
    assert [joint.node for joint in load_arm("found.yaml").require_link().joints] == [12, 10, 11, 13]


def test_damiao_drives_are_found_by_hand_with_direction_zero_and_gains_that_doctor_accepts(
    made, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(made.text)
    turns = [(3, -1, 0.7), (1, 1, 0.0), (4, 1, -0.4), (2, -1, 0.2)]
    for row, (number, direction, zero) in zip(content["link"]["joints"], turns, strict=True):
        del row["node"]
        drive = {"family": "damiao", "id": number, "reply": number + 0x10, "model": "DM8009", "kp": 40, "kd": 2}
        row["drive"] = drive | {"direction": direction, "zero": zero}
    (tmp_path / "real.yaml").write_text(yaml.safe_dump(content))
    described = load_arm("real.yaml")
    arm = SimulatedArm(described, Truth.of(described))
    monkeypatch.setattr("calib.commands.setup.new.open_named", lambda bus: LockStepBus(arm=arm))
    person = hands(arm, made)

    def turn(text: str) -> None:
        person(text)
        arm.advance(0.001)  # such a drive reads its encoder once in a while

    monkeypatch.setattr("calib.commands.setup.terminal.hand", lambda by_hand, interactive: turn)
    line = ["new", "arm4.urdf", "--out", "found.yaml", "--bus", "armlink_sim:real.yaml", "--by-hand"]
    assert cli.run(line) == 0
    drives = [joint.settings for joint in load_arm("found.yaml").require_link().joints]
    assert [(each.id, each.reply, each.model, each.direction) for each in drives] == [
        (number, number + 0x10, "DM8009", direction) for number, direction, _ in turns
    ]
    assert [each.zero for each in drives] == pytest.approx([zero for *_, zero in turns], abs=2e-3)
    capsys.readouterr()
    cli.run(["doctor", "found.yaml", "--offline"])
    assert "damping ratio" not in capsys.readouterr().out
    assert cli.run(["check", "found.yaml", "--passive"]) == 0
    content["link"]["joints"][0]["drive"] |= {"id": 9, "reply": 0x19, "direction": 1, "zero": 0.0, "kp": 33}
    made.write()
    assert cli.run(["new", "arm4.yaml", "--force", "--bus", "armlink_sim:real.yaml", "--by-hand"]) == 0
    assert [joint.settings for joint in load_arm("arm4.yaml").require_link().joints] == drives
    assert "kp, kd assumed: the torque range per radian, with the damping that armlink doctor requires" in comments(
        "arm4.yaml"
    )
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(content))
    assert cli.run(["new", "old.yaml", "--out", "mine.yaml", "--bus", "armlink_sim:real.yaml", "--by-hand"]) == 0
    first = load_arm("mine.yaml").require_link().joints[0].settings
    assert (first.id, first.reply, first.direction, first.kp) == (3, 0x13, -1, 33)
    assert first.zero == pytest.approx(0.7, abs=2e-3)
    content["link"]["joints"][0]["drive"] = {"family": "canopen", "node": 3}
    (tmp_path / "mixed.yaml").write_text(yaml.safe_dump(content))
    assert cli.run(["new", "mixed.yaml", "--out", "x.yaml", "--bus", "armlink_sim:real.yaml", "--by-hand"]) == 2
    assert "j1 has a drive of family canopen, id 03h is one of family damiao" in capsys.readouterr().err


def test_a_rating_beyond_the_torque_field_of_the_drive_is_cut_and_said(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(made.text)
    for number, row in enumerate(content["link"]["joints"], start=1):
        del row["node"]
        keys = {"id": number, "reply": number + 0x10, "model": "DM4310", "kp": 10, "kd": 1}
        row |= {"drive": {"family": "damiao", **keys}, "rated_torque": 5.0, "max_torque": 8.0}
    (tmp_path / "real.yaml").write_text(yaml.safe_dump(content))
    assert cli.run(["new", "arm4.urdf", "--bus", "armlink_sim:real.yaml"]) == 0
    said = capsys.readouterr().out
    for joint, torque in (("j1 (id 01h)", 40), ("j2 (id 02h)", 40), ("j3 (id 03h)", 20)):
        what = "the drive has a torque field that ends at 10 N·m, but by the model the joint needs a rated torque of"
        assert f"{joint}: {what} {torque} N·m" in said
    assert "j4 (id 04h): the drive" not in said
    joints = load_arm("arm4.yaml").require_link().joints
    assert [joint.rated_torque for joint in joints] == [joint.max_torque for joint in joints] == [10, 10, 10, 8]
    assert comments("arm4.yaml").count("rated_torque assumed: the end of the drive's torque field") == 3


def test_of_a_bus_alone_drives_and_stops_are_known_and_the_geometry_is_said_to_be_missing(
    made, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    arm = real_arm(made, tmp_path, nodes=[12, 10, 11, 13], position_gain=[1.0, -1.0, 1.0, 1.0])
    known, names = gcomp_arm(made.parsed()), [joint.name for joint in made.draft.joints]

    def ask(text: str) -> None:
        joint = int(text[len("joint_")]) - 1
        arm.turn_by_hand(names[joint], (known.upper if "other" in text else known.lower)[joint])

    text, matches = arm_of_bus(
        FoundNodes(SearchedBus(LockStepBus(arm=arm))), "the bus", {"interface": "x", "channel": "y"}, "mine", ask
    )
    rows = yaml.safe_load(text)["kinematics"]["joints"]
    assert [match.drive.node for match in matches] == [12, 10, 11, 13]
    lower = [row["lower"] for row in rows]
    np.testing.assert_allclose(lower, [-2.5, -1.0, -2.2, -2.9], atol=2e-3)  # the second counts the other way
    assert cli.run(["new", "--bus", "armlink_sim:real.yaml", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["next"] == "armlink check arm.yaml"
    assert cli.run(["check", "arm.yaml", "--passive"]) == 0
    assert cli.run(["doctor", "arm.yaml"]) == 1
    assert "geometry of the arm is not known" in capsys.readouterr().out
    assert cli.run(["new"]) == 2
    assert "--bus" in capsys.readouterr().err


def test_in_order_of_ids_a_doubtful_rating_is_named(made, tmp_path):
    arm = real_arm(made, tmp_path, nodes=[4, 3, 2, 1], position_gain=[1.0] * 4)
    made.wire(FoundNodes(SearchedBus(LockStepBus(arm=arm))), "the bus", None)
    assert [each.where for each in made.findings] == ["j1 (node 1)", "j4 (node 4)"]
    assert "--by-hand" in made.findings[0].remedy


def test_a_joint_that_nobody_turned_and_a_drive_that_is_missing(made, tmp_path):
    arm = real_arm(made, tmp_path, nodes=[1, 2, 3, 4], position_gain=[1.0] * 4)
    drives = FoundNodes(SearchedBus(LockStepBus(arm=arm)))
    with pytest.raises(BusFault, match="no drive read the motion of j1"):
        made.wire(drives, "the bus", lambda text: None)
    drives.found.pop()
    with pytest.raises(BusFault, match=r"3 drives answer \(node 1, node 2, node 3\), the arm has 4 joints"):
        made.wire(drives, "the bus", None)


def test_the_command_writes_a_file_that_plan_and_check_take(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(MODELS / "arm4.urdf", tmp_path)
    assert cli.run(["new", "arm4.urdf", "--stops", "j4:-2.5:2.5", "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["next"] == "armlink demo --arm arm4.yaml"
    assert cli.run(["sweep", "arm4.yaml", "--plan", "--out", "plan", "--json", "-"]) == 0
    assert cli.run(["check", "arm4.yaml"]) == 0
    capsys.readouterr()
    assert cli.run(["new", "arm4.urdf"]) == 2
    assert "--force" in capsys.readouterr().err


def test_with_a_bus_the_file_passes_the_check_on_that_bus(made, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    real_arm(made, tmp_path, nodes=[7, 8, 9, 10], position_gain=[1.0] * 4)
    made.write()
    marks = comments("arm4.yaml")
    assert cli.run(["new", "arm4.urdf", "--out", "found.yaml", "--bus", "armlink_sim:real.yaml"]) == 0
    assert cli.run(["check", "found.yaml"]) == 0
    assert cli.run(["new", "arm4.yaml", "--out", "rewired.yaml", "--bus", "armlink_sim:real.yaml"]) == 0
    assert cli.run(["check", "rewired.yaml", "--passive"]) == 0
    joints = load_arm("rewired.yaml").require_link().joints
    assert [joint.node for joint in joints] == [7, 8, 9, 10]
    assert all(
        joint.identity == found.identity
        for joint, found in zip(joints, load_arm("found.yaml").link.joints, strict=True)
    )
    assert len(marks) > 10
    told_by_the_drives = ("rated_torque assumed", "assumed: there is no bus yet")
    title, *rewired = [each for each in comments("rewired.yaml") if not each.startswith("node ")]
    assert title.startswith("arm4 with the drives on ")
    assert rewired == [each for each in marks if not each.startswith(told_by_the_drives)]
    assert cli.run(["new", "arm4.urdf", "--out", "x.yaml", "--bus", "armlink_sim:real.yaml", "--by-hand"]) == 2
    assert "--by-hand needs a terminal" in capsys.readouterr().err


def test_drives_that_are_known_by_ids_must_all_answer_and_are_not_found_by_hand(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(bundled_arms()["six-damiao"].read_text())
    (tmp_path / "there.yaml").write_text(yaml.safe_dump(content))
    content["link"]["joints"][2]["drive"]["id"] = 0x2A
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(content))
    line = ["new", "other.yaml", "--out", "mine.yaml", "--bus", "armlink_sim:there.yaml"]
    assert cli.run(line) == 3
    assert "id 2Ah" in capsys.readouterr().err
    assert cli.run([*line, "--by-hand"]) == 2
    assert "--by-hand" in capsys.readouterr().err
    assert not (tmp_path / "mine.yaml").exists()
    assert cli.run(["new", "six-damiao", "--out", "mine.yaml", "--bus", "armlink_sim:there.yaml"]) == 0
    assert load_arm("mine.yaml").serial != content["serial"]
    text = bundled_arms()["six-damiao"].read_text()
    assert comments("mine.yaml")[1:] == comments(bundled_arms()["six-damiao"])
    assert yaml.safe_load(Path("mine.yaml").read_text())["sim"] == yaml.safe_load(text)["sim"]
    edited = Path("mine.yaml").read_text().replace("rate: 250", "rate: 200  # assumed")
    Path("mine.yaml").write_text(edited)
    assert cli.run(["new", "mine.yaml", "--force", "--bus", "armlink_sim:there.yaml"]) == 0
    assert Path("mine.yaml").read_text() == edited


def test_an_arm_file_without_a_bus_has_nothing_to_find(tmp_path):
    with pytest.raises(BadInput, match="expected a URDF or MJCF model"):
        new_arm(tmp_path / "arm.yaml", tmp_path / "out.yaml")
    assert cli.run(["new", "sarcos.yaml"]) == 2


def test_stock_drives_are_written_as_what_they_are_and_pass_the_check(tmp_path, monkeypatch, capsys):
    """Without a torque sensor record (2100h) a bare node id would be wrong."""
    monkeypatch.chdir(tmp_path)
    for model in (["six-cia402"], []):
        out = f"{len(model)}.yaml"
        assert cli.run(["new", *model, "--out", out, "--bus", "armlink_sim:six-cia402"]) == 0
        joints = load_arm(out).require_link().joints
        assert [joint.settings.node for joint in joints] == [1, 2, 3, 4, 5, 6]
        assert {joint.settings.calibration for joint in joints} == {"host"}
        assert all(joint.identity is not None for joint in joints)
        assert cli.run(["check", out, "--passive"]) == 0
    assert {joint.settings.torque for joint in joints} == {"motor"}
