"""Records an arm's bus while its host runs: one row per SYNC, with commands; sends nothing."""

import math
import struct
from collections.abc import Callable, Iterator

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.can_bus import CanBus, TimedBus
from armlink.clock import Clock, MonotonicClock
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.drives.canopen.pdo import RPDO1
from armlink.drives.canopen.units import assumed_units
from armlink.link.cyclic_exchange import Loop

WAIT_SECONDS = 0.1
Row = tuple[float, dict[str, Array]]


class Recorder:
    """Iterates over rows: time since the first SYNC [s] and channels of Recording, NaN if nothing was received."""

    def __init__(self, arm: ArmFile, bus: CanBus) -> None:
        """Listen to `bus`; times are the frames' own timestamps if the bus has them, else when frames were read."""
        section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        nodes = tuple(joint.settings.node for joint in section.joints)
        self.clock: Clock = bus.clock or MonotonicClock()
        self._timed = bus if isinstance(bus, TimedBus) else None
        self._stamp: Callable[[], float] = self._timed.stamp if self._timed else self.clock.now
        self._loop = Loop(bus.open_port(), self.clock, nodes, 0, 1.0 / section.rate, bus.clock is not None)
        units = assumed_units(arm)
        self._loop.set_units(units)
        self._loop.on_other = self._take
        self._torque_unit = np.array([unit.torque for unit in units])
        self._position_unit = np.array([unit.position for unit in units])
        self._joint_of = {RPDO1.cob_base + node: joint for joint, node in enumerate(nodes)}
        self._n = len(nodes)
        self._start: float | None = None
        self._sync: float | None = None
        self._rows: list[Row] = []
        self._torque: Array = np.full(self._n, math.nan)
        self._position: Array = np.full(self._n, math.nan)
        self._forget()

    def rows(self, seconds: float) -> Iterator[Row]:
        """Rows completed within `seconds`, or in a whole log (LogBus); raises BusFault if the bus fails."""
        end = self.clock.now() + seconds
        while (remaining := end - self.clock.now()) > 0 and not (self._timed and self._timed.ended):
            self._loop.receive(min(remaining, WAIT_SECONDS))
            yield from self._rows
            self._rows.clear()

    def _take(self, can_id: int, data: bytes) -> None:
        joint = self._joint_of.get(can_id)
        if can_id == SYNC_ID:
            self._complete(self._stamp())
        elif joint is not None and len(data) == RPDO1.layout.size:
            _, self._next_torque[joint], self._next_position[joint] = struct.unpack("<Hhi", data)

    def _complete(self, now: float) -> None:
        """A SYNC completes the row of the previous one; commands received before it take effect now."""
        sample = self._loop.sample(now)
        self._loop.drop_readings()
        if self._sync is not None and self._start is not None:
            channels = {
                "position": sample.position,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "motor_torque": sample.motor_torque,
                "torque_command": self._torque,
                "position_command": self._position,
            }
            self._rows.append((self._sync - self._start, channels))
        else:
            self._start = now
        self._sync = now
        self._torque = np.asarray(self._next_torque) * self._torque_unit
        self._position = np.asarray(self._next_position) * self._position_unit
        self._forget()

    def _forget(self) -> None:
        self._next_torque: list[float] = [math.nan] * self._n
        self._next_position: list[float] = [math.nan] * self._n
