"""Detects irregular traffic: a second host, a duplicated node id, a babbling node, a restarted controller."""

from armlink.bus.port import EXTENDED, REMOTE

MOST_FRAMES = 1000
"""Limit of frames taken in at once; a bus at 1 Mbit/s needs 47 ms for them."""
CROWD_PER_JOINT, CROWD_FRAMES = 5, 30
"""Normal limit of frames per cycle: 5 per joint, ours included, and 30 others (a scan by another tool is short)."""
OWN_RATE = 250.0
"""Drives that send by their own clock do so 5 times per joint at this rate at most [Hz], whatever the cycle."""
CROWDED_CYCLES = 10
"""Cycles at twice that limit or more that mean a babbling node; of less crowded ones it takes more. What is less in all
is a backlog, of a host or a device that had no processor for a while."""
DOUBLE_CYCLES = 3
"""Consecutive cycles with two readings of one joint that mean a second node with its id."""
FORGIVEN_READINGS = 250
"""Missed readings that may still arrive, several per cycle: one second of SYNCs at 250 Hz, from an arm that was late
itself and catches up."""
SLOW_CYCLES = 4
"""A drive that sends velocity and state apart from its position does so after every so many SYNCs."""
EXCESS_READINGS = 3
"""So many readings more than a drive sends mean a second sender; one may be early, none is sent twice."""
TORQUE_MEMORY = 10
"""Positions after which a torque too many is forgotten: a position was lost."""


class BusWatch:
    """Counts the readings of the cyclic loop, and frames that are no process data."""

    def __init__(self, joints: int, sends: float = 1.0) -> None:
        """`sends`: how often a drive sends in a cycle at most; more than once where its own clock is faster."""
        self._crowd = CROWD_PER_JOINT * joints * sends + CROWD_FRAMES
        self._doubled: set[int] = set()
        self.others: dict[int, int] = {}
        """Frames of this cycle that were no readings of the fast way, by identifier."""
        self.strangers = 0
        """Frames of this cycle that no drive of ours sends."""
        self.readings = [0] * joints
        self.clear()

    def clear(self) -> None:
        joints = len(self.readings)
        self.syncs, self.readings[:] = 0, [0] * joints
        self.intruder = ""
        """Description of a frame received that only the host may send; empty if there was none."""
        self.reception = ""
        """Why the interface receives nothing, in words; empty while it does."""
        self.flooded = False
        self._double_cycles = [0] * joints
        self._slow_readings = [0] * joints
        self._torques_more = [0.0] * joints
        """Torques that came alone, less positions, of late; none less than 0."""
        self._positions_before = [0] * joints
        """Positions when the newest torque alone came."""
        self.forged: int | None = None
        """The joint in whose name a second node sends torques, velocities or states; None: no joint."""
        self._beyond = 0.0
        """Frames beyond the limit, in cycles' worth of it; it falls as cycles bring less than that."""
        self._counted = [0] * joints
        self._culprit: str | int = ""
        self.crowding = 0.0
        """Frames a cycle that no drive of ours sends, a mean over CROWDED_CYCLES."""

    @property
    def intrusion(self) -> str:
        told = f"another host is on this bus: it sends {self.intruder}"
        return f"{told}: stop that program, since only one program may command an arm"

    def settle(self) -> None:
        """After an interruption: reset the crowding counters; replies that are owed may still arrive."""
        self.flooded, self._beyond, self.crowding, self.reception = False, 0.0, 0.0, ""
        self._doubled.clear()
        self._double_cycles = [0] * len(self._double_cycles)

    def again(self, joint: int) -> None:
        """A second reading of a joint arrived in this cycle: a late one, or more readings than SYNCs."""
        self.readings[joint] = max(self.readings[joint], self.syncs - FORGIVEN_READINGS)
        if self.readings[joint] > self.syncs:
            self._doubled.add(joint)

    def slow(self, joint: int) -> None:
        """Velocity and state of a joint came apart from its position: more often than it sends them, or not."""
        due = self.syncs // SLOW_CYCLES + 1
        count = self._slow_readings[joint] = max(self._slow_readings[joint] + 1, due - FORGIVEN_READINGS // SLOW_CYCLES)
        if count >= due + EXCESS_READINGS:
            self.forged = joint

    def torque_alone(self, joint: int) -> None:
        """The torque of a joint came apart from its position: once a position, or more often."""
        positions = self.readings[joint] - self._positions_before[joint]
        self._positions_before[joint] = self.readings[joint]
        kept = max(self._torques_more[joint] - (1 + 1 / TORQUE_MEMORY) * positions, 0.0)
        self._torques_more[joint] = kept + 1.0
        if kept + 1.0 > EXCESS_READINGS:
            self.forged = joint

    def cycle_ends(self, frames: int, periods: float) -> None:
        """Evaluate the completed cycle, with the number of frames sent and received in it and the time that it took, in
        periods."""
        if self._doubled or any(self._double_cycles):
            for joint, count in enumerate(self._double_cycles):
                if joint in self._doubled:
                    self._double_cycles[joint] = count + 1
                else:  # a reading too many, such as the answer to a request, does not count against later ones
                    self._double_cycles[joint], self.readings[joint] = 0, min(self.readings[joint], self.syncs)
            self._doubled.clear()
        self.crowding += (self.strangers - self.crowding) / CROWDED_CYCLES
        limit = self._crowd * max(periods, 1.0)
        self._beyond = max(self._beyond + min(frames / limit - 1.0, 1.0), 0.0)
        if self._beyond or self.flooded or self.strangers:
            most = self._most_frequent()
            self._culprit = self._culprit if most == "" else most
        self.others.clear()
        self.strangers, self._counted = 0, self.readings.copy()

    def _most_frequent(self) -> str | int:
        """The most frequent of this cycle: a joint's readings, or a frame in words; empty where nothing came."""
        joint = max(range(len(self.readings)), key=lambda each: self.readings[each] - self._counted[each])
        can_id, count = max(self.others.items(), key=lambda each: each[1], default=(0, 0))
        if self.readings[joint] - self._counted[joint] > max(count, 1):
            return joint
        return frame_name(can_id) if count else ""

    @property
    def doubled(self) -> int | None:
        """The joint whose node id is also used by a second node, or None."""
        most = max(self._double_cycles)
        return self._double_cycles.index(most) if most >= DOUBLE_CYCLES else None

    @property
    def babbling(self) -> bool:
        """Whether more frames arrive than a bus with these joints should carry."""
        return self.flooded or self._beyond > CROWDED_CYCLES - 1

    @property
    def culprit(self) -> str | int:
        """The most frequent on a crowded bus, as `_most_frequent`: the probable source of a flood."""
        most = self._most_frequent() if self.flooded or self._culprit == "" else ""
        return self._culprit if most == "" else most


def frame_name(can_id: int) -> str:
    """A frame by its identifier, as people write it; which of several buses it is on is left out."""
    digits = f"{can_id & 0x1FFFFFFF:08X}h" if can_id & EXTENDED else f"{can_id & 0x7FF:03X}h"
    return f"remote frames {digits}" if can_id & REMOTE else digits
