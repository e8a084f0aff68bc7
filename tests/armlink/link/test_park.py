"""Parking: the arm is stowed in its pose before drives that let go lose their power, and only where that is so."""

import logging

import numpy as np
import pytest
import yaml

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.errors import BadInput, Refused
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

FALLING = ("six-damiao", "six-cubemars", "six-robstride", "six-moteus", "six-odrive", "six-myactuator", "six-piper")


def without_park(name):
    path = bundled_arms()[name]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["link"].pop("park", None)
    return parse_arm(content, path)


def simulated(arm):
    return SimulatedArm(arm, Truth.of(arm), 1)


def away(arm, link, by):
    """Move the arm off its pose."""
    goal = np.array(arm.link.park.pose) + by
    for target in straight_path(link.position_sent, goal, np.full(6, 1.0), link.period):
        link.cycle(Command.hold(target))
    for _ in range(50):
        link.cycle(Command.hold(goal))


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", FALLING)
def test_parking_stows_the_arm_and_takes_the_power(name):
    arm = load_arm(name)
    sim = simulated(arm)
    with Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        link.enable()
        away(arm, link, [0.3, 0.2, -0.2, 0.3, 0.2, -0.2])
        fastest = 0.0
        link.park()
        assert not link.enabled
        fastest = float(np.abs(sim.plant.velocity).max())
    assert not any(drive.motor.powered for drive in sim.drive_at.values())
    assert np.abs(sim.plant.position - arm.link.park.pose).max() < 0.05
    assert fastest < 0.05
    sim.advance(2.0)
    assert np.abs(sim.plant.position - arm.link.park.pose).max() < 0.15  # it hangs there at rest


def test_a_joint_that_is_blocked_on_the_way_holds(caplog, monkeypatch):
    monkeypatch.setattr("armlink.link.park.LONGEST_LOWERING", 3.0)  # it goes down for as long as it may
    arm = load_arm("six-damiao")
    sim = simulated(arm)
    with caplog.at_level(logging.INFO, "armlink"), Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        link.enable()
        away(arm, link, [0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
        at = float(sim.plant.position[1])
        sim.plant.model.jnt_range[1] = (at - 0.02, at + 0.02)  # something is in the way
        sim.plant.model.jnt_limited[1] = 1
        with pytest.raises(Refused, match=r"park: shoulder is at .* stopped following its target .* all joints hold"):
            link.park()
        assert link.enabled
    assert "so it is being lowered" in caplog.text


def test_without_a_pose_the_arm_is_let_down_and_it_says_so(caplog, monkeypatch):
    monkeypatch.setattr("armlink.link.park.LONGEST_LOWERING", 3.0)
    arm = without_park("six-robstride")
    with caplog.at_level(logging.INFO, "armlink"), Link(arm, LockStepBus(arm=simulated(arm))) as link:
        link.start()
        link.enable()
        with pytest.raises(BadInput, match=r"key `link\.park` is missing"):
            link.park()
    assert (
        "the arm could not be parked, so it is being lowered, which takes at most 3 s: the arm file has no link.park"
    ) in caplog.text


def test_drives_that_hold_are_left_holding():
    arm = load_arm("six-cia402")
    sim = simulated(arm)
    with Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        link.enable()
    assert [node.value(0x6041) & 0x6F for node in sim.nodes] == [0x07] * 6


def test_the_pose_must_fit_the_joints():
    path = bundled_arms()["six-damiao"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["link"]["park"] = {"pose": [0.0, 0.0]}
    with pytest.raises(BadInput, match=r"park\.pose has 2 positions, expected 6"):
        parse_arm(content, path)
    content["link"]["park"] = {"pose": [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]}
    with pytest.raises(
        BadInput, match=r"link\.park\.pose: shoulder is at 1 rad, which is outside the range -2\.9 to 0\.2"
    ):
        parse_arm(content, path)


def test_a_drive_that_keeps_on_is_not_driven():
    path = bundled_arms()["six-cia402"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["sim"]["device"] = "sample"
    arm = parse_arm(content, path)
    sim = simulated(arm)
    with Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        with pytest.raises(Refused, match="base: if this host dies, the drive continues"):
            link.enable()
    assert all(node.value(0x6041) & 0x6F != 0x27 for node in sim.nodes)
