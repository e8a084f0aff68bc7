"""A flooded bus: the link keeps its cycle, stops what it can, and says that it is a flood and what it is made of."""

import random
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

from armlink.arm_file import ArmFile, load_arm
from armlink.bus.port import EXTENDED, REMOTE, Frame
from armlink.errors import ArmlinkError, BusFault
from armlink.link.bus_watchdog import MOST_FRAMES, frame_name
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.types import Command, Setpoints
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.effects.quasi_direct import QuasiDirect
from sim_bus.sim_section import EffectEntry
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

QUICK_STOP = 0x07
SPEED, EXCESS = 0.3, 1.0
"""Of the motion [rad/s]; no joint may be this much faster than it, at any time [rad/s]."""
STILL = 0.1
"""A joint that holds, hangs or sinks against its damping is slower than this [rad/s]."""
AFTERWARDS = 3.0
"""How long the joints are watched after the end [s]."""
FLOODS: dict[str, Callable[[list[Frame]], list[Frame]]] = {
    "low priority": lambda sent: [(0x7FE, bytes(8))],
    "extended": lambda sent: [(EXTENDED | 0x1FFFFFFF, bytes(8))],
    "remote": lambda sent: [(REMOTE | 0x7F0, b"")],
    "the drives' own": lambda sent: sent,
}
FAMILIES = ("cia402", "damiao", "robstride", "cubemars", "moteus", "odrive", "myactuator")
ROWS = sorted(
    random.Random(3).sample([*product(FAMILIES, FLOODS, (100, 1100))], 48),
    key=lambda row: (row[2], row[0] == "moteus"),
)
"""Drawn, so that the first few have little in common; small floods, and arms that are simulated faster, first."""


