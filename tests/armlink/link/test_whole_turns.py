"""Drives that woke whole turns off: refused before power and named in every family, or corrected by their arm file."""

import copy
import math
import re

import numpy as np
import pytest
import yaml
from fake_joints import FakeBus
from wiretap import Tap, conversation

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.drives.orders import Power
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.link.types import Command
from armlink.monitor.monitor import Monitor
from armlink.recording.recorder import Recorder
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

TURN = 2 * math.pi
FAMILIES = ("six-damiao", "six-cubemars", "six-moteus", "six-robstride", "six-odrive", "six-myactuator", "six-cia402")
SEED = 5207
SHORT, LONG = 3, 200
"""Draws a family."""


def content_of(name):
    """Keys of a bundled arm."""
    path = bundled_arms()[name]
    return yaml.safe_load(path.read_text(encoding="utf-8")), path


def host_of(name, changes, start=None, turns=None):
    """The arm as the host has it: `changes` joint → what is added to its drive's zero [rad]."""
    content, path = content_of(name)
    content = copy.deepcopy(content)
    for joint, change in changes.items():
        row = content["link"]["joints"][joint]
        if "drive" not in row:
            row["drive"] = {"family": "canopen", "node": row.pop("node")}
        row["drive"]["zero"] = row["drive"].get("zero", 0.0) + change
        if turns:
            row["drive"]["turns"] = turns
    if start is not None:
        content["sim"]["start"] = [float(each) for each in start]
    return parse_arm(content, path)


def bus_of(name, start=None):
    """The simulated arm in lock-step, its drives counting as the bundled file has it."""
    arm = host_of(name, {}, start)
    return LockStepBus(arm=SimulatedArm(arm, Truth.of(arm)))


def power_of(link):
    """Power states of all drives."""
    return {group.drives.power(drive) for group in link.groups for drive in range(len(group.places))}


def drawn(rng, arm):
    """Where the arm stands, the joint that lost turns, and how many turns of the joint."""
    ranges = np.array([(row.lower, row.upper) for row in arm.kinematics.joints])
    start = rng.uniform(ranges[:, 0] + 0.05, ranges[:, 1] - 0.05)
    return start, int(rng.integers(len(ranges))), int(rng.choice([-1, 1]))


def zeros_named(text, joint):
    """Zeros that a refusal names for one joint."""
    (said,) = [part for part in text.split("; ") if part.startswith(f"{joint}: ")] or [""]
    return [float(each) for each in re.findall(r"zero: (-?\d+\.\d{4})", said)]


