"""The daemon's bus loop, with frames, physics and the link: driving, listening, faults, and the process that it has."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path

import can
import numpy as np
import pytest
from daemon_bench import DaemonBench, InlineLoop
from fast_daemon import settings

from armlink.arm_file import load_arm
from armlink.bus.in_process import InProcessBus
from armlink.bus.listening.joint_messages import JointStateMessage, ListeningBus
from armlink.bus.open import open_link_bus
from armlink.channel import Channel
from armlink.errors import BadInput, BusFault
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.link.types import Calibration, Command, Sample, Stats
from armlink.loop import process
from armlink.loop.kept_arm import BatchMaker, KeptArm
from armlink.loop.messages import Batch, Call, Down, Health, LoopAnswer, Told, Up, pack
from armlink.loop.process import UNREAD_SECONDS
from calib.arm.kinematics import gcomp_arm
from calib.daemon.view import State
from calib.motion.trajectory import work_targets
from calib.records.file_lock import locked_directory
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm


def test_on_the_simulated_arm_with_its_bus(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, settings=settings("propose", observer={"window": 12}))
    assert bench.view.status().state is State.OBSERVING
    bench.run(8)
    assert bench.view.status().rows >= 2
    assert {joint.state for joint in bench.view.joints()} == {"operation enabled"}
    bench.bus_there = False
    bench.host.close()
    bench.run(2)
    status = bench.view.status()
    assert (status.state, status.bus.connected) == (State.FAULT, False)
    assert "No such device" in (status.bus.fault or "")
    bench.bus_there = True
    bench.run(4)
    assert bench.view.status().state is State.OBSERVING
    assert [event.kind for event in bench.view.events()][-1] == "recovered"
    bench.host.close()


def test_a_fault_of_a_joint_is_a_message_and_the_bus_is_opened_again(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    bench.run(1)
    bench.host.loop.arm.stop()
    reply = bench.host.pump()
    assert isinstance(reply[-1], Down | Told)
    assert any(isinstance(message, Down) for message in reply)
    bench.run(1)
    assert bench.view.status().state is State.OBSERVING


def test_no_state_is_lost_at_20_joints_and_1_khz_whatever_the_service_does(tmp_path: Path) -> None:
    """A minute of samples that the service does not read, between states: they arrive, and the newest samples do."""
    ours, theirs = socket.socketpair()
    loop, service, n = Channel(theirs, round(UNREAD_SECONDS * 1000)), Channel(ours), 20
    nothing, batches = np.zeros(n), BatchMaker()
    for cycle in range(60_000):
        sample = Sample(cycle * 1e-3, nothing, nothing, nothing, nothing, np.zeros(n, dtype=int), nothing)
        loop.put((0, -1, pack(sample, nothing, nothing)), sample=True)
        if cycle % 100 == 99:
            loop.put(Health(Stats()), sample=True)
            loop.flush()
        if cycle in (10_000, 30_000):
            loop.put(Down("gone") if cycle == 10_000 else Up(None))
    heard = []
    while not loop.flush():
        heard += service.receive()
    heard += service.receive()
    came = [made for message in heard if (made := batches.take(message)) is not None]
    assert [type(message) for message in came if not isinstance(message, Batch)] == [Down, Up]
    assert isinstance(came[-1], Batch)
    assert came[-1].t[-1] == pytest.approx(60.0, abs=2e-3)
    assert sum(len(each.t) for each in came if isinstance(each, Batch)) < 30_000
    assert loop.dropped > 30_000


def test_through_a_fault_no_other_program_may_take_the_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    holds = []

    class Hold:
        def __init__(self, bus: object, nodes: object) -> None:
            holds.append(self)

        def release(self) -> None:
            holds.remove(self)

    monkeypatch.setattr(process, "ArmHold", Hold)
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    bench.run(0.5)
    bench.host.loop.arm.stop()
    bench.host.pump()
    assert bench.host.loop.arm is None
    assert len(holds) == 1
    bench.run(0.5)
    assert len(holds) == 1


def test_errors_of_the_bus_loop_come_back_as_what_they_are(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    with pytest.raises(BadInput, match="gain 9"):
        bench.host.controllers.write_calibration(0, Calibration(9.0, 0.0, 1))
    bench.host.close()
    with pytest.raises(BusFault):
        bench.host.controllers.read_calibration(0)


class Recorded(LockStepBus):
    """The simulated arm's bus, with every frame on it kept."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm=arm)
        self.frames: list[tuple[float, int, bytes]] = []

    def put(self, can_id: int, data: bytes) -> None:
        self.frames.append((self.arm.time, can_id, bytes(data)))
        super().put(can_id, data)

    def take(self, timeout: float = 0.0) -> tuple[int, bytes] | None:
        frame = super().take(timeout)
        if frame is not None:
            self.frames.append((self.arm.time, frame[0], bytes(frame[1])))
        return frame


