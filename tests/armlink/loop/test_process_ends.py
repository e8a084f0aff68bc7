"""Ends of a job between processes, in real time: a pendulum that its drive would let fall, held out by a job."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "drives"))
sys.path.insert(0, str(Path(__file__).parents[2] / "sim_bus" / "drives"))
sys.path.insert(0, str(Path(__file__).parents[2] / "sim_bus"))

import serving
from ends_bench import after_each_step

from armlink.arm_file import Bus
from armlink.loop.ending import OF_A_SERVICE, OF_ITS_OWN

DRIVES = serving.drives(kd=2.0)
LINK = {"rate": 100, "deadline": 0.5, "park": {"pose": [0.0], "speed": 0.8}}
SIGNALS = (signal.SIGINT, signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
OUT = 1.2
"""Where the job holds the pendulum: most of its weight pulls [rad]."""
FASTEST = 0.8 + 1.0
"""Speed of parking, and what may come on top [rad/s]."""
CAUGHT = 4.0
"""Where this machine was so busy that the drive missed its host for link.deadline: it let go, and was caught."""
LATE = 0.05
"""Steps of the simulated arm this far apart are those of a machine that is too busy for bounds of speed [s]."""
JOB = """
import sys
import numpy as np
from armlink.arm_file import load_arm
from armlink.link.park import straight_path
from armlink.link.types import Command, Setpoints
from armlink.loop.remote_link import RemoteLink
from armlink.termination import terminate_as_interrupt
with terminate_as_interrupt(), RemoteLink(load_arm(sys.argv[1]), sys.argv[2]) as link:
    link.start()
    link.enable()
    path = straight_path(link.position_sent, np.array([float(sys.argv[3])]), np.ones(1), 0.01)
    for _ in link.play(Setpoints.follow(path)):
        pass
    print(link.pid, flush=True)
    while True:
        link.cycle(Command.hold(link.position_sent))
"""


class Pendulum:
    """The served arm, its file, and the job that holds it."""

    def __init__(self, served: serving.Served, path: Path, bus: str) -> None:
        self.served, self.path, self.bus = served, path, bus
        self.fastest, self.let_go, self.looked = 0.0, False, time.monotonic()
        self.job: subprocess.Popen[str] | None = None
        after_each_step(served.arm.plant, self._look)

    def _look(self) -> None:
        self.fastest = max(self.fastest, abs(float(self.served.arm.plant.velocity[0])))
        before, self.looked = self.looked, time.monotonic()
        fell = not self.powered and abs(float(self.served.arm.plant.position[0])) > 0.2
        self.let_go = self.let_go or fell or self.looked - before > LATE

    @property
    def powered(self) -> bool:
        return bool(self.served.drive.motor.powered)

    def hold_out(self, job: str = JOB) -> int:
        """Start the job; the process id of what makes its cycles."""
        self.job = subprocess.Popen(
            [sys.executable, "-c", job, str(self.path), self.bus, str(OUT)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert self.job.stdout is not None
        loop = int(self.job.stdout.readline())
        self.fastest, self.let_go = 0.0, False
        return loop

    def send(self, number: signal.Signals) -> None:
        """To the job's whole process group, as a terminal does."""
        assert self.job is not None
        os.killpg(self.job.pid, number)

    def require_parked(self) -> None:
        assert serving.wait_for(lambda: not self.powered, 30.0), "it still has power"
        assert abs(self.served.angle) < 0.1
        assert self.fastest < (CAUGHT if self.let_go else FASTEST)


@pytest.fixture
def pendulum(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Pendulum]:
    """By default of a Damiao drive."""
    group, family = f"239.74.172.{os.getpid() % 200 + 1}", getattr(request, "param", "damiao")
    bus = Bus(interface="udp_multicast", channel=group, fd=family == "moteus")
    with serving.served(DRIVES[family], fd=bus.fd, bus=bus, **LINK) as served:
        path = tmp_path / "pendulum.yaml"
        path.write_text(yaml.safe_dump(arm_file(family, bus)))
        pendulum = Pendulum(served, path, f"udp_multicast:{group}")
        try:
            yield pendulum
        finally:
            if pendulum.job is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pendulum.job.pid, signal.SIGKILL)
                pendulum.job.communicate()


def arm_file(family: str, bus: Bus) -> dict[str, object]:
    """The arm file of what `serving.pendulum` makes."""
    return {
        "name": "pendulum",
        "serial": "P-1",
        "kinematics": serving.KINEMATICS,
        "link": {
            "bus": {"interface": "udp_multicast", "channel": bus.channel, "fd": bus.fd},
            "joints": [{"name": "hinge", "drive": DRIVES[family], "rated_torque": 8.0, "max_torque": 10.0}],
            **LINK,
        },
    }


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("pendulum", "number"),
    [(list(DRIVES)[(first + place) % 5], number) for first in range(5) for place, number in enumerate(SIGNALS)],
    indirect=["pendulum"],
)
def test_a_signal_to_the_job_s_group_parks_the_arm(pendulum: Pendulum, number: signal.Signals) -> None:
    pendulum.hold_out()
    pendulum.send(number)
    assert pendulum.job is not None
    _, told = pendulum.job.communicate(timeout=60)
    pendulum.require_parked()
    assert number is signal.SIGKILL or "its parking pose, " in told


