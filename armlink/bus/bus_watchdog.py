"""What a bus shows that is not as it should be: a second host, a duplicated node id, a babbling node, a restart."""

from armlink.canopen.object_dictionary import HEARTBEAT_ID, NMT_ID, SYNC_ID
from armlink.canopen.pdo import RPDO1, RPDO2

MOST_FRAMES = 1000
"""Frames that are taken in at one go; at 1 Mbit/s a bus needs 47 ms for so many."""
CROWD_PER_JOINT, CROWD = 5, 30
"""A cycle has at most 5 frames a joint, ours included, and 30 others; a scan by another tool passes in a few cycles."""
CROWDED_CYCLES = 10
"""So many cycles running that have more are a babbling node."""
DOUBLE_CYCLES = 3
"""So many cycles running with two readings of one joint are a second node with its id."""
FORGIVEN = 250
"""Readings that did not come in their cycle and may come later, several at a time, as from an arm that was late itself
and catches up with a second of SYNCs."""


class BusWatch:
    """Counts what the cyclic loop meets: the readings themselves, and what is no process data."""

    def __init__(self, nodes: tuple[int, ...], host: int) -> None:
        """`nodes` are the joints' node ids, `host` is our own: nobody else sends its heartbeat."""
        self._ours = {
            NMT_ID: "NMT command",
            SYNC_ID: "SYNC",
            HEARTBEAT_ID + host: "heartbeat of the host",
            **{RPDO1.cob_base + node: f"RPDO1 of node {node}" for node in nodes},
            **{RPDO2.cob_base + node: f"RPDO2 of node {node}" for node in nodes},
        }
        self._crowd = CROWD_PER_JOINT * len(nodes) + CROWD
        self._doubled: set[int] = set()
        self._double_cycles = [0] * len(nodes)
        self._crowded_cycles = 0
        self._last: int | None = None
        self.syncs = 0
        """SYNCs that we sent."""
        self.readings = [0] * len(nodes)
        """Readings of each joint that came."""
        self.restarted: set[int] = set()
        """Joints whose controller has sent its boot-up message."""
        self.clear()

    def clear(self) -> None:
        """Forget what was seen: the link starts anew."""
        self.restarted.clear()
        self.syncs, self.readings = 0, [0] * len(self.readings)
        self.intruder = ""
        """A frame that only we should send, in words; empty where none came."""
        self.flooded = False
        self._double_cycles = [0] * len(self._double_cycles)
        self._crowded_cycles = 0

    def settle(self) -> None:
        """After an interruption: what crowded the bus has passed; replies that are owed may still come."""
        self.flooded, self._crowded_cycles = False, 0
        self._doubled.clear()
        self._double_cycles = [0] * len(self._double_cycles)

    def again(self, joint: int) -> None:
        """A second reading of a joint came in this cycle: a late one, or one too many for the SYNCs there were."""
        self.readings[joint] = max(self.readings[joint], self.syncs - FORGIVEN)
        if self.readings[joint] > self.syncs:
            self._doubled.add(joint)

    def other(self, can_id: int) -> None:
        """A frame came that is no process data of a joint."""
        self._last = can_id
        if can_id in self._ours and not self.intruder:
            self.intruder = f"{self._ours[can_id]} ({can_id:03X}h)"

    def cycle_ends(self, frames: int) -> None:
        """Count the cycle that is over, in which so many frames were sent and received."""
        if self._doubled or any(self._double_cycles):
            for joint, count in enumerate(self._double_cycles):
                self._double_cycles[joint] = count + 1 if joint in self._doubled else 0
            self._doubled.clear()
        self._crowded_cycles = self._crowded_cycles + 1 if frames > self._crowd else 0

    @property
    def doubled(self) -> int | None:
        """The joint whose node id a second node has, or None."""
        most = max(self._double_cycles)
        return self._double_cycles.index(most) if most >= DOUBLE_CYCLES else None

    @property
    def babbling(self) -> bool:
        """Whether more frames come than any bus with these joints should carry."""
        return self.flooded or self._crowded_cycles >= CROWDED_CYCLES

    @property
    def last(self) -> str:
        """COB-ID of the newest frame that was no process data, as the likely culprit."""
        return "none" if self._last is None else f"{self._last:03X}h"
