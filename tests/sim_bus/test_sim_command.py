"""`armlink sim`: the arm in a process of its own, on a bus that others share."""

import signal
import subprocess
import sys
from collections.abc import Iterator

import can
import pytest
from rig import one_joint

from armlink.cli import run
from sim_bus.options import Drift
from sim_bus.server import Server
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


class Hand:
    """A clock moved by hand."""

    time = 0.0

    def now(self) -> float:
        return self.time


@pytest.fixture
def ends() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    with can.Bus("sim", interface="virtual") as arm_end, can.Bus("sim", interface="virtual") as host_end:
        yield arm_end, host_end


def receive(bus: can.BusABC) -> list[tuple[int, bytes]]:
    frames = []
    while (message := bus.recv(0)) is not None:
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_physics_follows_the_clock_and_a_drift_comes_at_its_time(ends: tuple[can.BusABC, can.BusABC]) -> None:
    arm_end, host_end = ends
    described, hand = one_joint(), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    server = Server(arm, arm_end, [Drift("hinge", 1.5, 0.0, 0.15)], now=hand.now)
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
    server = Server(arm, arm_end, lockstep=True, now=hand.now)
    for can_id, data in ((0, b"\1\0"), (0x80, b""), (0x80, b"")):
        host_end.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        hand.time += 0.05
        server.turn()
    frames = receive(host_end)
    assert [can_id for can_id, _ in frames].count(0x185) == 2
    assert arm.time == pytest.approx(2 * 0.004, abs=1e-9)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_a_process_answers_until_it_is_signalled(number: int, status: int) -> None:
    group = "239.74.163.29"
    command = ["-c", "from armlink.cli import main; main()", "sim", "sarcos", "--bus", f"udp_multicast:{group}"]
    with can.Bus(group, interface="udp_multicast") as host:
        process = subprocess.Popen([sys.executable, *command], stderr=subprocess.PIPE, text=True)
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
