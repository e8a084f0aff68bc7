"""Every end of the work on an arm that its drives would let fall: parked, and no joint thrown about on the way."""

import errno
import logging
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from ends_bench import EXTRA_SPEED, FALLING, EndsBench, after_each_step

from armlink.arm_file import ArmFile, bundled_arms, load_arm, parse_arm
from armlink.drives.orders import Mode, Power
from armlink.errors import BadInput, BusFault, HostLate, Refused, Silence, Stall
from armlink.link.ends import ENDS, EndCause, cause_of
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.reading_bounds import Crossed
from armlink.link.types import Command
from armlink.termination import Presses, end_logger
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

sys.path.insert(0, str(Path(__file__).parents[2] / "sim_bus" / "drives"))
sys.path.insert(0, str(Path(__file__).parents[2] / "sim_bus"))

import serving

ERRORS = {
    "done": None,
    "interrupted": KeyboardInterrupt(),
    "exception": ZeroDivisionError(),
    "exit": SystemExit(1),
    "disk full": OSError(errno.ENOSPC, "No space left on device"),
    "bad input": BadInput("a file"),
    "refused": Refused("a check"),
    "crossed": Crossed("elbow", 2, "lag", 0.0, 0.5),
    "bus fault": BusFault("a drive"),
    "stall": Stall("the job was silent"),
    "host late": HostLate(0.2, 0.1),
    "silence": Silence("elbow: no reading"),
}
CATCH_SPEED = 2.5
"""Where the cycle itself stood still the drives have let go for 0.1 to 0.2 s before they can be caught [rad/s]."""
RATE = 100.0
"""Of the link [Hz]; the campaign `ends` has the arms' own 250 Hz."""
every_family = pytest.mark.parametrize("name", FALLING)


def slow(name: str) -> ArmFile:
    """A bundled arm at a rate that takes less time to simulate, where the end waits for no cycle."""
    arm = load_arm(name)
    return arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": RATE})})


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("name", "end"),
    [
        (FALLING[(first + number) % len(FALLING)], end)
        for first in range(len(FALLING))
        for number, end in enumerate(ERRORS)
    ],
)
def test_whatever_ends_the_job_the_arm_is_parked(name, end):
    bench = EndsBench(slow(name))
    bench.leave(ERRORS[end])
    assert not any(bench.powered)
    assert bench.away() < 0.1
    speed = np.minimum(bench.arm.link.park.speed, [joint.max_velocity for joint in bench.arm.link.joints])
    assert (bench.peak < speed + EXTRA_SPEED).all(), bench.peak


@pytest.mark.sample(1)
@every_family
def test_an_arm_afloat_is_held_although_the_frames_of_one_cycle_are_lost(name):
    """Those that tell drives of their new mode, too: no drive may go on with torque while it is sent positions."""
    bench = EndsBench(slow(name))
    limits = np.array([joint.max_torque for joint in bench.arm.link.joints])
    for _ in range(50):
        here = bench.link.latest_position
        torque = np.clip(bench.sim.gravity_torque(here[None])[0], -limits, limits)
        bench.link.cycle(Command(np.full(6, Mode.TORQUE, np.int8), torque, here))
    loop = bench.link.commander.loop
    encode = loop._encode

    def lost(*of):
        loop._encode = encode
        encode(*of)
        return []

    loop._encode = lost
    bench.peak[:] = 0.0
    bench.leave(None)
    assert not any(bench.powered)
    assert bench.away() < 0.1
    assert (bench.peak < bench.arm.link.park.speed + EXTRA_SPEED).all(), bench.peak


@pytest.mark.sample(1)
@every_family
def test_a_command_that_the_gate_refuses_leaves_the_arm_held(name):
    bench = EndsBench(slow(name))
    with pytest.raises(Refused, match="gate: ") as refused:
        bench.float_torque(5.0)
    assert bench.link.held
    assert any(bench.powered)
    for _ in range(500):
        bench.link.keep()
    assert np.abs(bench.sim.plant.velocity).max() < 0.05, "it holds as long as nobody decides"
    bench.leave(refused.value)
    assert not any(bench.powered)
    assert bench.away() < 0.1
    assert (bench.peak < 1.5 + EXTRA_SPEED).all(), bench.peak


