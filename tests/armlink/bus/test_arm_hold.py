"""One program drives an arm: a second one is refused, and told who has it, until the first has ended."""

import contextlib
import os
import socket
import subprocess
import sys

import pytest

from armlink.bus.arm_hold import ArmHold
from armlink.bus.bus_group import BusGroup
from armlink.errors import BusFault


class RealTimeBus:
    clock = None

    def __init__(self, name=None):
        self.channel_info = name or f"test:{os.getpid()}"


@contextlib.contextmanager
def held(*drives):
    hold = ArmHold(*drives)
    try:
        yield
    finally:
        hold.release()


def nodes(*numbers):
    return [("main", f"node {number}") for number in numbers]


HOLDER = """
import sys
from armlink.bus.arm_hold import ArmHold
class Bus: clock, channel_info = None, sys.argv[1]
ArmHold(Bus(), [("main", f"node {node}") for node in [3, 4]])
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def other():
    """Another program that drives nodes 3 and 4."""
    command = [sys.executable, "-c", HOLDER, RealTimeBus().channel_info]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_program_is_told_who_drives_the_arm(other):
    says = rf"test:\d+: node 4 is driven by python.*\(process {other.pid}, user {os.getuid()}\): stop that program"
    with pytest.raises(BusFault, match=says):
        ArmHold(RealTimeBus(), nodes(5, 4))
    with held(RealTimeBus(), nodes(5)):  # and what was taken on the way is free again
        pass
    with held(RealTimeBus("another bus"), nodes(3, 4)):
        pass


def test_who_fills_the_queue_of_a_hold_neither_takes_it_nor_keeps_others_waiting(other):
    crowd = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(20)]
    try:
        for each in crowd:
            each.setblocking(False)
            with contextlib.suppress(OSError):
                each.connect(f"\0armlink/{RealTimeBus().channel_info}/node 4")
                each.send(bytes(100_000))
        with pytest.raises(BusFault, match="node 4 is driven by "):
            ArmHold(RealTimeBus(), nodes(4))
    finally:
        for each in crowd:
            each.close()


def test_however_the_first_ends_the_arm_is_free(other):
    other.kill()
    other.wait()
    ArmHold(RealTimeBus(), nodes(3, 4)).release()


def test_a_process_may_hold_its_arm_more_than_once_and_lets_go_at_the_last():
    first, second = ArmHold(RealTimeBus(), nodes(7)), ArmHold(RealTimeBus(), nodes(7))
    first.release()
    command = [sys.executable, "-c", HOLDER.replace("[3, 4]", "[7]"), RealTimeBus().channel_info]
    refused = subprocess.run(command, input="", capture_output=True, text=True, check=False)
    assert "node 7 is driven by" in refused.stderr
    second.release()
    assert subprocess.run(command, input="", capture_output=True, text=True, check=True).stdout == "held\n"


def test_each_node_is_held_on_its_own_bus(other):
    group = BusGroup([RealTimeBus("free bus"), RealTimeBus()], ["first", "second"])
    with pytest.raises(BusFault, match="node 4 is driven by"):
        ArmHold(group, [("first", "node 3"), ("second", "node 4")])
    with held(group, [("first", "node 3"), ("first", "node 4")]):
        pass


def test_a_bus_of_this_process_is_nobody_else_s(other):
    bus = RealTimeBus()
    bus.clock = object()
    with held(bus, nodes(3, 4)):
        pass
