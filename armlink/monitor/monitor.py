"""Monitor of an arm's bus: decodes what its joints send and commands nothing."""

import math
from dataclasses import dataclass
from typing import Any

import can

from armlink.arm_file import ArmFile
from armlink.bus.can_bus import MessageBus
from armlink.bus.message_port import as_frame, is_data
from armlink.bus.port import Port
from armlink.bus.taps import TappedBus, TappedPort
from armlink.drives.board import NO_STATUS
from armlink.errors import BadInput
from armlink.link.joints.groups import by_joint
from armlink.link.joints.whole_turns import PlaceWatch
from armlink.link.listener import HeardArm
from armlink.link.types import Sample
from armlink.monitor.cycle_stats import CycleStats


@dataclass(eq=False)
class View:
    """Newest values of each joint in one interval; NaN if none was received."""

    sample: Sample
    rate_hz: float
    load: float
    """Share of the bus time taken by the frames received and sent."""


class Monitor(HeardArm):
    """Listens to an arm's joints. With `sync` it acts as host where the family has frames that only make drives send
    readings (CANopen: NMT start and SYNC)."""

    def __init__(self, arm: ArmFile, bus: MessageBus, sync: bool = False, stats: bool = False) -> None:
        """`stats`: also measure the cycle from the timestamp of every frame, which takes more CPU time."""
        super().__init__(arm, bus)
        self._sync = sync
        self.cycle_stats: CycleStats | None = None
        """Statistics of the cycle; None unless requested."""
        if stats:
            self.cycle_stats = CycleStats(self.groups, self.period, self.section.bus.bitrate)
        self.listen_on(self._open_port(bus), self._count)
        self.places = PlaceWatch(arm, self.values, tell=lambda text: None)  # `describe` does
        self._syncs = 0
        self._counted: tuple[float, int, int] | None = None
        """Time [s], cycles and bits at the end of the last view."""
        if sync:
            silent = [group.family.name for group in self.groups if not group.drives.poll(first=False)]
            if silent:
                raise BadInput(
                    f"monitor --sync: drives of the family {silent[0]} send readings only in answer to commands"
                )
            self._poll(first=True)

    def _poll(self, first: bool) -> None:
        for group in self.groups:
            for can_id, data in group.drives.poll(first):
                self._loop.send(can_id | group.tag, data)

    def _open_port(self, bus: MessageBus) -> Port:
        """Port of the bus; for statistics one that passes on every frame, by a listener with the interface's times."""
        if self.cycle_stats is None:
            return bus.open_port()
        if self._sync:
            return TappedPort(bus.open_port(), self.clock, self.cycle_stats.take)
        return TappedBus(bus, self._count_cycle).open_port()

    @property
    def frames(self) -> int:
        return self._loop.stats.frames

    @property
    def errors(self) -> int:
        return self._loop.stats.errors

    def watch(self, seconds: float) -> View:
        """Listen for `seconds`; raises BusFault if the bus fails."""
        if self._counted is None:
            end = self.clock.now() + seconds
            while self._loop.receive(0.0) and self.clock.now() < end:
                pass  # what waited since the bus was opened came in another time than this
        start, syncs, bits = self._counted or (self.clock.now(), self._syncs, self._loop.bits)
        sample = self._send_syncs(seconds) if self._sync else self._loop.listen(seconds)
        sample.position = self.places.take(sample.position)
        self._counted = (self.clock.now(), self._syncs, self._loop.bits)
        elapsed = self._counted[0] - start
        rate = (self._syncs - syncs) / elapsed
        return View(sample, rate, (self._loop.bits - bits) / (self.section.bus.bitrate * elapsed))

    def describe(self, view: View) -> dict[str, Any]:
        """A view as JSON content: joints (readings [rad, rad/s, N·m], states, age [s]), bus (rate, load), cycle."""
        cycle = {} if self.cycle_stats is None else {"cycle": self.cycle_stats.report()}
        return {
            **cycle,
            "joints": [self._joint(view.sample, joint) for joint in range(len(self.names))],
            "emergencies": [
                {"joint": self.names[each.joint], "code": each.code, "meaning": each.meaning}
                for each in self._loop.board.events
            ],
            "bus": {"rate_hz": view.rate_hz, "load": view.load, "frames": self.frames, "errors": self.errors}
            | {"dropped": self._loop.dropped},
        }

    def _joint(self, sample: Sample, joint: int) -> dict[str, Any]:
        sends = math.isfinite(sample.position[joint])
        status = int(sample.status[joint])
        group, _ = by_joint(self.groups)[joint]
        misplaced = self.places.found.get(joint)
        return {
            "joint": self.names[joint],
            "family": group.family.name,
            "position": float(sample.position[joint]),
            "velocity": float(sample.velocity[joint]),
            "torque": float(sample.torque[joint]),
            "motor_torque": float(sample.motor_torque[joint]),
            "state": None if status == NO_STATUS else group.family.state_name(status),
            "age": float(sample.age[joint]),
            "misplaced": None if misplaced is None else f"{misplaced.what}: {misplaced.remedy}",
            **group.drives.details(group.places.index(joint), sends),
        }

    def _send_syncs(self, seconds: float) -> Sample:
        self._loop.drain()
        count = max(1, round(seconds / self.period))
        start = self.clock.now()
        for cycle in range(count):
            self._poll(first=False)
            self._syncs += 1
            end = start + (cycle + 1) * self.period
            while (remaining := end - self.clock.now()) > 0:
                self._loop.receive(remaining)
            while self._loop.receive(0.0):
                pass
        return self._loop.sample(self.clock.now())

    def _count_cycle(self, message: can.Message, stamp: int) -> None:
        if self.cycle_stats and is_data(message):
            self.cycle_stats.take(stamp / 1e6, *as_frame(message))

    def _count(self, can_id: int, data: bytes) -> None:
        self._syncs += self._host.begins(can_id, data)