class Tap(InProcessBus):
    """Another place on that bus, later: hears every frame at its time; sending is a failure."""

    channel_info = "tap"

    def __init__(self, frames: list[tuple[float, int, bytes]]) -> None:
        self.frames, self.clock, self.time = deque(frames), self, 0.0

    def now(self) -> float:
        return self.time

    def put(self, can_id: int, data: bytes) -> None:
        raise AssertionError("listening only, nothing is sent")

    def take(self, timeout: float = 0.0) -> tuple[int, bytes] | None:
        if self.frames and self.frames[0][0] <= self.time + timeout:
            self.time, can_id, data = self.frames.popleft()
            return can_id, data
        self.time += timeout
        return None

    def shutdown(self) -> None:
        pass


def test_listening_on_a_lock_step_bus_where_nobody_sends_sync_goes_on_for_ever(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    bench.host.close()
    bus = LockStepBus(arm=bench.simulated)
    loop = InlineLoop(bench.arm, lambda: bus, listen_only=True)
    messages = [message for _ in range(600) for message in loop.pump()]  # a rounding of its time held it up before
    loop.close()
    assert isinstance(messages[0], Up)
    (silent,) = (message for message in messages if isinstance(message, Down))
    assert silent.reason == f"no SYNC on {bus.channel_info}: is the program that commands the arm running?"


def test_an_arm_in_this_process_keeps_the_machines_pace_and_does_not_catch_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    bench.host.close()
    real = [1000.0]  # of the machine
    monkeypatch.setattr(time, "monotonic", lambda: real[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: real.__setitem__(0, real[0] + seconds))
    bus = LockStepBus(arm=bench.simulated)
    loop = InlineLoop(bench.arm, lambda: bus, pace=True)

    def passed() -> tuple[float, float]:
        arm, machine = bus.clock.now(), real[0]
        for _ in range(20):
            loop.pump()
        return bus.clock.now() - arm, real[0] - machine

    loop.pump()
    passed()
    assert passed() == pytest.approx((2.0, 2.0), abs=0.01)
    real[0] += 5.0  # the machine stood still
    assert passed() == pytest.approx((2.0, 2.0), abs=0.2)
    loop.close()


def test_beside_another_controller_it_hears_all_and_sends_nothing(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, settings=settings("observe"), work=False)
    bench.host.close()
    arm, bus = bench.arm, Recorded(bench.simulated)
    described = gcomp_arm(arm)
    with Link(arm, bus) as link:
        link.start()
        link.enable()
        random = np.random.default_rng(3)
        targets = work_targets(link.position_sent, described.lower, described.upper, np.ones(7), 0.004, random)
        for _ in range(1200):
            truth = link.cycle(Command.hold(next(targets)))
    loop = InlineLoop(arm, lambda: Tap(bus.frames), listen_only=True)
    service = bench.service
    service.configuration.listen_only = True
    messages = [message for _ in range(100) for message in loop.pump()]
    for message in messages:
        service.take(message)
    batches = [message for message in messages if isinstance(message, Batch)]
    assert sum(len(batch.t) for batch in batches) >= 1190
    assert isinstance(messages[0], Up)
    assert messages[0].held is None
    assert "no SYNC" in [message for message in messages if isinstance(message, Down)][-1].reason
    position = np.vstack([batch.channels["position"] for batch in batches])
    assert np.isfinite(position).all()
    assert np.abs(position - truth.position).max(axis=1).min() < 1e-3
    sent = np.vstack([batch.channels["position_command"] for batch in batches])
    assert np.abs(sent[50:-50] - position[50:-50]).max() < 0.1
    assert bench.view.status().rows >= 2
    assert bench.view.status().state is State.FAULT
    assert batches[-1].stats.load > 0.2


def test_a_sync_on_each_of_two_buses_is_one_cycle() -> None:
    arm = load_arm("sarcos")
    section = arm.require_link()
    there = {name: {"interface": "virtual", "channel": name} for name in ("upper", "lower")}
    joints = [{**each.model_dump(), "bus": "lower" if k < 3 else "upper"} for k, each in enumerate(section.joints)]
    section = type(section).model_validate({**section.model_dump(), "buses": there, "joints": joints})
    arm = arm.model_copy(update={"link": section})
    with Listener(arm, open_link_bus(None, section)) as listener:
        others = {name: can.Bus(interface="virtual", channel=name) for name in there}
        for _ in range(4):
            for name, other in others.items():
                other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                for joint in section.joints:
                    if joint.bus == name:
                        reading = can.Message(arbitration_id=0x180 + joint.node, data=bytes(8), is_extended_id=False)
                        other.send(reading)
            samples = [listener.next(0.01) for _ in range(2)]
        for other in others.values():
            other.shutdown()
    assert samples[1] is None
    assert np.isfinite(samples[0].position).all()


NO_BUS = "udp_multicast:1.2.3.4"
"""That is no group."""


def test_sigterm_to_the_whole_group_is_left_to_the_service() -> None:
    host = KeptArm(load_arm("sarcos"), NO_BUS)
    heard = until_down(host)
    os.kill(host.pid, signal.SIGTERM)
    answer: list[LoopAnswer] = []
    asking = threading.Thread(target=lambda: answer.append(host.ask(Call(1, "read_calibration", (0,)))))
    asking.start()
    end = time.monotonic() + 60.0
    while asking.is_alive() and time.monotonic() < end:
        host._channel.wait(0.1)
        host.pump()  # the process is there: this does not raise
    assert str(answer[0].error) == heard.reason
    host.close()
    assert host.exit_status == 0


def test_the_bus_process_ends_when_the_service_is_gone() -> None:
    host = KeptArm(load_arm("sarcos"), NO_BUS)
    until_down(host)
    host._channel.close()  # as the kernel does where the service is killed
    assert host._process.wait(60.0) == 0


def until_down(host: KeptArm) -> Down:
    """The first message that the bus is not there."""
    while True:
        host._channel.wait(60.0)
        for message in host.pump():
            if isinstance(message, Down):
                return message


def test_the_bus_process_of_a_daemon_that_is_gone_holds_its_state_directory(tmp_path: Path) -> None:
    """Until it has left the joints safe: a daemon that is begun meanwhile waits for that."""
    with locked_directory(tmp_path, "--state") as lock:
        host = KeptArm(load_arm("sarcos"), NO_BUS, inherits=[lock])
        until_down(host)
    with pytest.raises(BadInput, match="in use by"), locked_directory(tmp_path, "--state"):
        pass
    host.close()
    with locked_directory(tmp_path, "--state"):
        pass


def test_the_bus_process_logs_as_the_daemon_does(tmp_path: Path) -> None:
    """Its warnings are lines of JSON too, for systemd's journal."""
    program = (
        "import sys; from armlink.arm_file import load_arm; from calib.daemon.settings import Options\n"
        "host = Options('openarm', 'api.sock', bus=sys.argv[1], listen_only=True).keep(load_arm('openarm'))\n"
        "while not any(type(each).__name__ == 'Up' for each in host.pump()): host._channel.wait(60.0)\n"
        "host.close()"
    )
    command = [sys.executable, "-c", program, f"udp_multicast:239.74.171.{os.getpid() % 200 + 1}"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr.splitlines()
    assert any("there is no current calibration record" in json.loads(line)["message"] for line in said)


class TellingProgram:
    """A program that tells of every joint 50 times a second for a while, and then no more."""

    lost, time = 0, 100.0

    def __init__(self, names: tuple[str, ...], seconds: float) -> None:
        self.names, self.times = names, deque(100.0 + 0.02 * np.arange(round(50 * seconds)))

    def now(self) -> float:
        return self.time

    def sleep_until(self, instant: float) -> None:
        self.time = max(self.time, instant)

    def take(self) -> list[JointStateMessage]:
        zeros, found = [0.0] * len(self.names), []
        while self.times and self.times[0] <= self.time:
            t = float(self.times.popleft())
            found.append(JointStateMessage("driver", t, t, self.names, zeros, zeros, zeros))
        return found

    def absence(self) -> str:
        return "does the driver run?"

    def close(self) -> None: ...


def test_messages_of_another_program_are_batches_and_their_end_is_said() -> None:
    arm = load_arm("sarcos")
    source = TellingProgram(arm.joint_names, 2.0)
    bus = ListeningBus(source, "ros2:/joint_states", arm.joint_names, clock=source)
    loop = InlineLoop(arm, lambda: bus, listen_only=True)
    messages = [message for _ in range(30) for message in loop.pump()]
    loop.close()
    assert isinstance(messages[0], Up)
    assert sum(len(message.t) for message in messages if isinstance(message, Batch)) == 99  # the last is not complete
    (silent,) = (message for message in messages if isinstance(message, Down))
    assert silent.reason == "ros2:/joint_states: messages have stopped: does the driver run?"
