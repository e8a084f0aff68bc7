"""Detects irregular traffic: a second host, a duplicated node id, a babbling node, a restarted controller."""

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


SLOW_CYCLES = 4
"""A drive that sends velocity and state apart from its position does so after every so many SYNCs."""
EXCESS = 3
"""So many readings more than a drive sends mean a second sender; one may be early, none is sent twice."""


class BusWatch:
    """Counts the readings of the cyclic loop, and frames that are no process data."""

    def __init__(self, joints: int) -> None:
        """Nothing was heard."""
        self._crowd = CROWD_PER_JOINT * joints + CROWD
        self._doubled: set[int] = set()
        self._double_cycles = [0] * joints
        self._slow_readings = [0] * joints
        self._crowded_cycles = 0
        self.last_id: int | None = None
        """Identifier of the newest frame that was no reading."""
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
        self.syncs, self.readings[:] = 0, [0] * len(self.readings)
        self.intruder = ""
        """Description of a frame received that only the host may send; empty if there was none."""
        self.flooded = False
        self._double_cycles = [0] * len(self._double_cycles)
        self._slow_readings = [0] * len(self.readings)
        self.forged: int | None = None
        """The joint in whose name a second node sends velocities and states; None: no joint."""
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

    def slow(self, joint: int) -> None:
        """Velocity and state of a joint came apart from its position: more often than it sends them, or not."""
        due = self.syncs // SLOW_CYCLES + 1
        count = self._slow_readings[joint] = max(self._slow_readings[joint] + 1, due - FORGIVEN // SLOW_CYCLES)
        if count >= due + EXCESS:
            self.forged = joint

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
        return "none" if self.last_id is None else f"{self.last_id:03X}h"
