"""Stock CiA 402 devices by their data sheets, through `armlink check` and `armlink scan`; units, modes, torque."""

import json
import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from armlink.arm_file import load_arm
from armlink.cli import run
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen.profile import profile_of
from armlink.drives.canopen.units import read_units, unit_doubt
from armlink.drives.orders import Mode
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

TURN = 2 * math.pi
COUNT = TURN / 2**20
SENSOR = {"object": "0x3160.1", "type": "int16", "scale": 0.002, "unit": "N·m"}


@pytest.fixture
def written(tmp_path):
    """Path of the arm file of a pendulum whose joint has a device, with keys of its drive."""

    def write(device, **drive):
        path = tmp_path / f"{device}.yaml"
        keys = {"family": "canopen", "node": 5, "torque": SENSOR, "calibration": "host"} | drive
        joint = {"name": "hinge", "drive": keys, "rated_torque": 10.0, "max_torque": 20.0}
        content = {
            "name": "pendulum",
            "kinematics": {"gravity": [9.81, 0.0, 0.0], "joints": [{"name": "hinge", "lower": -2.0, "upper": 2.0}]},
            "link": {"bus": {"interface": "armlink_sim", "channel": str(path)}, "joints": [joint]},
            "sim": {
                "device": device,
                "links": [{"mass": 1.0, "com": [0.2, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]}],
                "sensors": {"noise": [0.0], "bits": 20},
                "start": [0.4],
            },
        }
        path.write_text(yaml.safe_dump(content))
        return str(path)

    return write


def told(capsys, *command):
    """(Exit status, JSON) of a command."""
    status = run([*command, "--json", "-"])
    return status, json.loads(capsys.readouterr().out)


# ---- the data sheets


@pytest.mark.parametrize(
    ("device", "drive", "lost"),
    [
        ("epos4", {"position_unit": COUNT}, {"1400h:05", "6072h:00", "6087h:00"}),
        ("nanotec", {}, {"1400h:05", "6076h:00", "60B2h:00"}),
        ("copley", {}, {"1400h:05", "60B2h:00"}),
        ("profile", {}, {"1400h:05", "60B2h:00"}),
    ],
)
def test_a_stock_device_passes_the_check_and_what_it_lacks_is_told(written, capsys, device, drive, lost):
    path = written(device, **drive)
    status, checked = told(capsys, "check", path)
    assert status == 0
    assert [each for each in checked["checks"] if each["outcome"] in ("failed", "not run")] == []
    absent = {each["found"] for each in checked["checks"] if each["check"].startswith("objects: ")}
    assert {text.partition(" ")[0] for text in absent} == lost
    assert all(": " in text for text in absent)  # each with what is lost by it
    assert run(["scan", path, "--json", "-"]) == 0
    scanned = capsys.readouterr()
    (node,) = json.loads(scanned.out)["nodes"]
    assert set(node["lost"]) == absent
    assert node["name"] == ("EPOS4" if device == "epos4" else "armlink joint")
    assert "hinge lacks 1400h:05 RPDO1 event timer: the device does not watch the commands of its host" in scanned.err


def test_the_sample_of_cia_passes_without_power_and_is_not_driven(written, capsys):
    """It watches neither commands nor heartbeat: after its host died it would keep on."""
    path = written("sample")
    status, checked = told(capsys, "check", path, "--passive")
    assert status == 0
    assert "failed" not in {each["outcome"] for each in checked["checks"]}
    absent = {each["found"].partition(" ")[0] for each in checked["checks"] if each["outcome"] == "absent"}
    assert {"1016h:01", "1400h:05", "60B2h:00", "6060h"} <= absent
    status, checked = told(capsys, "check", path)
    assert status == 1
    assert [each["check"] for each in checked["checks"] if each["outcome"] == "failed"] == ["heartbeat of the host"]
    assert (
        "the device watches neither the commands (1400h:05) nor the heartbeat (1016h) of its host: do "
        "not drive this joint"
    ) in str(checked)


def test_a_device_with_cyclic_velocity_alone_passes_the_check(written, capsys):
    status, checked = told(capsys, "check", written("velocity"))
    assert status == 0
    assert "failed" not in {each["outcome"] for each in checked["checks"]}


# ---- torque from an object of the device


def test_torque_is_read_from_the_object_that_the_arm_file_names(written):
    """The input shows the sensor in counts of the arm file's scale and offset."""
    arm = load_arm(written("cia402", torque={**SENSOR, "offset": 7.0}))
    simulated = SimulatedArm(arm, Truth.of(arm))
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        hold = Command.hold(link.enable().position)
        for _ in range(200):
            sample = link.cycle(hold)
    assert sample.torque[0] == pytest.approx(9.81 * 0.2 * math.sin(0.4), abs=0.02)


@pytest.mark.parametrize(
    ("kind", "data", "value"),
    [
        ("int8", "fe", -2),
        ("uint8", "fe", 254),
        ("int16", "feff", -2),
        ("uint32", "00000001", 1 << 24),
        ("real32", "0000c0bf", -1.5),
    ],
)
def test_the_object_may_have_any_type(written, kind, data, value):
    settings = load_arm(written("cia402", torque={**SENSOR, "object": "3160.2", "type": kind})).link.joints[0].settings
    profile = profile_of(settings)
    assert (profile.reading.index, profile.reading.sub, profile.torque_scale) == (0x3160, 2, 0.002)
    assert struct.unpack("<" + profile.reading.code, bytes.fromhex(data)) == (value,)
    assert profile.reading in next(each.entries for each in profile.pdos if each.name == pdo.TPDO1.name)


