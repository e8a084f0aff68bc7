"""The process that keeps the cycle, in real time: job, loop or arm stand still or are killed."""

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from armlink.arm_file import ArmFile, load_arm
from armlink.bus.open import open_link_bus
from armlink.drives.canopen.cia402 import DriveState, state_of
from armlink.drives.canopen.object_dictionary import STATUS_WORD as STATUS
from armlink.errors import BusFault, HostLate, Silence
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.link.reading_bounds import Crossed, ReadingBounds
from armlink.link.types import Command, Sample, Setpoints
from armlink.loop.remote_link import RemoteLink

ARMLINK = Path(sys.executable).parent / "armlink"
SHARED = os.getpid() % 100 + 1
OWN = SHARED + 100
"""Multicast groups of this process: of the arm that most tests share, and of those that have one of their own."""
PATIENCE = 300.0
"""A simulated arm is given this time to begin on a busy machine [s]."""
CONTENT = {
    "name": "pair",
    "kinematics": {
        "gravity": [9.81, 0.0, 0.0],
        "joints": [
            {"name": "j1", "a": 0.0, "alpha": -1.5707963, "d": 0.0, "lower": -1.6, "upper": 1.6},
            {"name": "j2", "a": 0.3, "alpha": 0.0, "d": 0.0, "lower": -1.7, "upper": 1.7},
        ],
    },
    "link": {
        "rate": 100,
        "deadline": 0.5,
        "joints": [
            {"name": "j1", "node": 1, "rated_torque": 40.0, "max_torque": 40.0},
            {"name": "j2", "node": 2, "rated_torque": 20.0, "max_torque": 20.0},
        ],
    },
    "sim": {
        "links": [
            {"mass": 3.0, "com": [0.05, 0.02, 0.1], "inertia": [0.03, 0.03, 0.03]},
            {"mass": 2.0, "com": [0.2, 0.03, 0.0], "inertia": [0.02, 0.02, 0.02]},
        ],
        "sensors": {"noise": [0.0, 0.0], "bits": 20},
    },
}


@contextlib.contextmanager
def simulated(tmp_path: Path, group: int) -> Iterator[tuple[ArmFile, str, subprocess.Popen[bytes]]]:
    """A two-joint arm in real time in a process of its own."""
    path, pipe = tmp_path / "pair.yaml", tmp_path / "arm.pipe"
    path.write_text(yaml.safe_dump(CONTENT))
    bus = f"udp_multicast:239.74.171.{group}"
    arm = subprocess.Popen([ARMLINK, "sim", path, "--bus", bus, "--control", pipe], stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + PATIENCE
        while not pipe.exists():
            assert time.monotonic() < end
            assert arm.poll() is None, "the simulated arm has ended"
            time.sleep(0.05)
        yield load_arm(str(path)), bus, arm
    finally:
        arm.send_signal(signal.SIGCONT)
        arm.terminate()
        arm.wait(20)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RemoteLink, subprocess.Popen[bytes]]]:
    """An arm behind a loop process, and the arm's own process, for the whole file."""
    with simulated(tmp_path_factory.mktemp("pair"), SHARED) as (arm, bus, process), RemoteLink(arm, bus) as link:
        link.start()
        link.enable()
        yield link, process


@pytest.fixture
def started(running: tuple[RemoteLink, subprocess.Popen[bytes]]) -> tuple[RemoteLink, subprocess.Popen[bytes]]:
    """The same, enabled and standing where it was at first, whatever the test before has done to it."""
    link, _ = running
    here = link.recover().position
    for _ in link.play(Setpoints.follow(np.linspace(here, np.zeros(2), 100))):
        pass
    link.catch_up()
    return running


def rows(link: RemoteLink, seconds: float, way: float) -> np.ndarray:
    """Targets (K, n) that move joint 2 by `way` [rad] from where it is."""
    count = int(seconds * link.rate)
    return link.position_sent + np.linspace(0, way, count)[:, None] * np.array([0.0, 1.0])


