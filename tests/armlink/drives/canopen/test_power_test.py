"""The part of the check that needs power: what is told where it cannot go on, and how a reaction is judged."""

from types import SimpleNamespace

import pytest

from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.check.self_test import POWER_CHECKS, CanopenSelfTest
from armlink.drives.canopen.cia402 import DriveState
from armlink.drives.findings import Checks
from armlink.errors import BusFault


class Bench:
    """A test of two joints that drives none; the second one has no deadline for commands."""

    def __init__(self, start=lambda: None):
        self.silenced = []
        loop = SimpleNamespace(withheld=None)
        link = SimpleNamespace(n=2, names=("a", "b"), period=0.004, start=start, ask=None)
        link.commander = SimpleNamespace(loop=loop, passed=())
        has = [SimpleNamespace(has=lambda entry: True), SimpleNamespace(has=lambda entry: False)]
        self.known = SimpleNamespace(emergencies=[], node_states={})
        drives = SimpleNamespace(
            cycle=SimpleNamespace(beating=False),
            wires=[SimpleNamespace(profile=each) for each in has],
            known=self.known,
            m=2,
            services=lambda ask: (),
        )
        self.test = CanopenSelfTest(link, drives, [], lambda text: None)
        self.checks = self.test.checks
        for name in ("_without_torque", "_require_watch", "_enable", "_no_heartbeat"):
            setattr(self.test, name, lambda: None)
        self.test._quick_stop = lambda joint: None
        self.test._silence = self.silenced.append

    @property
    def told(self):
        return [(each.joint, each.check, each.outcome, each.found, each.seconds) for each in self.checks.results]


def test_what_a_fault_kept_from_being_reached_is_told_with_the_fault_once_as_failed():
    def start():
        raise BusFault("a: no answer")

    bench = Bench(start)
    bench.test._with_power(True)
    assert bench.told[0][:4] == ("a", POWER_CHECKS[0], "failed", "a: no answer")
    assert [each[2:4] for each in bench.told[1:]] == [("not run", "a: no answer")] * (2 * len(POWER_CHECKS) - 1)


def test_a_joint_without_a_deadline_is_not_left_without_commands():
    bench = Bench()
    bench.test._with_power(True)
    assert bench.silenced == [0]
    assert ("b", "RPDO deadline", "absent") in [each[:3] for each in bench.told]


@pytest.mark.parametrize(
    ("state", "seconds", "outcome", "says"),
    [
        (DriveState.QUICK_STOP, 0.12, "passed", "quick stop after 120 ms (set to 100 ms), no emergency"),
        (DriveState.QUICK_STOP, 0.25, "failed", "quick stop too late, after 250 ms (set to 100 ms), no emergency"),
        (DriveState.ENABLED, 0.3, "failed", "does nothing within 300 ms (set to 100 ms)"),
    ],
)
def test_a_quick_stop_in_time_passes(state, seconds, outcome, says):
    bench = Bench()
    bench.test._judge(1, "RPDO deadline", state, seconds, 0.1)
    assert [each[:4] for each in bench.told] == [("b", "RPDO deadline", outcome, says)]


def test_a_joint_that_loses_its_power_is_told_with_its_emergency():
    bench = Bench()
    bench.known.emergencies = [(0, 0x8110, b""), (1, 0x8130, b"")]
    bench.known.node_states = {1: 4}
    bench.test._judge(1, "heartbeat of the host", DriveState.SWITCH_ON_DISABLED, 0.1, 0.1)
    ((name, _, outcome, says, seconds),) = bench.told
    assert (name, outcome, seconds) == ("b", "failed", 0.1)
    assert 'instead of "quick stop active" after 100 ms (set to 100 ms), emergency 8130h, NMT ' in says
    assert objects.NMT_STATES[4] in says
    assert says.endswith("; does this device swap the values 2 and 3 of 6007h?")


@pytest.mark.parametrize(
    ("outcome", "power", "says"),
    [
        ("failed", True, "not run: a failed the check of its units"),
        ("failed", False, "not run: a failed the check of its units"),
        ("passed", False, "not run: the checks with power were not requested"),
        ("passed", True, None),
    ],
)
def test_no_joint_is_driven_unless_asked_for_and_all_before_has_passed(outcome, power, says):
    ran, checks = [], Checks()
    checks.add("a", "units", outcome, "")
    link = SimpleNamespace(names=("a", "b"))
    test = SimpleNamespace(checks=checks, link=link, _check_with_power=lambda: ran.append(test))
    CanopenSelfTest._with_power(test, power)
    told = checks.results[1:]
    assert len(ran) == (says is None)
    assert {(each.outcome, each.found) for each in told} == ({("not run", says)} if says else set())
    assert len(told) == (2 * len(POWER_CHECKS) if says else 0)