@pytest.mark.sample(1)
@every_family
def test_in_the_cycle_of_a_refusal_the_other_joints_under_torque_control_are_held(name, monkeypatch):
    bench = EndsBench(slow(name))
    load = bench.sim.gravity_torque(bench.sim.plant.position[None])[0]
    torque = Command(np.array([Mode.POSITION, *[Mode.TORQUE] * 5], np.int8), load, bench.link.position_sent)
    for _ in range(5):
        bench.link.cycle(torque)
    sent, exchange = [], bench.link.commander.loop.exchange
    monkeypatch.setattr(
        bench.link.commander.loop,
        "exchange",
        lambda orders, *rest: (sent.append([*orders]), exchange(orders, *rest))[1],
    )
    with pytest.raises(Refused, match="shoulder: target torque is nan"):
        bench.link.cycle(Command(torque.mode, np.array([0.0, np.nan, *load[2:]]), bench.link.position_sent))
    assert sent[0][1].refused
    here = bench.sim.plant.position
    for joint in (0, 2, 3, 4, 5):
        assert (sent[0][joint].mode, sent[0][joint].power) == (Mode.POSITION, Power.ON)
        assert sent[0][joint].position == pytest.approx(here[joint], abs=0.02)
    bench.leave(Refused(""))
    assert bench.away() < 0.1


@pytest.mark.sample(1)
@every_family
def test_one_drive_that_falls_silent_does_not_let_the_others_go(name):
    bench = EndsBench(slow(name))
    bench.bus.inject("node.silent:wrist_3")
    with pytest.raises(Silence, match="wrist_3: no reading for") as fault:
        bench.hold(3.0)
    bench.leave(fault.value)
    others = np.arange(6) != 5
    assert (bench.peak[others] < 3.0).all(), f"the wrist that hangs free strikes its stop: {bench.peak}"
    assert np.abs(bench.sim.plant.position - bench.arm.link.park.pose)[others].max() < 0.25
    assert not any(bench.powered[:5])


@pytest.mark.sample(1)
@pytest.mark.parametrize("fault", ["forged.position:wrist_3:1.0", "forged.position:wrist_3:5e4"])
@every_family
def test_a_joint_is_not_held_where_only_a_false_reading_has_it(name, fault):
    """No family's frames carry 5e4 rad but those of moteus and ODrive; the others cut it off."""
    bench = EndsBench(slow(name))
    bench.bus.inject(fault)
    with pytest.raises((BusFault, Refused)) as refused:
        bench.hold(3.0)
    bench.leave(refused.value)
    assert not any(bench.powered)
    speed = np.minimum(bench.arm.link.park.speed, [joint.max_velocity for joint in bench.arm.link.joints])
    assert (bench.peak < speed + EXTRA_SPEED).all(), bench.peak
    assert np.abs(bench.sim.plant.position - bench.arm.link.park.pose)[:5].max() < 0.1


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ["six-damiao", "six-robstride", "six-odrive"])  # whose faults need a power cycle
def test_drives_that_have_power_when_an_enable_fails_are_parked(name):
    bench = EndsBench(slow(name), enable=False)
    bench.bus.inject("drive.latched:wrist_3")
    with pytest.raises(BusFault) as fault:
        bench.link.enable()
    assert bench.link.held
    bench.leave(fault.value)
    assert (bench.peak[:5] < bench.arm.link.park.speed + EXTRA_SPEED).all(), bench.peak
    assert np.abs(bench.sim.plant.position - bench.arm.link.park.pose)[:5].max() < 0.1
    assert not any(bench.powered[:5])


def test_an_error_of_the_way_to_park_lets_the_arm_down(monkeypatch, caplog):
    def failing(*args: object) -> None:
        raise MemoryError("a way that is too long")

    bench = EndsBench(slow("six-damiao"))
    monkeypatch.setattr("armlink.link.ends.park", failing)
    monkeypatch.setattr("armlink.link.park.LONGEST_LOWERING", 3.0)
    with caplog.at_level(logging.INFO, "armlink"):
        bench.leave(None)
    assert (
        "the arm could not be parked, so it is being lowered, which takes at most 3 s: MemoryError: a "
        "way that is too long"
    ) in caplog.text
    assert (bench.peak < 0.1 + EXTRA_SPEED).all(), bench.peak
    assert not any(bench.powered)


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    "name", [name for name in FALLING if name not in ("six-cubemars", "six-myactuator", "six-piper")]
)
def test_a_drive_that_stops_by_itself_is_caught(name):
    """CubeMars and MyActuator drives make torque again at the next command, and a Piper's does not stop by itself."""
    bench = EndsBench(name)
    bench.bus.inject("drive.trip:shoulder")
    with pytest.raises(BusFault) as fault:
        bench.hold(3.0)
    bench.leave(fault.value)
    assert (bench.peak < CATCH_SPEED).all(), bench.peak
    assert bench.away() < 0.1
    assert not any(bench.powered)


@pytest.mark.long
@every_family
def test_a_host_that_stood_still_catches_the_arm(name):
    bench = EndsBench(name)
    bench.sim.advance(0.15)  # longer than link.deadline: every drive has let go
    with pytest.raises(BusFault) as fault:
        bench.hold(3.0)
    bench.leave(fault.value)
    assert (bench.peak < 3 * CATCH_SPEED).all(), bench.peak  # an ODrive tells its state every 0.1 s alone
    assert bench.away() < 0.1


