"""Listening to an arm that another controller commands: one sample a SYNC of that controller; nothing is sent.

On SocketCAN and udp_multicast it sleeps for several cycles and then takes all that came, each SYNC with the kernel's
own time of it; on other buses it wakes for each frame, whose time is when it was read.

The one exception is asked for by name: `write_calibration` and `read_calibration` use SDO on object 2100h.
"""

import struct
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.adapters import as_bus
from armlink.bus.can_bus import CanBus
from armlink.bus.port import StampedPort
from armlink.clock import Clock, MonotonicClock
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.pdo import RPDO1
from armlink.drives.canopen.units import assumed_units
from armlink.link.cyclic_exchange import Loop
from armlink.link.torque_sensor_record import TorqueSensorRecords
from armlink.link.types import Sample, Stats

if TYPE_CHECKING:
    import can

SLEEP = 0.04
"""Frames with a time stamp may wait for this long [s]: ten cycles at 250 Hz, half of what a small receive queue holds
of a full bus."""
COMMAND = "Hhi"
"""RPDO1: control word, target torque, target position."""
NO_COMMAND = bytes(8)
"""Stands for the RPDO1 that has not come yet; this object, not its value."""


class Listener(TorqueSensorRecords):
    """Context manager: `with Listener(arm, bus) as listener: sample = listener.next(0.1)`."""

    def __init__(self, arm: ArmFile, bus: "CanBus | can.BusABC") -> None:
        """Take `bus` (python-can's too, closed on leaving); its own clock counts if it has one, else the machine's."""
        self.arm, self.bus = arm, as_bus(bus)
        self.section = section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.nodes = tuple(joint.settings.node for joint in section.joints)
        self.n, self.period = len(self.names), 1.0 / section.rate
        self.clock: Clock = self.bus.clock or MonotonicClock()
        self._port = self.bus.open_listening_port()
        self._loop = Loop(self._port, self.clock, self.nodes, 0, self.period, self.bus.clock is not None)
        units = assumed_units(arm)
        self._loop.set_units(units)
        self._torque_unit = np.array([unit.torque for unit in units])
        self._position_unit = np.array([unit.position for unit in units])
        self._commands = {RPDO1.cob_base + node: NO_COMMAND for node in self.nodes}
        self._layout = struct.Struct("<" + self.n * COMMAND)
        self._ready: deque[tuple[Sample, tuple[bytes, ...]]] = deque()
        self._sent = self._given = (NO_COMMAND,) * self.n
        """RPDO1 of each joint: for the sample that `next` gave last, and for the one that is coming in."""
        self._sync: float | None = None
        self._since: float | None = None

    def __enter__(self) -> Self:
        """The listener itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Close the bus."""
        self.bus.shutdown()

    @property
    def stats(self) -> Stats:
        """Counters since the first SYNC heard, rate and load brought up to date; `late` stays 0."""
        if self._since is not None:
            self._loop.measure(self.clock.now() - self._since, self.section.bus.bitrate)
        return self._loop.stats

    @property
    def emergencies(self) -> deque[tuple[int, int, int]]:
        """(Joint, code, error register) of every emergency heard; the caller may clear it."""
        return self._loop.emergencies

    @property
    def node_states(self) -> dict[int, int]:
        """Joint → NMT state of its newest heartbeat, 0 for boot-up; the caller may clear it."""
        return self._loop.node_states

    @property
    def torque_sent(self) -> Array:
        """Target torque of the other controller for the last sample of `next` [N·m], (n,); NaN before its first."""
        return self._decoded(1, self._torque_unit)

    @property
    def position_sent(self) -> Array:
        """Likewise target position [rad]."""
        return self._decoded(2, self._position_unit)

    def _decoded(self, place: int, unit: Array) -> Array:
        values: Array = np.array(self._layout.unpack(b"".join(self._sent))[place::3]) * unit
        for joint, data in enumerate(self._sent):
            if data is NO_COMMAND:
                values[joint] = np.nan
        return values

    def next(self, timeout: float) -> Sample | None:
        """The next complete sample, or None where no SYNC completes one within `timeout` [s]; raises BusFault.

        A sample is complete when the SYNC after it comes; its time is that of its own SYNC, by `clock`.
        """
        if not self._ready:
            end = self.clock.now() + timeout
            while not self._ready:
                remaining = end - self.clock.now()
                if remaining <= 0:
                    return None
                self._hear(remaining)
        sample, self._sent = self._ready.popleft()
        return sample

    def _hear(self, seconds: float, at_once: bool = False) -> None:
        """Take in what comes, for at most that long; `at_once`: somebody waits for the very next frame."""
        port = self._port
        if isinstance(port, StampedPort):
            if at_once:
                port.wait(seconds)
            else:
                self.clock.sleep_until(self.clock.now() + min(seconds, SLEEP))
            frames = port.take_all()
        else:
            frame = port.receive(seconds)
            frames = [] if frame is None else [(self.clock.now(), *frame)]
        self._loop.count(len(frames), sum([len(data) for _, _, data in frames]))
        commands, take = self._commands, self._loop.take
        for t, can_id, data in frames:
            if can_id in commands:
                if len(data) == len(NO_COMMAND):
                    commands[can_id] = data
            elif can_id == objects.SYNC_ID:
                self._complete(t)
            else:
                take(can_id, data)

    def _complete(self, now: float) -> None:
        """A SYNC: what came since the one before is its sample."""
        if self._sync is None or self._since is None:
            self._loop.reset_counters()
            self._loop.drop_readings()
            self._since = now
        else:
            sample = self._loop.sample(self._sync)
            sample.t = self._sync
            self._loop.stats.missed += sum([value != value for value in sample.position.tolist()])  # NaN
            self._loop.drop_readings()
            self._ready.append((sample, self._given))
        self._sync, self._given = now, tuple(self._commands.values())

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """Go on listening until `done` or the time is over."""
        end = self.clock.now() + timeout
        while not done():
            remaining = end - self.clock.now()
            if remaining <= 0:
                return False
            self._hear(remaining, at_once=True)
        return True