@pytest.mark.sample(3)
@pytest.mark.parametrize("draws", [SHORT, pytest.param(LONG, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", FAMILIES)
def test_none_is_driven_and_each_is_named(name, draws):
    rng, arm = np.random.default_rng(SEED), load_arm(name)
    for _ in range(draws):
        start, joint, turns = drawn(rng, arm)
        settings = arm.link.joints[joint].settings
        right = settings.zero
        change = turns * TURN * settings.gear
        host = host_of(name, {joint: change}, start)
        with Link(host, bus_of(name, start)) as link:
            with pytest.raises(Refused) as refused:
                link.start()
            assert Power.ON not in power_of(link)
            assert not link.enabled
        text = str(refused.value)
        assert [row.name for row in host.link.joints if f"{row.name}: reads" in text] == [host.link.joints[joint].name]
        named = zeros_named(text, host.link.joints[joint].name)
        assert any(abs(each - right) < 1e-4 for each in named), (text, right)


@pytest.mark.parametrize("draws", [SHORT, pytest.param(LONG, marks=pytest.mark.long)])
def test_a_turn_of_a_drive_before_a_gear_is_named_wherever_it_can_be_seen(draws):
    """Twelve drive turns a joint turn: several explain a reading, so that none is chosen, and the right one is said."""
    rng, arm, seen = np.random.default_rng(SEED), load_arm("six-odrive"), 0
    for _ in range(draws):
        start, joint, _ = drawn(rng, arm)
        row, settings = arm.kinematics.joints[joint], arm.link.joints[joint].settings
        turns = int(rng.choice([-1, 1])) * int(rng.integers(1, settings.gear + 1))
        host = host_of("six-odrive", {joint: turns * TURN}, start, turns="auto")
        reading = start[joint] - settings.direction * turns * TURN / settings.gear
        margin = 0.02 * max(-row.lower, row.upper) + 0.15
        with Link(host, bus_of("six-odrive", start)) as link:
            if row.lower - margin < reading < row.upper + margin:
                link.start()
                continue
            seen += 1
            with pytest.raises(Refused, match=rf"{row.name}: reads .*") as refused:
                link.start()
        text = str(refused.value)
        named = zeros_named(text, row.name)
        steps = (settings.zero - min(named)) / TURN
        assert min(named) - 1e-3 < settings.zero < max(named) + 1e-3
        assert abs(steps - round(steps)) < 1e-4
        assert len(named) == 1 or "`turns: auto` cannot choose" in text
    assert seen > draws / 4


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", FAMILIES)
def test_turns_auto_corrects_zero_limits_and_readings(name):
    """The joint is held where it truly stands, and a second start finds nothing to correct."""
    rng, arm = np.random.default_rng(SEED), load_arm(name)
    for _ in range(2):
        _, joint, turns = drawn(rng, arm)
        settings, bus = arm.link.joints[joint].settings, bus_of(name)
        with Link(host_of(name, {joint: turns * TURN * settings.gear}, turns="auto"), bus) as link:
            if settings.gear != 1:
                with pytest.raises(Refused, match="`turns: auto` cannot choose"):
                    link.start()
                continue
            link.start()
            assert link.values.zero_of(joint) == pytest.approx(settings.zero, abs=1e-9)
            assert "(`turns: auto`)" in link.turns.note(joint)
            standing = link.enable().position
            for _ in range(50):
                sample = link.cycle(Command.hold(standing))
            assert np.abs(sample.position - bus.arm.plant.position).max() < 0.01
            assert np.abs(link.position_sent - standing).max() < 0.01
            limits = link.values.limits(joint, link.limits[joint])
            assert limits.lower < settings.zero + settings.direction * standing[joint] < limits.upper


@pytest.mark.sample(2)
@pytest.mark.parametrize("end", ["lower", "upper"])
@pytest.mark.parametrize("name", FAMILIES)
def test_a_joint_that_leans_on_its_stop_by_a_sensor_that_reads_too_much_is_not_refused(name, end):
    content, path = content_of(name)
    start = [row[end] for row in content["kinematics"]["joints"]]
    content["sim"] |= {"start": start, "sensors": {"position_gain": [1 / 1.02] * 6}}
    content["sim"]["sensors"]["position_offset"] = [-0.05 if end == "upper" else 0.05] * 6
    arm = parse_arm(content, path)
    with Link(arm, LockStepBus(arm=SimulatedArm(arm, Truth.of(arm)))) as link:
        link.start()
        link.enable()
        link.disable()


def test_a_reading_that_no_turn_explains_is_refused_in_other_words():
    start = [0.0, -1.4, 0.0, 0.0, 0.0, 0.0]
    link = Link(host_of("six-damiao", {1: 2.0}, start), bus_of("six-damiao", start))
    with (
        link,
        pytest.raises(
            Refused,
            match=r"shoulder: reads .* No number of whole turns of its drive explains this reading, so zero, dir",
        ),
    ):
        link.start()


def test_every_joint_that_lost_a_turn_is_named():
    link = Link(host_of("six-moteus", {0: TURN, 2: -TURN}), bus_of("six-moteus"))
    with link, pytest.raises(Refused) as refused:
        link.start()
    text = str(refused.value)
    assert (zeros_named(text, "base"), zeros_named(text, "elbow")) == ([0.0], [0.4])


@pytest.mark.parametrize("name", ["six-damiao", "six-cubemars", "six-moteus", "six-robstride", "six-myactuator"])
def test_a_drive_that_wakes_anew_between_start_and_enable_gets_no_power(name):
    bus = bus_of(name)
    with Link(host_of(name, {}), bus) as link:
        link.start()
        bus.arm.drive_at[2].motor._zero += TURN
        bus.clock.sleep_until(bus.clock.now() + 1.0)
        with pytest.raises(Refused, match=r"elbow: reads .* write `zero: 6\.6832`"):
            link.enable()
        assert Power.ON not in power_of(link)


def test_a_joint_that_tells_no_position_for_long_gets_no_power():
    bus = bus_of("six-damiao")
    with Link(host_of("six-damiao", {}), bus) as link:
        link.start()
        bus.arm.drive_at[2].faults["feedback.lost"] = 0.0
        bus.clock.sleep_until(bus.clock.now() + 1.0)
        with pytest.raises(BusFault, match="elbow: no position was received"):
            link.enable()


def test_who_only_listens_is_told_and_goes_on(arm_of, caplog):
    joint = {"node": None, "drive": {"family": "canopen", "node": 2, "zero": TURN}}
    for turns, offset in (("refuse", -TURN), ("auto", 0.0)):
        arm = arm_of(2)
        rows = list(arm.link.joints)
        keys = rows[1].model_dump() | joint | {"drive": joint["drive"] | {"turns": turns}}
        rows[1] = type(rows[1]).model_validate(keys)
        arm = arm.model_copy(update={"link": arm.link.model_copy(update={"joints": tuple(rows)})})
        heard = [row["position"] for _, row in Recorder(arm, Tap(conversation(9))).rows(1.0)]
        commanded = [row["position_command"] for _, row in Recorder(arm, Tap(conversation(9))).rows(1.0)]
        assert np.allclose(np.array(heard)[:, 1], offset, atol=0.2)
        assert np.allclose(np.array(commanded)[:, 1], offset, atol=0.2)
        listener = Listener(arm, Tap(conversation(9)))
        assert abs(listener.next(1.0).position[1] - offset) < 0.2
        caplog.clear()
        monitor = Monitor(arm, Tap(conversation(9)))
        told = monitor.describe(monitor.watch(1.0))["joints"]
        assert abs(told[1]["position"] - offset) < 0.2
        assert told[0]["misplaced"] is None
        assert (told[1]["misplaced"] is not None) == (turns == "refuse")
        if turns == "refuse":
            assert "write `zero: 0.0000`" in told[1]["misplaced"]
            assert not caplog.records
        else:
            assert "zero 0.0000 is used instead of 6.28319" in caplog.text


def test_limits_of_a_guard_are_those_of_the_corrected_zero(arm_of):
    """A guard of the bus passes the frames of a host that corrects the turn."""
    arm = arm_of(1)
    row = arm.link.joints[0]
    keys = row.model_dump() | {"node": None, "drive": {"family": "canopen", "node": 1}}
    rules = []
    for extra in ({}, {"zero": -TURN, "turns": "auto"}):
        changed = type(row).model_validate(keys | {"drive": keys["drive"] | extra})
        described = arm.model_copy(update={"link": arm.link.model_copy(update={"joints": (changed,)})})
        with Link(described, FakeBus([1])) as link:
            rules.append(link.guard_rules())
    assert rules[0] == rules[1]
