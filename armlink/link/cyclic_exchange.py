"""The cyclic path: RPDOs, SYNC, TPDOs decoded through a compiled table. One loop owns the port."""

import math
import struct
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.bus.frame_bits import FIXED_BITS
from armlink.bus.port import Port
from armlink.clock import Clock
from armlink.drives.canopen import emcy
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.host_frames import HostFrames
from armlink.drives.canopen.pdo import RPDO1, RPDO2, TPDO1, TPDO2, decoding_table
from armlink.drives.canopen.units import TORQUE_PER_MICRO, Units
from armlink.errors import HostLate
from armlink.link.bus_watchdog import MOST_FRAMES, BusWatch
from armlink.link.types import Sample, Stats

COLLECT_SHARE = 0.8
"""Share of a period after SYNC in which TPDOs of this cycle are waited for."""

OWED_CYCLES = 25
"""A reply that has been owed for this many cycles is lost."""
NO_STATUS = 0xFFFF
"""Stands for the status word of a joint that has sent none; no state of CiA 402."""
NO_MODE = 0
"""Stands for the mode display of a joint that has sent none: no mode is active."""
EMERGENCIES_KEPT = 64
"""So many emergencies are kept; a storm of them costs no memory."""
_SYNC = (objects.SYNC_ID, b"")
_OPERATIONAL = bytes([objects.OPERATIONAL])


