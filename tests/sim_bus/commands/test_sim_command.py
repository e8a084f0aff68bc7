"""`armlink sim`: the arm in a process of its own, on a bus that others share."""

import os
import signal
import struct
import subprocess
import sys
from pathlib import Path

import can
import pytest
from rig import Hand, one_joint

from armlink.bus.adapters import as_bus
from armlink.cli import run
from armlink.drives.canopen.cia402 import DriveState
from armlink.errors import BadInput
from sim_bus.bus.control_pipe import ControlPipe
from sim_bus.bus.effect_options import SensorDrift
from sim_bus.bus.server import ArmServer
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["sim", "nowhere"], 2, "no arm file nowhere"),
        (["sim", "sarcos", "--bus", "socketcan:nosuchcan"], 3, "nosuchcan"),
        (["sim", "sarcos", "--bus", "nonsense"], 2, "INTERFACE:CHANNEL"),
        (["sim", "sarcos"], 2, "--bus"),
        (["sim", "sarcos", "--effect", "friction.coulomb:knee:1"], 2, "no joint 'knee'"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    arguments: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == status
    error = capsys.readouterr().err
    assert message in error
    assert error.strip().count("\n") == 0


def receive(bus: can.BusABC) -> list[tuple[int, bytes]]:
    frames = []
    while (message := bus.recv(0)) is not None:
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_physics_follows_the_clock_and_a_drift_comes_at_its_time(ends: tuple[can.BusABC, can.BusABC]) -> None:
    arm_end, host_end = ends
    described, hand = one_joint(), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    server = ArmServer(arm, as_bus(arm_end), [SensorDrift("hinge", 1.5, 0.0, 0.15)], now=hand.now)
    hand.time = 0.1
    server.turn()
    assert receive(host_end) == [(0x705, b"\0")]
    assert arm.time == pytest.approx(0.1)
    assert arm.true_sensors.gain[0] == 1.0
    hand.time = 0.2
    server.turn()
    assert arm.true_sensors.gain[0] == 1.5
    hand.time = 100.0  # as after a stopped process: the lost time is not made up for
    server.turn()
    assert arm.time == pytest.approx(0.45)


def test_in_lock_step_a_sync_is_a_period(ends: tuple[can.BusABC, can.BusABC]) -> None:
    arm_end, host_end = ends
    described, hand = one_joint(), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    server = ArmServer(arm, as_bus(arm_end), lockstep=True, now=hand.now)
    for can_id, data in ((0, b"\1\0"), (0x80, b""), (0x80, b"")):
        host_end.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        hand.time += 0.05
        server.turn()
    frames = receive(host_end)
    assert [can_id for can_id, _ in frames].count(0x185) == 2
    assert arm.time == pytest.approx(2 * 0.004, abs=1e-9)


@pytest.mark.sample(1)
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_a_process_answers_until_it_is_signalled(number: int, status: int) -> None:
    group = "239.74.163.29"
    command = ["-c", "from armlink.cli import main; main()", "sim", "sarcos", "--bus", f"udp_multicast:{group}"]
    port = 44200 + os.getpid() % 1000  # of one's own: all groups on one port hear each other
    environment = {**os.environ, "CAN_CONFIG": f'{{"port": {port}}}'}
    with can.Bus(group, interface="udp_multicast", port=port) as host:
        process = subprocess.Popen([sys.executable, *command], stderr=subprocess.PIPE, text=True, env=environment)
        try:
            assert process.stderr is not None
            assert "nodes 1, 2, 3, 4, 5, 6, 7" in process.stderr.readline()
            request = bytes.fromhex("4000100000000000")
            host.send(can.Message(arbitration_id=0x603, data=request, is_extended_id=False))
            answers = (host.recv(10.0) for _ in range(20))
            answer = next(frame for frame in answers if frame is not None and frame.arbitration_id == 0x583)
            assert bytes(answer.data) == bytes.fromhex("4300100092010200")
        finally:
            process.send_signal(number)
            assert process.wait(20) == status


def test_in_lock_step_a_host_that_died_is_noticed(ends: tuple[can.BusABC, can.BusABC]) -> None:
    arm_end, host_end = ends
    described, hand = one_joint(), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    server = ArmServer(arm, as_bus(arm_end), lockstep=True, now=hand.now)

    def send(can_id: int, data: bytes) -> None:
        host_end.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        hand.time += 0.01
        server.turn()

    send(0x605, struct.pack("<BHBI", 0x23, 0x1016, 1, 0x7E << 16 | 50))
    send(0x605, struct.pack("<BHBh2x", 0x2B, 0x6007, 0, 3))
    send(0, b"\1\0")
    for word in (0x06, 0x07, 0x0F, 0x0F):
        send(0x205, struct.pack("<Hhi", word, 0, 0))
        send(0x77E, b"\5")
        send(0x80, b"")
    assert arm.drives.state == [DriveState.ENABLED]
    hand.time += 0.5  # a host that thinks: time rests
    server.turn()
    assert arm.drives.state == [DriveState.ENABLED]
    for _ in range(10):
        hand.time += 0.2
        server.turn()
    assert arm.drives.state == [DriveState.QUICK_STOP]


def test_orders_through_a_pipe_change_the_running_arm(ends: tuple[can.BusABC, can.BusABC], tmp_path: Path) -> None:
    described, hand, answers = one_joint(), Hand(), []
    arm = SimulatedArm(described, Truth.of(described))
    pipe = ControlPipe(tmp_path / "arm.pipe")
    server = ArmServer(arm, as_bus(ends[0]), now=hand.now, control=pipe)
    server.on_command = answers.append

    def order(*lines: str) -> None:
        pipe.path.write_text("".join(f"{line}\n" for line in lines))
        server.turn()

    order("effect friction.coulomb:hinge:1.5", "drift hinge:1.1:0.2", "mass 0.5")
    assert [entry.effect for entry in arm.effects] == ["friction.coulomb"]
    assert arm.true_sensors.gain[0] == pytest.approx(1.1)
    assert arm.gravity_torque(arm.plant.position)[0, 0] == pytest.approx(9.81 * 0.2)  # at the flange, on the axis
    order("effects none", "fault node.silent:hinge")
    assert arm.effects == ()
    assert arm.nodes[0].unplugged
    order("faults none")
    assert not arm.nodes[0].unplugged
    assert answers[2] == "mass 0.5: done"
    answers.clear()
    order("dance", "effect nothing:hinge:1", "mass heavy", "fault node.silent")
    assert len(answers) == 4
    assert not any(answer.endswith(": done") for answer in answers)
    assert "effect ID:JOINT:VALUE" in answers[0]
    pipe.close()
    assert not pipe.path.exists()


def test_a_file_is_no_pipe(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="is not a named pipe"):
        ControlPipe(tmp_path / "file")