class FloodedBus(LockStepBus):
    """Each cycle brings `count` frames more than the drives send, once `flood` is set; true speeds are kept."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm=arm)
        self.flood: Callable[[list[Frame]], list[Frame]] | None = None
        self.count = 0
        self.fastest = 0.0
        advance = arm.advance

        def watched(duration: float) -> None:
            advance(duration)
            self.fastest = max(self.fastest, float(np.abs(arm.plant.velocity).max()))
            if self.flood is not None:
                frames = self.flood(list(arm.outbox)) or [(0x7FE, bytes(8))]
                arm.outbox.extend(frames * (self.count // len(frames)))

        arm.advance = watched  # type: ignore[method-assign]


def damping_of(arm: ArmFile) -> list[EffectEntry]:
    """The least damping that drives come with: these arms have none, and where one hangs without power it would rock
    for ever about its rest from wherever the flood left it.
    """
    shares = QuasiDirect().viscous[0] * arm.require_link().rated_torques
    return [
        EffectEntry(effect="friction.viscous", joint=name, damping=share)
        for name, share in zip(arm.joint_names, shares, strict=True)
    ]


def flooded(family: str, kind: str, count: int) -> tuple[FloodedBus, ArmlinkError | None]:
    """An arm in motion is flooded; its bus after its end, and the error that ended it."""
    arm = load_arm(f"six-{family}")
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    simulated.set_effects(damping_of(arm))
    bus, found = FloodedBus(simulated), None
    try:
        with Link(arm, bus) as link:
            link.start()
            start = link.enable().position
            way = straight_path(start, start + 0.3 * np.where(start > 0, -1, 1), np.full(link.n, SPEED), link.period)
            for row, _ in enumerate(link.play(Setpoints.follow(way))):
                if row == len(way) // 4:  # breaking away is over
                    bus.fastest = 0.0
                if row == len(way) // 2:
                    bus.flood, bus.count = FLOODS[kind], count
    except ArmlinkError as error:
        found = error
    simulated.advance(AFTERWARDS)
    return bus, found


@pytest.mark.parametrize(("family", "kind", "count"), ROWS)
@pytest.mark.sample(1)
def test_a_flood_drops_no_arm(family: str, kind: str, count: int) -> None:
    bus, error = flooded(family, kind, count)
    assert isinstance(error, BusFault)
    assert bus.fastest < SPEED + EXCESS
    assert float(np.abs(bus.arm.plant.velocity).max()) < STILL


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("low priority", "7FEh"),
        ("extended", "1FFFFFFFh"),
        ("remote", "remote frames 7F0h"),
        ("the drives' own", "readings of "),
    ],
)
@pytest.mark.parametrize("count", [200, pytest.param(1100, marks=pytest.mark.long)])
def test_what_a_flood_is_made_of_is_named(kind: str, named: str, count: int) -> None:
    said = str(flooded("cia402", kind, count)[1])
    if kind == "the drives' own" and count == 200:
        assert "a second node" in said
    else:
        assert said.startswith("the bus carries more frames than these joints send, most of them " + named)


def fault_of(link: Link, cycles: int = 3) -> str:
    """What a cycle raises, in words."""
    for _ in range(cycles):
        try:
            link.cycle(Command.hold(link.latest_position))
        except BusFault as fault:
            return str(fault)
    raise AssertionError(f"no fault in {cycles} cycles")


def test_a_flood_of_the_readings_of_one_joint_names_it(enabled: Link, bus: Any) -> None:
    bus.out.extend([(0x182, bytes(8))] * (MOST_FRAMES + 100))
    assert "most of them readings of joint_2: a node babbles" in fault_of(enabled)


def test_readings_that_a_flood_keeps_away_are_put_down_to_it() -> None:
    """On a wire of 1 Mbit/s others send 35 frames of highest priority a cycle: far fewer than make a crowd."""
    arm = load_arm("six-robstride")
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    bus = LockStepBus(arm=simulated, timing=True)
    wire = bus.wire
    assert wire is not None
    with Link(arm, bus) as link:
        link.start()
        held = Command.hold(link.enable().position)
        for _ in range(20):
            link.cycle(held)
        advance = wire.advance

        def crowded(duration: float) -> None:
            simulated.outbox.extend([(0x001, bytes(8))] * round(35 * duration / simulated.period))
            advance(duration)

        wire.advance = crowded  # type: ignore[method-assign]
        said = fault_of(link, 60)
    assert "reading for 1" in said
    assert "meanwhile other nodes fill the bus with " in said
    assert "most of them 001h: a node babbles, disconnect this node" in said


def test_another_host_is_named_and_not_the_drive_that_it_stopped(enabled: Link, bus: Any) -> None:
    bus.out.append((0x202, bytes(8)))
    bus.nodes[2].status = QUICK_STOP
    bus.out.append((0x282, bytes.fromhex("0700000000000000")))
    assert fault_of(enabled).startswith("another host is on this bus: it sends RPDO1 of node 2 (202h)")


def test_a_request_on_a_bus_that_never_falls_silent_keeps_no_joint_waiting(enabled: Link, bus: Any) -> None:
    taken = 0

    def receive(timeout: float) -> Frame:
        nonlocal taken
        taken += 1
        assert taken < 50 * MOST_FRAMES, "no cycle comes any more"
        return bus.take(timeout) or (0x555, b"")

    enabled.commander.loop._port.receive = receive  # type: ignore[misc]
    bus.sent.clear()
    with pytest.raises(BusFault, match="most of them 555h: a node babbles"):
        enabled._pump(lambda: False, 0.5)
    assert any(can_id == 0x201 for can_id, _ in bus.sent)
    assert all(node.status == QUICK_STOP for node in bus.nodes.values())


class Deaf:
    """A port that reports bus-off in place of every other frame, or of all."""

    def __init__(self, port: Any, always: bool) -> None:
        self.port, self.always, self.turn = port, always, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.port, name)

    def receive(self, timeout: float) -> Frame | None:
        self.turn = not self.turn
        if self.turn or self.always:
            raise BusFault("bus fake: bus-off: check wiring, termination and bit rate")
        return self.port.receive(timeout)  # type: ignore[no-any-return]


@pytest.mark.parametrize("always", [False, True])
def test_bus_off_told_again_and_again_keeps_no_stop_from_leaving(enabled: Link, bus: Any, always: bool) -> None:
    enabled.commander.loop._port = Deaf(enabled.commander.loop._port, always)
    with pytest.raises(BusFault, match=r"^bus fake: bus-off: check wiring"):
        enabled.cycle(Command.hold(enabled.latest_position))
    assert all(node.status == QUICK_STOP for node in bus.nodes.values())


def test_a_queue_that_is_full_for_a_while_keeps_no_stop_from_leaving(enabled: Link, bus: Any) -> None:
    port, full = enabled.commander.loop._port, 3
    send = port.send

    def full_at_first(can_id: int, data: bytes) -> None:
        nonlocal full
        full -= 1
        if full > 0:
            raise BusFault("bus fake: transmit queue stays full")
        send(can_id, data)

    port.send = full_at_first  # type: ignore[misc]
    with pytest.raises(BusFault, match="stays full"):
        enabled.cycle(Command.hold(enabled.latest_position))
    assert all(node.status == QUICK_STOP for node in bus.nodes.values())


def test_a_frame_is_named_as_people_write_it() -> None:
    named = [frame_name(each) for each in (0x1, 0x7FF, EXTENDED | 0x14FD01, REMOTE | 0x201, 1 << 34 | 0x201)]
    assert named == ["001h", "7FFh", "0014FD01h", "remote frames 201h", "201h"]
