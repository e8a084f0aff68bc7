"""How well this machine keeps an arm's cycle while a job works beside it: `armlink check --host`. Needs no bus."""

import contextlib
import os
import pickle
import struct
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.bus.port import Frame
from armlink.channel import Channel, Closed, channel_of, start_process
from armlink.clock import Clock, MonotonicClock
from armlink.drives.base import Ask, BasicDrives, DriveMemory
from armlink.drives.family import Family
from armlink.drives.orders import Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault
from armlink.link.cycle import Commander
from armlink.link.cyclic_exchange import Loop
from armlink.link.gate import start_order
from armlink.link.gate_limits import arm_limits, gate_limits, joint_ranges
from armlink.link.joints.ask import LinkAsk
from armlink.link.joints.groups import Group
from armlink.link.joints.values import JointValues
from armlink.link.lateness import Lateness
from armlink.link.types import Command
from armlink.loop.messages import pack
from armlink.loop.realtime import Realtime, prepare

RATES = (1000.0, 800.0, 500.0, 400.0, 250.0, 200.0, 125.0, 100.0, 50.0, 25.0, 20.0, 10.0)
"""Rates that are tried on what was measured [Hz]."""
LATE_SHARE = 0.5
"""A rate is held if 99.9 % of the cycles begin within this share of its period."""


_TRAITS = Traits("current", "host", "holds", (), "reply", "11")
_VALUES, _ANSWER = struct.Struct("<ff"), 0x100
STOPPED = 0x200
"""With the joint's index, identifier by which an echoing drive says that it has stopped itself."""


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
        return next((rate for rate in RATES if late <= LATE_SHARE / rate and self.busy <= LATE_SHARE / rate), 0.0)


class EchoDrives(BasicDrives[DriveMemory]):
    """Drives of no real family, which answer each command at once, standing still: what is measured is the host."""

    def routes(self) -> dict[int, int]:
        return {base + joint: joint for joint in range(self.m) for base in (_ANSWER, STOPPED)}

    def commands(self) -> dict[int, str]:
        return {1 + joint: "command" for joint in range(self.m)}

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        self.powers = [Power.ON] * self.m
        return [Setup(0.0, 0.0, 1e-6, frozenset((Mode.POSITION, Mode.TORQUE)))] * self.m

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        return [(1 + joint, _VALUES.pack(order.position, order.torque)) for joint, order in enumerate(orders) if order]

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if can_id >= STOPPED:
            return self.note(Reading(can_id - STOPPED, power=Power.STOPPED))
        position, torque = _VALUES.unpack(data)
        return Reading(can_id - _ANSWER, position, 0.0, torque)


class EchoPort:
    """A port on which every joint answers each command at once."""

    def __init__(self, arm: ArmFile) -> None:
        """For the joints of this arm, in the middle of their ranges."""
        self.standing = np.array([(lower + upper) / 2 for lower, upper in joint_ranges(arm)])
        """(n,) [rad]."""
        self.errors = self.dropped = 0
        self._waiting: deque[Frame] = deque()

    def send(self, can_id: int, data: bytes) -> None:
        self._waiting.append((can_id - 1 + _ANSWER, data))

    def receive(self, timeout: float) -> Frame | None:
        """The next answer, None if there is none; never waits."""
        return self._waiting.popleft() if self._waiting else None


def measure_host(arm: ArmFile, seconds: float) -> HostReport:
    """Make cycles in a process of its own, with a job beside it that computes and writes as a sweep does."""
    program = "import sys; from armlink.selftest.host import main; main(int(sys.argv[1]))"
    process, channel = start_process(("-c", program))
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
        raise BusFault("check --host: the measuring process ended (see its error above): repeat the command") from None
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
    """The link's cycle for an arm whose joints are all on and answer on an EchoPort; no reading is too old."""
    section = arm.require_link()
    n, period = len(section.joints), 1.0 / section.rate
    drives = EchoDrives(section.joints, _TRAITS)
    groups = (Group(Family("echo", _TRAITS, DriveSettings, lambda arm, joints: drives), drives, tuple(range(n)), 0),)
    values = JointValues(arm, np.zeros(n, bool))
    loop = Loop(port, clock, groups, values, period, lock_step=False)
    limits = arm_limits(section, joint_ranges(arm))
    commander = Commander(loop, clock, arm.joint_names, period, np.inf, lock_step=False)
    setups = drives.set_up(LinkAsk(loop, clock, lambda done, timeout: False), limits)
    gates = [gate_limits(limit) for limit in limits]
    passed = [start_order(gate, 0.0, place) for gate, place in zip(gates, port.standing, strict=True)]
    commander.begin(gates, passed, [each.modes for each in setups], np.zeros(n))
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
        commander.stand([Power.OFF] * n)
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
    channel = channel_of(number)
    with contextlib.suppress(Closed):
        arm, seconds = channel.first()
        channel.put(cycles(arm, seconds, channel))
        while not channel.flush(1.0):
            channel.receive()
        channel.wait(5.0)  # for the job to read it
