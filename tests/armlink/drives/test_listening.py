"""What the drives' classes make of single frames, where another host asks or the drive tells its state by itself."""

import struct
from types import SimpleNamespace

import pytest

from armlink.arm_file import load_arm
from armlink.drives.damiao import frames
from armlink.drives.damiao.drives import READ, WRITE
from armlink.drives.family import family
from armlink.drives.odrive.drives import ODriveDrives
from armlink.drives.odrive.frames import AxisState

PMAX = 21


def damiao_drives():
    arm = load_arm("six-damiao")
    return family("damiao").build(arm, arm.require_link().joints)


def answer(drive: int, kind: int, register: int, value: float) -> bytes:
    return struct.pack("<HBBf", drive, kind, register, value)


def test_a_range_that_another_host_asked_for_holds_from_its_answer_on():
    drives = damiao_drives()
    before = drives.memory[0].grid.ranges.position
    assert before != 20.0
    drives.take(0x11, answer(1, READ, PMAX, 20.0), 0.0)  # nobody has asked
    assert drives.memory[0].grid.ranges.position == before
    assert drives.command_of(frames.REGISTERS_ID, frames.read_request(1, PMAX)) is None
    drives.take(0x11, answer(1, READ, PMAX, 20.0), 0.0)
    assert drives.memory[0].grid.ranges.position == 20.0
    assert drives.command_of(frames.REGISTERS_ID, frames.write_request(1, PMAX, 16.0)) is None
    drives.take(0x11, answer(1, WRITE, PMAX, 16.0), 0.0)
    assert drives.memory[0].grid.ranges.position == 16.0


@pytest.mark.parametrize(("state", "free"), [(None, False), (AxisState.IDLE, True), (AxisState.CLOSED_LOOP, False)])
def test_an_odrive_lets_go_in_every_state_but_closed_loop(state, free):
    beat = None if state is None else SimpleNamespace(state=state)
    drives = SimpleNamespace(memory=[SimpleNamespace(heartbeat=beat)])
    assert ODriveDrives.lets_go(drives, 0) is free
