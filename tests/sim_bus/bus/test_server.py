"""The simulated arm in real time: physics advance when a frame or a timer needs them, and give what lock-step gives."""

import struct

import can
import numpy as np
import pytest
from rig import Hand, Rig, one_joint

from armlink.bus.adapters import as_bus
from sim_bus.bus.server import TICK, ArmServer
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


def test_only_frames_and_timers_that_need_it_advance_the_physics(ends: tuple[can.BusABC, can.BusABC]) -> None:
    arm_end, host_end = ends
    described, hand = one_joint(), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    server = ArmServer(arm, as_bus(arm_end), now=hand.now)

    def turn(can_id: int, data: bytes = b"") -> float:
        host_end.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        hand.time += 0.001
        server.turn()
        return arm.time

    assert turn(0, b"\1\0") == pytest.approx(0.001)
    assert turn(0x205, struct.pack("<Hhi", 6, 0, 0)) == pytest.approx(0.001)  # waits for SYNC
    assert turn(0x80) == pytest.approx(0.003)
    assert turn(0x605, bytes.fromhex("4000100000000000")) == pytest.approx(0.004)
    for _ in range(round(TICK / 0.001)):
        turn(0x205, struct.pack("<Hhi", 6, 0, 0))
    assert arm.time == pytest.approx(0.004 + TICK)
    turn(0x605, struct.pack("<BHBh2x", 0x2B, 0x1017, 0, 5))  # heartbeat every 5 ms
    due = arm.time + 0.005
    while hand.time < due - 0.0015:
        turn(0x205, struct.pack("<Hhi", 6, 0, 0))
    assert arm.time < due - 0.004
    turn(0x205, struct.pack("<Hhi", 6, 0, 0))
    turn(0x205, struct.pack("<Hhi", 6, 0, 0))
    assert arm.time >= due


def test_a_late_arm_says_so_itself_and_not_twice_in_a_second(ends: tuple[can.BusABC, can.BusABC]) -> None:
    described, hand, said = one_joint(), Hand(), list[tuple[float, float]]()
    server = ArmServer(SimulatedArm(described, Truth.of(described)), as_bus(ends[0]), now=hand.now)
    server.on_late = lambda lag, at: said.append((lag, at))
    for pause in (TICK, 0.6, 0.1, TICK, 1.0):
        hand.time += pause
        server.turn()
    assert [lag for lag, _ in said] == pytest.approx([0.6, 1.0])


@pytest.mark.parametrize("pieces", [[0.004], [0.002, 0.002], [0.0005, 0.003, 0.0005], [0.0038, 0.0005], [0.004, 0.009]])
def test_a_position_target_is_reached_in_its_time_and_passed_for_one_more(pieces: list[float]) -> None:
    rig = Rig(one_joint())
    rig.start(8)
    loops = rig.arm.drives.loops
    rig.run(0.1)
    before = loops._target.copy()
    rig.position += 1000
    for node, position in zip(rig.nodes, rig.position, strict=True):
        rig.arm.on_frame(0x200 + node, struct.pack("<Hhi", rig.word, 0, int(position)))
    rig.arm.on_frame(0x80, b"")
    for piece in pieces:
        rig.arm.advance(piece)
    moved = (loops._target - before) / (1000 * 2 * np.pi / 2**20)
    assert moved == pytest.approx(min(sum(pieces) / 0.004, 2.0), abs=1e-6)