def test_a_pendulum_without_a_pose_is_let_down_to_where_it_hangs(caplog):
    """The test below on one joint, of which nothing is left out but its size."""
    arm = serving.pendulum(serving.drives(kd=2.0)["damiao"], bus={"interface": "virtual"}, rate=100)
    sim = SimulatedArm(arm, Truth.of(arm))
    peak = 0.0

    def look() -> None:
        nonlocal peak
        peak = max(peak, abs(float(sim.plant.velocity[0])))

    with caplog.at_level(logging.INFO, "armlink"), Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        link.enable()
        for target in straight_path(link.position_sent, np.array([0.5]), np.ones(1), link.period):
            link.cycle(Command.hold(target))
        for _ in range(50):
            link.cycle(Command.hold(np.array([0.5])))
        after_each_step(sim.plant, look)
    assert re.search(
        (
            r"the arm could not be parked, so it is being lowered, which takes at most \d+ s: the arm "
            r"file has no link\.park"
        ),
        caplog.text,
    )
    assert not sim.device(0).motor.powered
    assert abs(sim.plant.position[0]) < 0.1, "it hangs where it rests"
    sim.advance(2.0)
    assert peak < 0.1 + 0.1, "and falls at no time"


@pytest.mark.long
def test_an_arm_without_a_pose_is_let_down_slowly(caplog):
    path = bundled_arms()["six-damiao"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    del content["link"]["park"]
    bench = EndsBench(parse_arm(content, path))
    start = float(np.abs(bench.sim.gravity_torque(bench.sim.plant.position[None]))[0].max())
    with caplog.at_level(logging.INFO, "armlink"):
        bench.leave(None)
    assert re.search(
        (
            r"the arm could not be parked, so it is being lowered, which takes at most \d+ s: the arm "
            r"file has no link\.park"
        ),
        caplog.text,
    )
    assert not any(bench.powered)
    assert (bench.peak < 0.1 + EXTRA_SPEED).all(), bench.peak
    left = np.abs(bench.sim.gravity_torque(bench.sim.plant.position[None]))[0].max()
    assert left < 0.2 * start, "it hangs where it rests"
    bench.sim.advance(2.0)
    assert (bench.peak < 0.1 + EXTRA_SPEED).all(), "and does not fall further"


@pytest.mark.long
def test_an_arm_that_is_blocked_on_its_way_is_let_down(caplog):
    bench = EndsBench(slow("six-damiao"))
    at = float(bench.sim.plant.position[1])
    bench.sim.plant.model.jnt_range[1] = (at - 0.02, at + 0.02)  # something is in the way
    bench.sim.plant.model.jnt_limited[1] = 1
    with caplog.at_level(logging.INFO, "armlink"):
        bench.leave(None)
    assert "stopped following its target" in caplog.text
    assert (bench.peak < 0.4 + EXTRA_SPEED).all(), bench.peak
    assert not any(bench.powered)


def test_only_two_presses_within_two_seconds_let_the_arm_go(monkeypatch, caplog):
    now = [0.0]
    monkeypatch.setattr("armlink.termination.time.monotonic", lambda: now[0])
    presses = Presses()
    tell = end_logger("arm", presses)
    for now[0] in (0.0, 2.5, 5.0):
        presses.press()
        tell("parking, 12 s left")
    assert "pressing Ctrl-C again within 2 s lets the arm fall" in caplog.text
    assert caplog.text.count("parking, 12 s left") == 1
    assert not presses.dropped
    now[0] = 6.5
    presses.press()
    bench = EndsBench(slow("six-damiao"))
    with caplog.at_level(logging.INFO, "armlink"):
        bench.link.close(EndCause.INTERRUPTED, end_logger("arm", presses))
    assert all(bench.powered), "told to stop, which damps until the drives miss their host"
    bench.sim.advance(0.5)
    assert not any(bench.powered)


def test_a_link_that_holds_the_arm_takes_up_its_work_again():
    bench = EndsBench(slow("six-robstride"))
    with pytest.raises(Refused):
        bench.float_torque(5.0)
    with pytest.raises(BusFault, match="not enabled"):
        bench.hold(0.1)
    bench.link.recover()
    bench.hold(1.0)
    assert not bench.link.held
    bench.leave(None)
    assert (bench.peak < 1.5 + EXTRA_SPEED).all(), bench.peak


def test_the_table_of_ends_is_the_page_s():
    page = (Path(__file__).parents[3] / "docs" / "safety.md").read_text(encoding="utf-8")
    for cause in EndCause:
        holds, falls = ENDS[cause]
        row = rf"\| {re.escape(cause.value)} \| {re.escape(holds.value)} \| {re.escape(falls.value)} \|"
        assert re.search(row, page), f"docs/safety.md has no row for: {cause.value}"
    assert {cause_of(error) for error in ERRORS.values()} < set(EndCause)