# ---- units


def services(**values):
    """A device that has these objects alone; sub-indices by an underscore."""
    found = {}
    for name, value in values.items():
        index, _, sub = name.removeprefix("x").partition("_")
        found[int(index, 16), int(sub or "0")] = value
    return SimpleNamespace(
        has=lambda entry: (entry.index, entry.sub) in found, read=lambda entry: found[entry.index, entry.sub]
    )


RPM, TENTHS_OF_DEGREES, MILLIRADIANS, DEGREES_A_SECOND = 0x00B44700, 0xFF410000, 0xFD100000, 0x00410300


@pytest.mark.parametrize(
    ("device", "drive", "position", "velocity"),
    [
        ({"x6092_1": 3600, "x6092_2": 1}, {}, TURN / 3600, TURN / 3600),
        ({"x6092_1": 7200, "x6092_2": 2, "x608F_1": 4096, "x608F_2": 1}, {}, TURN / 3600, TURN / 3600),
        ({"x608F_1": 4096, "x608F_2": 1, "x6091_1": 100, "x6091_2": 1}, {}, TURN / 409600, TURN / 409600),
        ({"x608F_1": 4096, "x608F_2": 1}, {}, TURN / 4096, TURN / 4096),
        ({"x60A8": TENTHS_OF_DEGREES}, {}, math.radians(0.1), math.radians(0.1)),
        ({"x60A8": MILLIRADIANS, "x60A9": DEGREES_A_SECOND}, {}, 1e-3, math.radians(1.0)),
        ({"x60A9": RPM, "x6092_1": 3600}, {}, TURN / 3600, TURN / 60),
        ({"x60A9": RPM, "x6091_1": 50, "x6091_2": 1, "x6092_1": 3600}, {}, TURN / 3600, TURN / 60 / 50),
        ({"x60A8": MILLIRADIANS, "x60A9": RPM}, {"position_unit": 0.5, "velocity_unit": 0.25}, 0.5, 0.25),
    ],
)
def test_units_are_those_that_the_device_or_the_arm_file_tells(written, device, drive, position, velocity):
    joint = load_arm(written("cia402", **drive)).link.joints[0]
    found = read_units(services(**device, x6076=10_000), joint)
    assert (found.position, found.velocity) == pytest.approx((position, velocity))
    assert found.torque == pytest.approx(10.0 / 1000)


@pytest.mark.parametrize(("file", "said"), [(TURN / 4096 / 3, "0.333 times"), (TURN / 4096, ""), (None, "")])
def test_a_position_unit_that_contradicts_the_device_is_said(written, file, said):
    joint = load_arm(written("cia402", **({} if file is None else {"position_unit": file}))).link.joints[0]
    doubt = unit_doubt(services(x608F_1=4096, x608F_2=1, x6076=10_000), joint)
    assert (said in doubt and "3 times as fast and as far" in doubt) if said else doubt == ""


def test_a_rated_torque_in_micro_newton_metres_is_known_as_such(written):
    joint = load_arm(written("cia402")).link.joints[0]
    assert read_units(services(x6092_1=3600, x6076=10_000_000), joint).torque == pytest.approx(0.01)


# ---- modes


def test_profile_modes_stand_in_where_nothing_else_is_there(written):
    """Positions in mode 1, torque in mode 4, although 6502h does not show the latter."""
    arm = load_arm(written("profile"))
    simulated = SimulatedArm(arm, Truth.of(arm))
    assert not simulated.nodes[0].value(objects.SUPPORTED_MODES.index) >> 3 & 1
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        assert link.setups[0].modes == {0, 1, 4, Mode.POSITION, Mode.TORQUE}
        start = link.enable().position
        displays = link.groups[0].drives.known.displays
        for target in straight_path(start, start + 0.3, np.array([0.5]), link.period):
            sample = link.cycle(Command.hold(target))
        for _ in range(250):
            sample = link.cycle(Command.hold(start + 0.3))
        assert displays == [1]
        assert sample.position == pytest.approx(start + 0.3, abs=2e-3)
        weight = 9.81 * 0.2 * np.sin(sample.position)
        for _ in range(50):
            link.cycle(Command(np.array([Mode.TORQUE], np.int8), weight, sample.position))
        assert displays == [4]
        assert simulated.plant.motor_torque == pytest.approx(weight, abs=0.02)
        link.stop()


def test_a_mode_that_the_device_displays_is_used_although_6502h_does_not_show_it(written):
    arm = load_arm(written("epos4", position_unit=COUNT))
    simulated = SimulatedArm(arm, Truth.of(arm))
    assert not simulated.nodes[0].value(objects.SUPPORTED_MODES.index) >> 7 & 1
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        assert {Mode.POSITION, Mode.TORQUE} <= link.setups[0].modes
        assert link.groups[0].drives.known.displays == [Mode.POSITION]


def test_a_mode_that_6502h_shows_and_the_device_does_not_enter_is_not_used(written):
    arm = load_arm(written("cia402"))
    simulated = SimulatedArm(arm, Truth.of(arm))
    simulated.drives.refused_modes[0].add(int(Mode.TORQUE))
    assert simulated.nodes[0].value(objects.SUPPORTED_MODES.index) >> 9 & 1
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        assert link.groups[0].drives.wires[0].profile.torque_mode == Mode.PROFILE_TORQUE
        link.enable()
