"""The key `drive` of a joint: each family validates its own keys."""

import json

import pytest
import yaml
from pydantic import ValidationError

from armlink.arm_file import bundled_arms, load_arm
from armlink.cli import run
from armlink.drives.damiao.drives import DamiaoSettings
from armlink.errors import BadInput


def written(folder, change):
    content = yaml.safe_load(bundled_arms()["sarcos"].read_text(encoding="utf-8"))
    change(content["link"]["joints"])
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def drive(**keys):
    def change(joints):
        del joints[0]["node"]
        joints[0]["drive"] = keys

    return change


def test_node_is_short_for_a_drive_with_our_own_record(tmp_path):
    short = load_arm("sarcos").link.joints[0].settings
    long = load_arm(written(tmp_path, drive(family="canopen", node=short.node))).link.joints[0].settings
    assert short == long
    assert (short.torque, short.calibration) == ("record", None)


def test_a_torque_sensor_at_an_input_of_the_device(tmp_path):
    sensor = {"object": "0x3160.1", "type": "int16", "scale": 0.01, "unit": "N·m"}
    keys = load_arm(written(tmp_path, drive(family="canopen", node=1, torque=sensor, calibration="host")))
    torque = keys.link.joints[0].settings.torque
    assert (torque.index, torque.sub, torque.scale) == (0x3160, 1, 0.01)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (drive(family="canopen", node=1, colour="red"), "key link.joints.0.drive.colour: unknown key"),
        (drive(family="canopen", node=200), "key link.joints.0.drive.node: Input should be less than or equal to 127"),
        (
            drive(family="stepper", node=1),
            "key link.joints.0.drive: drive family 'stepper' is unknown; expected one of canopen",
        ),
        (drive(node=1), "key link.joints.0.drive: expected a mapping with the key `family`"),
        (drive(family="canopen", node=1, torque="motor", calibration="controller"), "`calibration: controller` needs"),
        (lambda joints: joints[0].update(drive={"family": "canopen", "node": 1}), "give `node` or `drive"),
        (lambda joints: joints[0].pop("node"), "give `node` or `drive"),
        (drive(family="canopen", node=2), "'node 2' is given twice"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, change, says):
    with pytest.raises(BadInput) as caught:
        load_arm(written(tmp_path, change))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_families_are_listed_with_their_traits(capsys):
    assert run(["drives", "--json", "-"]) == 0
    found = {each["family"]: each["traits"] for each in json.loads(capsys.readouterr().out)}
    assert found["canopen"]["silence"] == "holds"
    assert all(
        set(traits) == {"torque", "calibration", "silence", "bounds", "cadence", "frame"} for traits in found.values()
    )


@pytest.mark.parametrize(
    ("label", "model"),
    [
        ("DM-J8009P-2EC", "DM8009"),
        ("dm-j4340p-2ec v1.1", "DM4340P"),
        ("DM4310", "DM4310"),
        ("DM-J10010L-2EC", "DM10010L"),
        ("DM-H6215", "DMH6215"),
        ("DM-J6248P-2EC", "DM6248P"),
    ],
)
def test_a_label_is_known_however_it_is_printed(label, model):
    assert DamiaoSettings(id=1, reply=0x11, model=label, kp=10, kd=1).model == model


def test_an_unknown_label_is_refused_with_those_there_are():
    with pytest.raises(ValidationError, match=r"Damiao model 'DM-J9999P-2EC' is unknown; expected DM3507, DM4310"):
        DamiaoSettings(id=1, reply=0x11, model="DM-J9999P-2EC", kp=10, kd=1)
    assert DamiaoSettings(id=1, reply=0x11, kp=10, kd=1).model == ""
