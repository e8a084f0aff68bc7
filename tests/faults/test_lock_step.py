"""Every row of the fault table on the in-process bus, cycle by cycle; and that the table in docs/ is this one."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rows import ARM, QUICK_STOP, ROWS, Row, table

from armlink.arm_file import parse_arm
from armlink.drives.canopen.cia402 import DriveState
from armlink.errors import ArmlinkError, BadInput, BusFault
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.fault_kinds import KINDS, parse_fault
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

BIAS = 2.0
SAFE = (DriveState.QUICK_STOP, DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
DEADLINE = 0.1
"""link.deadline [s]."""
BY_KEY = {row.key: row for row in ROWS}
CYCLIC = [row for row in ROWS if row.cycles is not None and row.inject.split(":")[0] in KINDS]


def pattern(reads: str) -> str:
    return "^" + ".*".join(map(re.escape, reads.split("…"))) + "$"


class Bench:
    """The arm, its link and the command: joint 1 under a bias torque, the others in position control."""

    def __init__(self, timing: bool = False) -> None:
        arm = parse_arm(ARM, Path("triple.yaml"))
        self.bus = LockStepBus(arm=SimulatedArm(arm, Truth.of(arm)), timing=timing)
        self.link = Link(arm, self.bus)

    def enable(self) -> None:
        self.link.start()
        self.command = Command.hold(self.link.enable().position)
        self.command.mode[0], self.command.torque[0] = 10, BIAS
        for _ in range(10):
            self.link.cycle(self.command)

    def cycles_until_fault(self, most: int = 60) -> tuple[int, ArmlinkError]:
        for cycle in range(1, most + 1):
            try:
                self.link.cycle(self.command)
            except ArmlinkError as error:
                return cycle, error
        raise AssertionError(f"no fault in {most} cycles")

    @property
    def states(self) -> list[DriveState]:
        return self.bus.arm.drives.state

    def safe(self) -> bool:
        """No joint moves, and none makes the bias torque any more."""
        self.bus.clock.sleep_until(self.bus.clock.now() + 1.0)
        plant = self.bus.arm.plant
        return all(state in SAFE for state in self.states) and bool(np.abs(plant.velocity).max() < 1e-3)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    with bench.link:
        yield bench


def test_the_table_in_the_documentation_is_this_one() -> None:
    page = Path(__file__).parents[2] / "docs" / "faults.md"
    assert table() in page.read_text(encoding="utf-8"), "run: python tests/faults/rows.py, and paste it"


def test_every_fault_that_can_be_injected_has_its_row() -> None:
    assert {row.inject.split(":")[0] for row in ROWS} >= set(KINDS)


@pytest.mark.parametrize("row", CYCLIC, ids=lambda row: row.key)
def test_a_fault_is_seen_in_time_leaves_the_joints_safe_and_says_what_it_is(row: Row, bench: Bench) -> None:
    bench.enable()
    bench.bus.inject(row.inject)
    if row.key == "mode refused":
        bench.command.mode[1], bench.command.torque[1] = 10, bench.bus.arm.plant.link_torque[1]
    cycles, error = bench.cycles_until_fault()
    assert isinstance(error, BusFault)
    assert re.match(pattern(row.reads), str(error)), str(error)
    assert row.cycles - 1 <= cycles <= row.cycles  # an age that just reaches the deadline may be a rounding beyond it
    if not bench.bus._injector.refusal:  # where frames still pass, the link itself has stopped them by now
        reached = [state for joint, state in enumerate(bench.states) if not (joint == 1 and row.key == "node silent")]
        assert all(state in SAFE for state in reached)
    bench.bus.clock.sleep_until(bench.bus.clock.now() + DEADLINE + bench.link.period)
    assert all(state in SAFE for state in bench.states)
    assert bench.safe()
    if row.joints == QUICK_STOP:
        assert bench.states == [DriveState.QUICK_STOP] * 3


@pytest.mark.parametrize("key", ["bus-off", "link down", "nobody acknowledges", "node silent", "clock jump"])
def test_after_a_passing_fault_the_same_link_starts_and_enables_again(key: str, bench: Bench) -> None:
    bench.enable()
    bench.bus.inject(BY_KEY[key].inject)
    bench.cycles_until_fault()
    bench.bus.clock.sleep_until(bench.bus.clock.now() + 1.0)
    bench.bus.clear_faults()
    bench.enable()
    for _ in range(50):
        bench.link.cycle(bench.command)
    assert bench.states == [DriveState.ENABLED] * 3


@pytest.mark.parametrize("key", ["SDO abort", "SDO time-out"])
def test_a_node_without_sdo_is_named_and_nothing_is_powered(key: str, bench: Bench) -> None:
    bench.bus.inject(BY_KEY[key].inject)
    with pytest.raises(BusFault, match=pattern(BY_KEY[key].reads)):
        bench.link.start()
    assert bench.states == [DriveState.SWITCH_ON_DISABLED] * 3


@pytest.mark.parametrize("fault", ["sdo.abort:joint_2", "sdo.timeout:joint_2"])
def test_a_node_that_loses_its_sdo_while_enabled_holds_on(fault: str, bench: Bench) -> None:
    bench.enable()
    bench.bus.inject(fault)
    with pytest.raises(BusFault, match=r"joint_2 \(node 12\)"):
        bench.link.read_calibration(1)
    assert bench.states == [DriveState.ENABLED] * 3
    bench.link.cycle(bench.command)


def test_a_wall_clock_that_is_set_back_changes_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.enable()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    for _ in range(50):
        bench.link.cycle(bench.command)
    assert bench.states == [DriveState.ENABLED] * 3


@pytest.mark.parametrize("pause", [0.2, 5.0])
def test_a_host_that_stops_is_noticed_by_the_joints_and_told_when_it_goes_on(pause: float, bench: Bench) -> None:
    bench.enable()
    arm = bench.bus.arm
    arm.advance(DEADLINE - 0.01)
    assert bench.states == [DriveState.ENABLED] * 3
    arm.advance(0.01 + arm.period)
    assert bench.states == [DriveState.QUICK_STOP] * 3
    arm.advance(pause)
    assert bench.safe()
    cycles, error = bench.cycles_until_fault()
    assert (cycles, str(error)) == (BY_KEY["host stopped"].cycles, BY_KEY["host stopped"].reads)


def test_a_corrupted_bus_counts_its_error_frames(bench: Bench) -> None:
    bench.enable()
    bench.bus.inject("frame.corrupt:joint_2:0.2")
    for _ in range(100):
        bench.link.cycle(bench.command)
    assert bench.bus.errors > 10
    assert bench.states == [DriveState.ENABLED] * 3


def test_emergencies_without_end_are_not_kept_without_end(bench: Bench) -> None:
    bench.enable()
    bench.bus.inject("emcy.storm:joint_2:100000")
    bench.cycles_until_fault()
    for _ in range(5):
        bench.link.enable()
        with pytest.raises(BusFault, match=r"emergency 7305h|babbles"):
            bench.link.cycle(bench.command)
    assert len(bench.link.groups[0].drives.known.emergencies) < 1000


@pytest.mark.parametrize(
    "text",
    ["nothing:joint_1", "node.silent", "bus.off:joint_1", "node.silent:knee", "bus.off::x", "node.reboot:joint_1:3"],
)
def test_what_cannot_be_injected_is_said(text: str) -> None:
    with pytest.raises(BadInput, match="fault"):
        parse_fault(text, ("joint_1",))


@pytest.mark.sample(1)
@pytest.mark.parametrize("hosts", [12, 100])
def test_by_the_joints_own_clock_every_dead_host_is_noticed_within_the_deadline(bench: Bench, hosts: int) -> None:
    arm, random = bench.bus.arm, np.random.default_rng(4)
    for _ in range(hosts):
        bench.link.start()
        command = Command.hold(bench.link.enable().position)
        command.mode[0], command.torque[0] = 10, BIAS
        for _ in range(int(random.integers(3, 20))):
            bench.link.cycle(command)
        died = arm.time
        while any(state not in SAFE for state in arm.drives.state):
            arm.advance(0.001)
            assert arm.time - died <= DEADLINE + 0.001
        arm.advance(float(random.uniform(0.0, 0.05)))