def cycles(link: RemoteLink, command: Command) -> None:
    """Five seconds of a command."""
    for _ in range(500):
        link.cycle(command)


def test_a_job_that_stands_still_costs_no_cycle(started: tuple[RemoteLink, subprocess.Popen[bytes]]) -> None:
    link, _ = started
    targets = rows(link, 2.0, 0.3)
    samples = []
    for sample in link.play(Setpoints.follow(targets)):
        if len(samples) == 10:
            time.sleep(1.2)  # more than two deadlines
        samples.append(sample)
    assert len(samples) == len(targets)
    assert np.abs(samples[-1].position - targets[-1]).max() < 0.05
    gaps = np.diff([sample.t for sample in samples])
    assert gaps.max() < 0.5, "the motion went on meanwhile"
    link.catch_up()
    assert link.cycle(Command.hold(targets[-1])).t > samples[-1].t


def test_what_is_left_of_a_motion_is_not_played_after_it_was_closed(
    started: tuple[RemoteLink, subprocess.Popen[bytes]],
) -> None:
    link, _ = started
    targets = rows(link, 2.0, 0.5)
    playing = link.play(Setpoints.follow(targets))
    for _ in range(20):
        next(playing)
    playing.close()
    time.sleep(0.3)
    link.catch_up()
    stopped = link.cycle(Command.hold(link.position_sent)).position
    time.sleep(0.3)
    link.catch_up()
    assert abs(link.cycle(Command.hold(link.position_sent)).position[1] - stopped[1]) < 0.01
    assert stopped[1] < targets[-1, 1] - 0.1


def test_a_bound_is_kept_while_the_job_is_busy(started: tuple[RemoteLink, subprocess.Popen[bytes]]) -> None:
    link, _ = started
    targets = rows(link, 1.0, 0.4)
    upper = np.array([np.inf, targets[0, 1] + 0.2])
    guard = ReadingBounds(np.full(2, -np.inf), upper, np.full(2, np.inf))
    playing = link.play(Setpoints.follow(targets, guard))
    next(playing)
    time.sleep(1.5)
    with pytest.raises(Crossed, match="j2") as crossed:
        for _ in playing:
            pass
    assert crossed.value.bound == "range"
    assert crossed.value.sample.position[1] > upper[1]
    link.catch_up()
    assert link.cycle(Command.hold(link.position_sent)).position[1] < upper[1] + 0.05, "it held where it stood"


def test_a_controller_runs_beside_the_job(started: tuple[RemoteLink, subprocess.Popen[bytes]]) -> None:
    link, _ = started
    here = link.position_sent.copy()
    running = link.run(_Creeping(here))
    first = next(running)
    time.sleep(0.5)
    moved = (sample.position[1] - first.position[1] for sample in itertools.islice(running, 1000))
    assert any(way > 0.02 for way in moved)  # within 60 cycles, unless the machine keeps the simulated arm waiting
    running.close()


class _Creeping:
    """Moves joint 2 on by 1 mrad a cycle."""

    def __init__(self, position: np.ndarray) -> None:
        self.position = position

    def command(self, sample: Sample) -> Command:
        self.position = self.position + np.array([0.0, 0.001])
        return Command.hold(self.position)


def test_a_loop_that_stands_still_says_that_the_host_was_late(
    started: tuple[RemoteLink, subprocess.Popen[bytes]],
) -> None:
    link, _ = started
    hold = Command.hold(link.position_sent)
    for _ in range(20):
        link.cycle(hold)
    os.kill(link.pid, signal.SIGSTOP)
    time.sleep(2.0)
    os.kill(link.pid, signal.SIGCONT)
    with pytest.raises(HostLate, match=r"the host was \d+ ms late \(limit 500 ms\)") as late:
        cycles(link, hold)
    assert 1.0 < late.value.late < 10.0
    sample = link.recover()
    assert all(state_of(int(status)) is DriveState.ENABLED for status in sample.status)
    assert np.isfinite(link.cycle(Command.hold(link.position_sent)).position).all()


