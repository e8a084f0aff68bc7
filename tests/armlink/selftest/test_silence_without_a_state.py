"""Drives that tell no state: what the self-test finds out of their silence, and when they are not driven."""

import json
from pathlib import Path

import pytest
import yaml

from armlink.arm_file import parse_arm
from armlink.cli import run
from armlink.errors import Refused
from armlink.link.link import Link
from armlink.selftest.self_test import SelfTest
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

FAMILIES = {
    "cubemars": {"family": "cubemars", "model": "AK80-9", "kp": 30, "kd": 1.0, "can_timeout": 4000},
    "myactuator": {"family": "myactuator", "model": "X8-25", "timeout_ms": 100},
}
TIMEOUTS = {"cubemars": "can_timeout", "myactuator": "timeout_ms"}
TYPES = {"cubemars": "CubeMars AK80-9", "myactuator": "MyActuator X825"}
each_family = pytest.mark.parametrize("family", FAMILIES)


def content(family, upright=False, **keys):
    """Two joints that hang, or, where the first axis is upright, one that gravity never loads."""
    drive = FAMILIES[family] | keys
    row = {"rated_torque": 9.0, "max_torque": 15.0, "max_torque_rate": 100.0}
    names = ("hinge_1", "hinge_2")
    tilt = {"alpha": 1.5707963} if upright else {}
    return {
        "name": "pair",
        "kinematics": {
            "gravity": [0.0, 0.0, 9.81] if upright else [9.81, 0.0, 0.0],
            "joints": [
                {"name": name, "a": 0.25, **tilt, "lower": -2.0, "upper": 2.0 + 0.1 * place}
                for place, name in enumerate(names)
            ],
        },
        "link": {
            "bus": {"interface": "armlink_sim", "channel": "pair.yaml"},
            "joints": [
                {"name": name, "drive": {**drive, "id": place}, **row} for place, name in enumerate(names, start=1)
            ],
        },
        "sim": {
            "links": [{"mass": 1.0, "com": [0.2, 0.0, 0.0], "inertia": [0.004] * 3}] * 2,
            "sensors": {"noise": [0.01, 0.01], "bits": 17},
            "start": [0.0, 1.5] if upright else [0.0, 0.0],
        },
    }


def checked(described, fault=None):
    arm = parse_arm(described, Path("pair.yaml"))
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    if fault:
        simulated.device(0).inject(fault, 0.0)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        results = {(each.joint, each.check): each for each in SelfTest(link).run(True)}
    return results, simulated


@each_family
def test_a_drive_with_a_timeout_lets_go_of_a_joint_that_hung_at_rest(family):
    """Where it hangs it carries nothing: it is led to where gravity pulls at it, and falls from there."""
    results, simulated = checked(content(family))
    for name in ("hinge_1", "hinge_2"):
        silent = results[name, "silence"]
        assert silent.outcome == "passed", silent.found
        assert silent.found.startswith("falls within")
    drives = [simulated.device(joint) for joint in (0, 1)]
    assert not any(drive.motor.powered and (family != "cubemars" or drive.command.kp) for drive in drives)


@each_family
def test_a_timeout_that_is_stated_and_not_set_is_found(family):
    results, _ = checked(content(family), "watchdog.off")
    assert results["hinge_1", "silence"].outcome == "failed"
    assert "keeps on within" in results["hinge_1", "silence"].found
    assert "do not drive it" in results["hinge_1", "silence"].found
    assert results["hinge_2", "silence"].outcome == "passed"


@each_family
def test_a_joint_that_carries_no_load_shows_nothing_and_that_is_said(family):
    results, _ = checked(content(family, upright=True))
    assert results["hinge_1", "silence"].outcome == "not run"
    assert "reports no state, and the joint carries no load in this pose" in results["hinge_1", "silence"].found
    assert results["hinge_2", "silence"].outcome == "passed"


@each_family
def test_without_a_timeout_it_is_scanned_and_checked_and_not_driven(family, tmp_path, monkeypatch, capsys):
    described = content(family, **{TIMEOUTS[family]: 0})
    arm = parse_arm(described, Path("pair.yaml"))
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        with pytest.raises(Refused, match="hinge_1: if this host dies, the drive continues"):
            link.enable()
    assert not any(device.motor.powered for device in (simulated.device(0), simulated.device(1)))
    monkeypatch.chdir(tmp_path)
    Path("pair.yaml").write_text(yaml.safe_dump(described))
    assert run(["scan", "pair.yaml"]) == 0
    assert capsys.readouterr().out.count(TYPES[family]) == 2
    assert run(["check", "pair.yaml", "--json", "-"]) == 1
    checks = {(each["joint"], each["check"]): each for each in json.loads(capsys.readouterr().out)["checks"]}
    assert checks["hinge_1", "answers"]["outcome"] == "passed"
    assert checks["hinge_1", "silence"]["outcome"] == "failed"
    assert f"`{TIMEOUTS[family]}` is not given in the `drive:` section" in checks["hinge_1", "set-up"]["found"]
    assert (
        "if its host died, its drive would keep on with the last command"
        in checks["hinge_1", "enables and holds"]["found"]
    )
