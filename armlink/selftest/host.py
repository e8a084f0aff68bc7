"""How well this machine keeps an arm's cycle while a job works beside it: `armlink check --host`. Needs no bus."""

import contextlib
import os
import pickle
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.bus.port import Frame
from armlink.clock import Clock, MonotonicClock
from armlink.drives.canopen.cia402 import Mode
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.drives.canopen.pdo import STATUS_DECIMATION, TPDO1, TPDO2, TPDO3
from armlink.drives.canopen.units import Units
from armlink.errors import BusFault
from armlink.link.cycle import Commander
from armlink.link.cyclic_exchange import Loop
from armlink.link.faults import ENABLED_BITS
from armlink.link.gate import start_from
from armlink.link.gate_limits import gate_limits, joint_ranges, target_window
from armlink.link.lateness import Lateness
from armlink.link.types import Command
from armlink.loop.channel import Channel, Closed
from armlink.loop.messages import pack
from armlink.loop.realtime import Realtime, prepare

USER_UNIT = 2 * np.pi / 2**20
RATES = (1000.0, 800.0, 500.0, 400.0, 250.0, 200.0, 125.0, 100.0, 50.0, 25.0, 20.0, 10.0)
"""Rates that are tried on what was measured [Hz]."""
HELD = 0.5
"""A rate is held if 99.9 % of the cycles begin within this share of its period."""


@dataclass(frozen=True)
class HostReport:
    """How late cycles began at the arm's rate."""

    rate: float
    """[Hz]."""
    seconds: float
    lateness: Lateness
    busy: float
    """Processor time of one cycle [s]."""
    realtime: Realtime

    @property
    def holds_hz(self) -> float:
        """Highest of RATES that this machine holds under this load; 0 if none."""
        late = self.lateness.percentile(0.999)
        return next((rate for rate in RATES if late <= HELD / rate and self.busy <= HELD / rate), 0.0)


class EchoPort:
    """A port on which every joint answers each SYNC at once, standing still and enabled."""

    def __init__(self, arm: ArmFile) -> None:
        """For the joints of this arm, in the middle of their ranges."""
        self.standing = np.array([(lower + upper) / 2 for lower, upper in joint_ranges(arm)])
        """(n,) [rad]."""
        nodes = range(1, len(self.standing) + 1)
        self.errors = self.dropped = 0
        self.nodes, self._syncs = tuple(nodes), 0
        self._waiting: deque[Frame] = deque()
        status = ENABLED_BITS
        self._shown = [(TPDO3.cob_base + node, TPDO3.layout.pack(status, Mode.POSITION)) for node in nodes]
        wire = np.round(self.standing / USER_UNIT).astype(int).tolist()
        self._read = [
            (TPDO1.cob_base + node, TPDO1.layout.pack(place, 0)) for node, place in zip(nodes, wire, strict=True)
        ]
        self._slow = [(TPDO2.cob_base + node, TPDO2.layout.pack(status, 0, 0)) for node in nodes]

    def send(self, can_id: int, data: bytes) -> None:
        """Take one frame."""
        if can_id != SYNC_ID:
            return
        self._waiting.extend(self._read)
        if self._syncs % STATUS_DECIMATION == 0:
            self._waiting.extend(self._shown if self._syncs == 0 else self._slow)
        self._syncs += 1

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Take the frames of a cycle."""
        for can_id, data in frames:
            self.send(can_id, data)

    def receive(self, timeout: float) -> Frame | None:
        """The next answer, None if there is none; never waits."""
        return self._waiting.popleft() if self._waiting else None


def measure_host(arm: ArmFile, seconds: float) -> HostReport:
    """Make cycles in a process of its own, with a job beside it that computes and writes as a sweep does."""
    ours, theirs = socket.socketpair()
    program = "import sys; from armlink.selftest.host import main; main(int(sys.argv[1]))"
    command = [sys.executable, "-c", program, str(theirs.fileno())]
    process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
    theirs.close()
    channel = Channel(ours)
    channel.put((arm, seconds))
    channel.flush(5.0)
    try:
        with tempfile.TemporaryFile() as file:
            random = np.random.default_rng(0)
            while True:
                for message in channel.receive():
                    if isinstance(message, HostReport):
                        return message
                _work(random, file.fileno())
    except Closed:
        raise BusFault("check --host: the process that measures has ended") from None
    finally:
        process.kill()
        process.wait()
        channel.close()


def _work(random: np.random.Generator, file: int) -> None:
    """Some 20 ms of what a sweep does: a fit, a line on disk, a pause."""
    matrix = random.standard_normal((300, 40))
    solution = np.linalg.lstsq(matrix, matrix[:, 0], rcond=None)[0]
    os.write(file, pickle.dumps(solution) * 20)
    os.fsync(file)
    time.sleep(0.005)


def echo_commander(arm: ArmFile, port: EchoPort, clock: Clock) -> Commander:
    """The link's cycle for an arm whose joints are all enabled and answer on an EchoPort; no reading is too old."""
    section = arm.require_link()
    n, period = len(section.joints), 1.0 / section.rate
    loop = Loop(port, clock, port.nodes, 127, period, lock_step=False)
    units = [Units(joint.rated_torque * 1e-3, USER_UNIT, USER_UNIT) for joint in section.joints]
    loop.set_units(tuple(units))
    windows = [target_window(*limits) for limits in joint_ranges(arm)]
    limits = [
        gate_limits(joint, window, unit, period, section.deadline)
        for joint, window, unit in zip(section.joints, windows, units, strict=True)
    ]
    names = tuple(joint.name for joint in section.joints)
    commander = Commander(loop, clock, names, period, np.inf, lock_step=False)
    commander.begin(
        limits, [start_from(limit, 0.0, place) for limit, place in zip(limits, port.standing, strict=True)], [0] * n
    )
    loop.statuses[:], loop.displays[:] = [ENABLED_BITS] * n, [int(Mode.POSITION)] * n
    return commander


def cycles(arm: ArmFile, seconds: float, channel: Channel) -> HostReport:
    """The link's cycle on an EchoPort, each sample sent to the job."""
    rate, n = arm.require_link().rate, len(arm.joint_names)
    clock, realtime = MonotonicClock(), prepare()
    port = EchoPort(arm)
    commander = echo_commander(arm, port, clock)
    hold, nothing = Command.hold(port.standing), np.zeros(n)
    count, begin, busy = 0, clock.now(), time.process_time()
    for _ in range(3):  # every joint has answered, and memory is warm
        commander.stand([0] * n)
    stats = commander.loop.stats
    stats.lateness = Lateness()
    while clock.now() - begin < seconds:
        sample = commander.command(hold)
        channel.put((0, count, pack(sample, nothing, nothing)), True)
        channel.flush()
        channel.receive()
        count += 1
    busy = (time.process_time() - busy) / max(count, 1)
    return HostReport(rate, seconds, stats.lateness, busy, realtime)


def main(number: int) -> None:
    """Measure for the job at the other end of socket `number`."""
    channel = Channel(socket.socket(fileno=number))
    with contextlib.suppress(Closed):
        channel.wait(5.0)
        ((arm, seconds),) = channel.receive()
        channel.put(cycles(arm, seconds, channel))
        while not channel.flush(1.0):
            channel.receive()
        channel.wait(5.0)  # for the job to read it
