"""Detects irregular traffic: a second host, a duplicated node id, a babbling node, a restarted controller."""

from collections.abc import Callable

MOST_FRAMES = 1000
"""Limit of frames taken in at once; a bus at 1 Mbit/s needs 47 ms for them."""
CROWD_PER_JOINT, CROWD = 5, 30
"""Normal limit of frames per cycle: 5 per joint, ours included, and 30 others (a scan by another tool is short)."""
CROWDED_CYCLES = 10
"""Consecutive cycles above that limit that mean a babbling node."""
DOUBLE_CYCLES = 3
"""Consecutive cycles with two readings of one joint that mean a second node with its id."""
FORGIVEN = 250
"""Missed readings that may still arrive, several per cycle: one second of SYNCs at 250 Hz, from an arm that was late
itself and catches up."""


class BusWatch:
    """Counts the readings of the cyclic loop, and frames that are no process data."""

    def __init__(self, joints: int, of_a_host: Callable[[int, bytes], str]) -> None:
        """`of_a_host` describes a frame that only a host sends, by identifier and data: here from a second one."""
        self._of_a_host = of_a_host
        self._crowd = CROWD_PER_JOINT * joints + CROWD
        self._doubled: set[int] = set()
        self._double_cycles = [0] * joints
        self._crowded_cycles = 0
        self._last: int | None = None
        self.syncs = 0
        """SYNCs sent."""
        self.readings = [0] * joints
        """Readings received from each joint."""
        self.restarted: set[int] = set()
        """Joints whose controller has sent its boot-up message."""
        self.clear()

    def clear(self) -> None:
        """Reset everything for a new start of the link."""
        self.restarted.clear()
        self.syncs, self.readings = 0, [0] * len(self.readings)
        self.intruder = ""
        """Description of a frame received that only the host may send; empty if there was none."""
        self.flooded = False
        self._double_cycles = [0] * len(self._double_cycles)
        self._crowded_cycles = 0

    def settle(self) -> None:
        """After an interruption: reset the crowding counters; replies that are owed may still arrive."""
        self.flooded, self._crowded_cycles = False, 0
        self._doubled.clear()
        self._double_cycles = [0] * len(self._double_cycles)

    def again(self, joint: int) -> None:
        """A second reading of a joint arrived in this cycle: a late one, or more readings than SYNCs."""
        self.readings[joint] = max(self.readings[joint], self.syncs - FORGIVEN)
        if self.readings[joint] > self.syncs:
            self._doubled.add(joint)

    def other(self, can_id: int, data: bytes) -> None:
        """A frame arrived that is no process data of a joint."""
        self._last = can_id
        if self.intruder:
            return
        what = self._of_a_host(can_id, data)
        if what:
            self.intruder = f"{what} ({can_id:03X}h)"

    def cycle_ends(self, frames: int) -> None:
        """Evaluate the completed cycle, with the number of frames sent and received in it."""
        if self._doubled or any(self._double_cycles):
            for joint, count in enumerate(self._double_cycles):
                self._double_cycles[joint] = count + 1 if joint in self._doubled else 0
            self._doubled.clear()
        self._crowded_cycles = self._crowded_cycles + 1 if frames > self._crowd else 0

    @property
    def doubled(self) -> int | None:
        """The joint whose node id is also used by a second node, or None."""
        most = max(self._double_cycles)
        return self._double_cycles.index(most) if most >= DOUBLE_CYCLES else None

    @property
    def babbling(self) -> bool:
        """Whether more frames arrive than a bus with these joints should carry."""
        return self.flooded or self._crowded_cycles >= CROWDED_CYCLES

    @property
    def last(self) -> str:
        """COB-ID of the newest frame that was no process data: the probable source of a flood."""
        return "none" if self._last is None else f"{self._last:03X}h"