@pytest.mark.long
def test_an_arm_that_stands_still_is_not_called_broken(
    started: tuple[RemoteLink, subprocess.Popen[bytes]],
) -> None:
    link, arm = started
    hold = Command.hold(link.position_sent)
    arm.send_signal(signal.SIGSTOP)
    with pytest.raises(Silence, match="no joint has sent a reading for"):
        cycles(link, hold)
    threading.Timer(1.0, arm.send_signal, (signal.SIGCONT,)).start()
    link.recover()  # waits for it, and takes no reply of before it was stopped for an enabled joint
    for _ in range(50):
        sample = link.cycle(Command.hold(link.position_sent))
    assert all(state_of(int(status)) is DriveState.ENABLED for status in sample.status)


@pytest.mark.sample(1)
@pytest.mark.parametrize("who", ["job", "loop"])
def test_the_joints_stop_when_job_or_loop_is_killed(tmp_path: Path, who: str) -> None:
    with simulated(tmp_path, OWN) as (arm, bus, _):
        job = subprocess.Popen(
            [sys.executable, "-c", JOB, str(arm.path), bus],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert job.stdout is not None
        loop = int(job.stdout.readline())
        os.kill(job.pid if who == "job" else loop, signal.SIGKILL)
        time.sleep(2.5)
        job.kill()
        job.wait()
        end = time.monotonic() + 10
        while Path(f"/proc/{loop}").exists():
            assert time.monotonic() < end, "the loop goes on without its job"
            time.sleep(0.05)
        with Listener(arm, open_link_bus(bus, arm.require_link())) as listener:
            joints = listener.groups[0].drives.services(listener.ask)
            states = [state_of(int(services.read(STATUS))) for services in joints]
    assert all(state is not DriveState.ENABLED for state in states), states


def dawdle(link: Link, tell: Callable[[str], None], seconds: float) -> int:
    """Enable the arm and hold it for so long, and say so."""
    link.start()
    link.enable()
    hold = Command.hold(link.position_sent)
    for _ in range(round(seconds * link.rate)):
        link.cycle(hold)
        tell("holding")
    return os.getpid()


@pytest.mark.long
def test_a_function_runs_in_the_loop_until_it_ends_or_ctrl_c(tmp_path: Path) -> None:
    def interrupt(text: str) -> None:
        raise KeyboardInterrupt

    told: list[str] = []
    with simulated(tmp_path, OWN) as (arm, bus, _):
        with RemoteLink(arm, bus) as link:
            assert link.inside(dawdle, told.append, 0.2) == link.pid
            assert told == ["holding"] * 20
            link.stop()
            with pytest.raises(KeyboardInterrupt):
                link.inside(dawdle, interrupt, 60.0)
        assert link.exit_status == 0, "it was killed"
        with Listener(arm, open_link_bus(bus, arm.require_link())) as listener:
            joints = listener.groups[0].drives.services(listener.ask)
            states = [state_of(int(services.read(STATUS))) for services in joints]
    assert all(state is DriveState.QUICK_STOP for state in states), states


def test_sigterm_to_the_loop_is_left_to_the_job(started: tuple[RemoteLink, subprocess.Popen[bytes]]) -> None:
    link, _ = started
    os.kill(link.pid, signal.SIGTERM)
    hold = Command.hold(link.position_sent)
    for _ in range(20):
        link.cycle(hold)


JOB = """
import sys, time
from armlink.arm_file import load_arm
from armlink.loop.remote_link import RemoteLink
with RemoteLink(load_arm(sys.argv[1]), sys.argv[2]) as link:
    link.start()
    link.enable()
    print(link.pid, flush=True)
    time.sleep(60)
"""


def test_a_bus_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "pair.yaml"
    path.write_text(yaml.safe_dump(CONTENT))
    with pytest.raises(BusFault, match="socketcan:can77"):
        RemoteLink(load_arm(str(path)), "socketcan:can77")
