"""The fault table on real SocketCAN: the arm in its own process, faults by its pipe, the interface by `ip link`."""

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from patient_start import start
from processes import SAFE, Ear, simulated, start_host, write_arm
from rows import QUICK_STOP, ROWS, Row
from test_lock_step import pattern

from armlink.arm_file import load_arm
from armlink.drives.canopen.cia402 import DriveState
from armlink.errors import ArmlinkError, BusFault
from armlink.link.link import Link
from armlink.link.types import Command

pytestmark = pytest.mark.vcan

BUS = "socketcan:vcan0"
RATE, DEADLINE = 10.0, 1.0
"""Slow enough for one core of a user-mode kernel that runs everything."""
BY_KEY = {row.key: row for row in ROWS}
PIPED = [row for row in ROWS if ":" in row.inject and not row.vcan and row.key != "link down"]


class Bench:
    """The simulated arm's process, its pipe and an ear; hosts come and go."""

    def __init__(self, arm: Path, pipe: Path) -> None:
        self.path, self.pipe, self.ear = arm, pipe, Ear(BUS)

    def order(self, line: str) -> None:
        self.pipe.write_text(f"{line}\n")

    def inject(self, row: Row) -> None:
        """As the table says, but what floods the bus at a rate that a user-mode kernel can carry."""
        self.order(f"fault {row.inject.replace(':20000', ':700').replace(':1000', ':200')}")


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("arm"), RATE, DEADLINE)


@pytest.fixture(scope="module")
def running(arm_file: Path) -> Iterator[Bench]:
    if not Path("/sys/class/net/vcan0").exists():  # before the mark's own skip, since this fixture is the module's
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")
    pipe = arm_file.with_name("arm.pipe")
    with simulated(arm_file, BUS, "--control", str(pipe)):
        yield Bench(arm_file, pipe)


@pytest.fixture
def bench(running: Bench) -> Iterator[Bench]:
    running.ear.forget()
    yield running
    running.order("faults none")
    time.sleep(0.1)  # the arm's process takes the order while this one does nothing


def until_fault(link: Link, command: Command, most: int = 60) -> ArmlinkError:
    for _ in range(most):
        try:
            link.cycle(command)
        except ArmlinkError as error:
            return error
    raise AssertionError(f"no fault in {most} cycles")


def enabled(link: Link) -> Command:
    start(link, late=BusFault)
    command = Command.hold(np.array(link.enable().position))
    command.mode[0], command.torque[0] = 10, 2.0
    for _ in range(10):
        link.cycle(command)
    return command


@pytest.mark.sample(1)
@pytest.mark.parametrize("row", [row for row in PIPED if row.cycles is not None], ids=lambda row: row.key)
def test_a_fault_is_seen_and_leaves_every_joint_safe(row: Row, bench: Bench) -> None:
    with Link.open(load_arm(str(bench.path)), BUS) as link:
        command = enabled(link)
        bench.inject(row)
        if row.key == "mode refused":
            time.sleep(0.1)
            command.mode[1] = 10
        error = until_fault(link, command)
    assert isinstance(error, BusFault)
    assert re.match(pattern(row.reads), str(error)), str(error)
    bench.order("faults none")  # what is cut off, or babbles, is heard again
    assert bench.ear.see(SAFE)


@pytest.mark.long
@pytest.mark.parametrize("key", ["SDO abort", "SDO time-out"])
def test_a_node_without_sdo_is_named_and_nothing_is_powered(key: str, bench: Bench) -> None:
    bench.inject(BY_KEY[key])
    time.sleep(0.1)
    with Link.open(load_arm(str(bench.path)), BUS) as link, pytest.raises(BusFault, match=pattern(BY_KEY[key].reads)):
        link.start()
    assert DriveState.ENABLED not in bench.ear.states.values()


def test_an_interface_that_goes_down_is_named_and_works_again_when_it_is_up(bench: Bench) -> None:
    ip = shutil.which("ip")
    if ip is None or os.geteuid() != 0:
        pytest.skip("only root may set an interface down, with ip of iproute2")
    with Link.open(load_arm(str(bench.path)), BUS) as link:
        command = enabled(link)
        subprocess.run([ip, "link", "set", "vcan0", "down"], check=True)
        try:
            error = until_fault(link, command)
        finally:
            subprocess.run([ip, "link", "set", "vcan0", "up"], check=True)
    assert re.match(r"bus .*: cannot (send|receive): Network is down", str(error)), str(error)
    assert bench.ear.see(SAFE)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_host_that_is_killed_or_stopped_leaves_every_joint_safe(number: int, bench: Bench) -> None:
    host = start_host(bench.path, BUS)
    try:
        assert host.stdout is not None
        assert host.stdout.readline() == "pushing\n"
        host.send_signal(number)
        assert bench.ear.see(SAFE)
        assert set(bench.ear.states.values()) == {DriveState.QUICK_STOP}
        if number == signal.SIGSTOP:
            host.send_signal(signal.SIGCONT)
            assert re.match(r"the host was \d+ ms late \(limit 1000 ms\)", host.stdout.readline())
            assert host.wait(30) == 3
    finally:
        host.kill()
        host.wait()


def test_rows_that_are_not_seen_here_say_why() -> None:
    seen = {row.key for row in PIPED} | {"link down", "host stopped", "host killed"}
    assert all(row.vcan or row.key in seen for row in ROWS)
    assert BY_KEY["host killed"].joints == QUICK_STOP
