"""CiA 402 drives that offer cyclic velocity alone: the host leads positions, within speed and window, to the byte."""

import math

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.arm_file import ArmFile, bundled_arms, parse_arm
from armlink.drives.canopen.cia402 import CYCLIC_VELOCITY, loop_gain, velocity_towards
from armlink.drives.orders import Limits, Mode
from armlink.errors import BadInput, Refused
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.types import Command
from armlink.selftest.self_test import SelfTest
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

WIDE = st.floats(-4.0, 4.0)
LIMITS = Limits(10.0, 100.0, 1.0, -1.0, 1.5, 0.1, 0.004)


def arm_of() -> ArmFile:
    path = bundled_arms()["six-cia402"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["sim"]["device"] = "velocity"
    return parse_arm(content, path)


@pytest.fixture
def sim() -> SimulatedArm:
    arm = arm_of()
    return SimulatedArm(arm, Truth.of(arm), 1)


@given(WIDE, WIDE, WIDE)
@settings(max_examples=300, deadline=None)
def test_no_target_and_no_reading_makes_it_faster_than_allowed_or_leads_it_out(
    target: float, before: float, seen: float
) -> None:
    velocity = velocity_towards(target, before, seen, LIMITS)
    assert abs(velocity) <= LIMITS.max_velocity
    assert not (seen >= LIMITS.upper and velocity > 0)
    assert not (seen <= LIMITS.lower and velocity < 0)
    inside = LIMITS.lower <= seen <= LIMITS.upper
    assert not inside or LIMITS.lower - 1e-9 <= seen + velocity / loop_gain(LIMITS.period) <= LIMITS.upper + 1e-9


def test_without_a_reading_it_rests() -> None:
    assert velocity_towards(1.0, 0.5, math.nan, LIMITS) == 0.0


def test_it_follows_a_ramp_holds_and_obeys_no_torque(sim: SimulatedArm) -> None:
    fastest = 0.0
    with Link(arm_of(), LockStepBus(arm=sim)) as link:
        link.start()
        start = link.enable().position
        goal = start + 0.3 * np.where(start > 0, -1.0, 1.0)
        late = 0.0
        for target in straight_path(start, goal, np.full(6, 0.5), link.period):
            sample = link.cycle(Command.hold(target))
            late = max(late, float(np.abs(sample.position - target).max()))
            fastest = max(fastest, *(abs(order.velocity) for order in link.orders_sent))
        for _ in range(250):
            sample = link.cycle(Command.hold(goal))
        with pytest.raises(Refused, match="mode"):
            link.cycle(Command(np.full(6, Mode.TORQUE, np.int8), np.zeros(6), goal))
        link.stop()
    assert late < 0.02
    np.testing.assert_allclose(sample.position, goal, atol=2e-3)
    assert 0.4 < fastest <= 1.0
    assert all(display == CYCLIC_VELOCITY for display in link.groups[0].drives.known.displays)  # type: ignore[attr-defined]


def test_a_guard_of_the_bus_refuses_it(sim: SimulatedArm) -> None:
    with (
        Link(arm_of(), LockStepBus(arm=sim)) as link,
        pytest.raises(BadInput, match=r"base: its drive takes only velocities"),
    ):
        link.guard_rules()


def test_the_self_test_passes_and_says_what_is_lost(sim: SimulatedArm) -> None:
    with Link(arm_of(), LockStepBus(arm=sim)) as link:
        results = SelfTest(link).run(power=False)
    assert [each for each in results if each.outcome == "failed"] == []
    assert any("only mode 9" in each.found for each in results)