@pytest.mark.long
def test_a_job_that_is_stopped_holds_the_arm_and_parks_it_once_it_ends(pendulum: Pendulum) -> None:
    pendulum.hold_out()
    pendulum.send(signal.SIGSTOP)
    time.sleep(2.0)
    assert pendulum.powered
    assert abs(pendulum.served.angle - OUT) < 0.1
    assert pendulum.fastest < 1.0
    pendulum.send(signal.SIGINT)
    pendulum.send(signal.SIGCONT)
    pendulum.require_parked()


@pytest.mark.long
def test_no_signal_to_the_process_that_makes_the_cycles_ends_it(pendulum: Pendulum) -> None:
    """`systemctl kill -s USR1` reaches every process of a unit."""
    loop = pendulum.hold_out()
    for number in signal.valid_signals() - {*OF_A_SERVICE, *OF_ITS_OWN}:
        os.kill(loop, number)
    time.sleep(1.0)
    assert pendulum.powered
    assert pendulum.fastest < 0.1
    pendulum.send(signal.SIGTERM)
    pendulum.require_parked()


@pytest.mark.long
def test_a_killed_job_is_missed_where_a_process_that_it_forked_lives_on(pendulum: Pendulum) -> None:
    forked = "    import multiprocessing, time\n    fork = multiprocessing.get_context('fork')\n"
    forked += "    fork.Process(target=time.sleep, args=(60,), daemon=True).start()\n    print("
    pendulum.hold_out(JOB.replace("    print(", forked))
    assert pendulum.job is not None
    os.kill(pendulum.job.pid, signal.SIGKILL)
    pendulum.require_parked()


@pytest.mark.long
def test_a_start_that_parks_first_for_longer_than_a_hang_is_given_may_be_interrupted(pendulum: Pendulum) -> None:
    content = yaml.safe_load(pendulum.path.read_text())
    content["link"]["park"]["speed"] = 0.1
    pendulum.path.write_text(yaml.safe_dump(content))
    pendulum.hold_out(JOB.replace("    while True:", "    link.start()\n    while True:"))
    time.sleep(1.0)
    pendulum.send(signal.SIGINT)
    assert pendulum.job is not None
    _, told = pendulum.job.communicate(timeout=60)
    assert "in its parking pose, and its power is off" in told
    pendulum.require_parked()


@pytest.mark.long
def test_ctrl_c_again_and_again_while_it_parks_lets_the_arm_go(pendulum: Pendulum) -> None:
    pendulum.hold_out()
    pendulum.send(signal.SIGINT)
    assert pendulum.job is not None
    assert pendulum.job.stderr is not None
    told = next(line for line in pendulum.job.stderr if "its parking pose, " in line)
    assert "Ctrl-C" in told
    pendulum.send(signal.SIGINT)
    assert "pressing Ctrl-C again within 2 s lets the arm fall" in pendulum.job.stderr.readline()
    assert pendulum.powered
    pendulum.send(signal.SIGINT)
    assert serving.wait_for(lambda: not pendulum.powered, 10.0)
    pendulum.job.communicate(timeout=30)


@pytest.mark.long
@pytest.mark.parametrize(
    ("park_speed", "longest"),
    [(0.8, 60.0), (0.05, 120.0)],  # the second takes longer than a hang is given
)
def test_a_daemon_that_is_stopped_parks_the_arm_first(
    pendulum: Pendulum, park_speed: float, longest: float, tmp_path: Path
) -> None:
    content = yaml.safe_load(pendulum.path.read_text())
    content["link"]["park"]["speed"] = park_speed
    pendulum.path.write_text(yaml.safe_dump(content))
    pendulum.served.do(lambda: pendulum.served.arm.turn_by_hand(0, OUT))
    command = [Path(sys.executable).parent / "armlink", "daemon", pendulum.path, "--state", tmp_path / "state"]
    with (tmp_path / "log").open("w") as log, subprocess.Popen(
        [*command, "--store", tmp_path / "records.db"], stderr=log, start_new_session=True
    ) as daemon:  # fmt: skip
        assert serving.wait_for(lambda: pendulum.powered and (tmp_path / "state" / "api.sock").exists(), 60.0)
        pendulum.fastest, pendulum.let_go = 0.0, False
        os.killpg(daemon.pid, signal.SIGTERM)
        assert daemon.wait(longest) == 0
    pendulum.require_parked()
    assert "hangs" not in (tmp_path / "log").read_text()