class Loop:
    """Frames of one cycle out and in, for n joints; knows no states, no limits and no faults, only keeps them."""

    def __init__(
        self, port: Port, clock: Clock, nodes: tuple[int, ...], host: int, period: float, lock_step: bool
    ) -> None:
        self.nodes, self.n = nodes, len(nodes)
        self.period = period
        self.beat_every = 0.0
        """Time from one heartbeat of the host to the next [s]; 0 is one in every cycle."""
        self.stats = Stats()
        self.emergencies: deque[tuple[int, int, int]] = deque(maxlen=EMERGENCIES_KEPT)
        """(joint index, code, error register) in the order of arrival, the newest; resets (code 0) are not kept."""
        self.node_states: dict[int, int] = {}
        """Joint index → NMT state of its newest heartbeat; only those received while cycling."""
        self.watch = BusWatch(len(nodes), HostFrames(nodes, host))
        self.withheld: frozenset[int] = frozenset()
        """Joints that get no RPDO1, so that their own deadline is put to the test."""
        self.beating = True
        """Whether the host's heartbeat is sent; not, so that the joints' watching it is put to the test."""
        self.on_other: Callable[[int, bytes], None] = lambda can_id, data: None
        """Takes frames that are no process data: SDO responses."""
        self._port, self._clock = port, clock
        self._patience = 0.0 if lock_step else COLLECT_SHARE * period
        self._table = {
            can_id: (joint, {TPDO1: 0, TPDO2: 1}.get(pdo, 2), layout.unpack, layout.size)
            for can_id, (joint, pdo, layout) in decoding_table(nodes).items()
        }
        self._joint_of = {node: joint for joint, node in enumerate(nodes)}
        self._command = RPDO1.layout.pack
        self._command_ids = tuple(RPDO1.cob_base + node for node in nodes)
        self._heartbeat_id = objects.HEARTBEAT_ID + host
        self._beat = -math.inf
        self._position: list[float] = [math.nan] * self.n
        self._torque: list[float] = [math.nan] * self.n
        self._motor: list[float] = [math.nan] * self.n
        self._velocity: list[float] = [math.nan] * self.n
        self.statuses: list[int] = [NO_STATUS] * self.n
        """Newest status word (6041h) of each joint."""
        self.displays: list[int] = [NO_MODE] * self.n
        """Newest mode of operation display (6061h) of each joint."""
        self._awaited = self._counted = self._dropped = 0
        self._came = [0] * self.n
        """Readings of each joint that came, in their cycle or late."""
        self.bits = 0
        """Bits that the frames so far took on the wire, without stuff bits (bus_load.frame_bits has them)."""
        self._slow_came = False
        self._nothing = np.full(self.n, math.nan)
        self.seen = [-math.inf] * self.n
        """When position and torque of each joint last came, by the clock [s]."""
        self._first: float | None = None
        self.latest_position = [math.nan] * self.n
        """Newest position of each joint whenever it came [rad]; for the gate, never for a sample."""
        self.latest_motor_torque = [math.nan] * self.n
        """Newest torque actual value of each joint whenever it came [N·m]; for the gate, never for a sample."""
        self.latest_velocity = [math.nan] * self.n
        """Newest velocity of each joint whenever it came [rad/s]; for the gate, never for a sample."""
        self.slow_seen = [-math.inf] * self.n
        """When motor torque and velocity of each joint last came, by the clock [s]."""
        self.synced = -math.inf
        """When the last SYNC left, by the clock [s]."""
        self._owed = [0] * self.n
        """Replies of each joint to earlier SYNCs that are still to come, or lost."""
        self._owed_for = 0
        """Cycles for which some reply has been owed."""
        self.set_units((Units(1.0, 1.0, 1.0),) * self.n)

    def reset_counters(self) -> None:
        """Restart the counters."""
        self.stats, self.bits, self._first, self._counted = Stats(), 0, None, 0
        self._came = [0] * self.n
        self._dropped = self._port.dropped

    @property
    def dropped(self) -> int:
        """Frames that this host lost because it read too slowly, since the counters began."""
        return self._port.dropped - self._dropped

    def set_units(self, units: tuple[Units, ...]) -> None:
        """Scales of the joints."""
        self._torque_unit = np.array([unit.torque for unit in units])
        self._position_unit = np.array([unit.position for unit in units])
        self._position_scale = [unit.position for unit in units]

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame and count it."""
        self._port.send(can_id, data)
        self.count(1, len(data))

    def send_mode(self, joint: int, mode: int) -> None:
        """RPDO2: the mode of one joint."""
        self.send(RPDO2.cob_base + self.nodes[joint], struct.pack("<b", mode))

    def receive(self, timeout: float) -> bool:
        """Take one frame in, waiting for it at most `timeout` seconds; False where none came."""
        frame = self._port.receive(timeout)
        if frame is None:
            return False
        self.stats.frames += 1
        self.bits += FIXED_BITS + 8 * len(frame[1])
        self.take(*frame)
        return True

    def drain(self) -> None:
        """Take in all that came between cycles; readings among it are late: newest known, but of no sample."""
        self._awaited = 0
        self._take_what_is_there()
        self._keep_late()
        self.watch.cycle_ends(self.stats.frames - self._counted)
        self._counted = self.stats.frames
        if self._slow_came:
            self._keep_slow(self._clock.now())
        self.drop_readings()

    def _take_what_is_there(self) -> None:
        for _ in range(MOST_FRAMES):
            if not self.receive(0.0):
                return
        self.watch.flooded = True

    def drop_readings(self) -> None:
        """Forget position and torque that came: what comes from now on belongs to the next sample."""
        self._position, self._torque = [math.nan] * self.n, [math.nan] * self.n

    def _keep_late(self) -> None:
        """Readings that came after their cycle: as old as the last SYNC at least."""
        for joint, raw in enumerate(self._position):
            if raw == raw:  # not NaN
                self.latest_position[joint] = raw * self._position_scale[joint]
                self.seen[joint] = max(self.seen[joint], self.synced)
                self._owed[joint] = max(self._owed[joint] - 1, 0)

    def settle(self) -> None:
        """After an interruption: nothing is owed, nothing was lost, no node is crowding the bus."""
        self.drain()
        self.synced = -math.inf
        self._owed, self._owed_for = [0] * self.n, 0
        self._dropped = self._port.dropped
        self.watch.settle()

    def beat(self) -> None:
        """The host's heartbeat, at once."""
        self.send(self._heartbeat_id, _OPERATIONAL)
        self._beat = self._clock.now()

    def exchange(
        self,
        control: list[int],
        torque_wire: list[int],
        position_wire: list[int],
        decided: float = math.inf,
        max_age: float = math.inf,
    ) -> Sample:
        """One cycle: RPDO1 of every joint, heartbeat when due, SYNC, then the TPDOs that it brings.

        Raises HostLate, and sends nothing, if the frames would leave more than `max_age` [s] after `decided` (clock).
        """
        command = self._command
        frames = [
            (can_id, command(control[joint], torque_wire[joint], position_wire[joint]))
            for joint, can_id in enumerate(self._command_ids)
            if joint not in self.withheld
        ]
        now = self._clock.now()
        if now - decided > max_age:
            raise HostLate(now - decided, max_age, "the command grew too old before its frames left")
        if self.beating and now - self._beat > self.beat_every - 0.5 * self.period:
            frames.append((self._heartbeat_id, _OPERATIONAL))
            self._beat = now
        frames.append(_SYNC)
        if self._first is None:
            self._first = now
        self._awaited = self.n
        self.watch.syncs += 1
        self.stats.asked += 1
        self._port.send_all(frames)
        self.count(len(frames), sum([len(data) for _, data in frames]))
        self.synced = now
        end = now + self._patience
        for _ in range(MOST_FRAMES):
            if self._awaited <= 0:
                break
            if not self.receive(0.0):
                remaining = end - self._clock.now()
                if remaining <= 0 or not self.receive(remaining):
                    break
        delay = self._clock.now() - now
        self._take_what_is_there()
        self.stats.missed += self._awaited
        timely = None if self._awaited <= 0 and not self._owed_for else self._timely()
        sample = self.sample(now)
        sample.timely, sample.delay = timely, delay
        return sample

    def _timely(self) -> NDArray[np.bool_]:
        """Which readings are replies to this cycle's SYNC; replies that are owed for long are lost."""
        came = [raw == raw for raw in self._position]
        timely = np.array([here and not owed for here, owed in zip(came, self._owed, strict=True)])
        self._owed = [owed + (not here) for here, owed in zip(came, self._owed, strict=True)]
        self._owed_for = self._owed_for + 1 if any(self._owed) else 0
        if self._owed_for > OWED_CYCLES:
            self._owed, self._owed_for = [0] * self.n, 0
        return timely

    def listen(self, seconds: float) -> Sample:
        """Take in what comes within `seconds` without sending anything; of each reading the newest."""
        self.drain()
        end = self._clock.now() + seconds
        while (remaining := end - self._clock.now()) > 0:
            self.receive(remaining)
        return self.sample(self._clock.now())

    def measure(self, elapsed: float, bitrate: int) -> None:
        """Bring rate and load of the stats up to date for `elapsed` seconds."""
        if elapsed > 0:
            self.stats.rate_hz = self.stats.cycles / elapsed
            self.stats.load = self.bits / (bitrate * elapsed)
        self.stats.came = tuple(self._came)

    def take(self, can_id: int, data: bytes) -> None:
        """Take one frame in, for what it is; who takes it counts it."""
        entry = self._table.get(can_id)
        if entry is None:
            self._take_other(can_id, data)
            return
        joint, kind, unpack, size = entry
        if len(data) != size:
            self.stats.errors += 1
        elif kind == 0:
            self.watch.readings[joint] += 1
            self._came[joint] += 1
            if self._position[joint] != self._position[joint]:  # NaN: the first in this cycle
                self._awaited -= 1
            else:
                self._owed[joint] = max(self._owed[joint] - 1, 0)
                self.watch.again(joint)
            self._position[joint], self._torque[joint] = unpack(data)
        elif kind == 1:
            self.statuses[joint], self._motor[joint], self._velocity[joint] = unpack(data)
            self._slow_came = True
        else:
            self.statuses[joint], self.displays[joint] = unpack(data)

    def count(self, frames: int, size: int) -> None:
        """Count frames that went over the bus, with this many bytes of data in all."""
        self.stats.frames += frames
        self.bits += FIXED_BITS * frames + 8 * size

    def _take_other(self, can_id: int, data: bytes) -> None:
        self.watch.other(can_id, data)
        joint = self._joint_of.get(can_id & 0x7F)
        service = can_id & 0x780
        if joint is not None and service == objects.EMCY_ID:
            code, register = emcy.parse(data)
            if code:
                self.emergencies.append((joint, code, register))
        elif joint is not None and service == objects.HEARTBEAT_ID:
            state = data[0] & 0x7F if data else 0
            self.node_states[joint] = state
            if state == 0:
                self.watch.restarted.add(joint)
        else:
            self.on_other(can_id, data)

    def sample(self, now: float) -> Sample:
        """Readings since the last sample, the newest of each, as of time `now`; NaN if there was none."""
        position = np.array(self._position) * self._position_unit
        torque = np.array(self._torque) * TORQUE_PER_MICRO
        if self._slow_came:
            motor, velocity = self._keep_slow(now)
            self._motor, self._velocity = [math.nan] * self.n, [math.nan] * self.n
            self._slow_came = False
        else:
            motor, velocity = self._nothing.copy(), self._nothing.copy()
        for joint in self._keep(position, self.latest_position):
            self.seen[joint] = now
        self.stats.cycles += 1
        status: NDArray[np.int64] = np.array(self.statuses, np.int64)
        age: Array = now - np.array(self.seen)
        return Sample(now - (self._first or 0.0), position, velocity, torque, motor, status, age)

    def _keep_slow(self, now: float) -> tuple[Array, Array]:
        """Motor torque and velocity that came, also kept as the newest known."""
        motor = np.array(self._motor) * self._torque_unit
        velocity = np.array(self._velocity) * self._position_unit
        for joint in self._keep(motor, self.latest_motor_torque):
            self.slow_seen[joint] = now
        self._keep(velocity, self.latest_velocity)
        return motor, velocity

    def _keep(self, values: Array, latest: list[float]) -> list[int]:
        """Put the values that came into `latest`; the joints that they came from."""
        came = []
        for joint, value in enumerate(values.tolist()):
            if value == value:  # not NaN
                latest[joint] = value
                came.append(joint)
        return came
