"""Records an arm's bus while its host runs: one row per SYNC, with commands; sends nothing."""

from collections.abc import Callable, Iterator

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.can_bus import CanBus, TimedBus
from armlink.link.listener import HeardArm

WAIT_SECONDS = 0.1
Row = tuple[float, dict[str, Array]]


class Recorder(HeardArm):
    """Iterates over rows: time since the first SYNC [s] and channels of Recording, NaN if nothing was received."""

    def __init__(self, arm: ArmFile, bus: CanBus) -> None:
        """Listen to `bus`; times are the frames' own timestamps if the bus has them, else when frames were read."""
        super().__init__(arm, bus)
        self._timed = bus if isinstance(bus, TimedBus) else None
        self._stamp: Callable[[], float] = self._timed.stamp if self._timed else self.clock.now
        self.listen_on(bus.open_port(), self._take, forgets=True)
        self._start: float | None = None
        self._sync: float | None = None
        self._rows: list[Row] = []

    def rows(self, seconds: float) -> Iterator[Row]:
        """Rows completed within `seconds`, or in a whole log (LogBus); raises BusFault if the bus fails."""
        end = self.clock.now() + seconds
        while (remaining := end - self.clock.now()) > 0 and not (self._timed and self._timed.ended):
            self._loop.receive(min(remaining, WAIT_SECONDS))
            yield from self._rows
            self._rows.clear()

    def _take(self, can_id: int, data: bytes) -> None:
        if self._host.begins(can_id, data):
            self._complete(self._stamp())

    def _complete(self, now: float) -> None:
        """A cycle that begins completes the row of the previous one."""
        sample = self.take_sample(now)
        if self._sync is not None and self._start is not None:
            torque, position = self._host.decode(self._host.ended, sample)
            channels = {
                "position": sample.position,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "motor_torque": sample.motor_torque,
                "torque_command": torque,
                "position_command": position,
            }
            self._rows.append((self._sync - self._start, channels))
        else:
            self._start = now
        self._sync = now
