"""Timers of each node: its own heartbeat, the master's heartbeat, RPDO deadlines and the SYNC period."""

import math
import struct

from sim_bus.node.cia402 import PowerState
from sim_bus.node.drives import SimulatedDrives
from sim_bus.node.node import OPERATIONAL, PRE_OPERATIONAL, STOPPED, Node

HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST = 0x8130, 0x8250, 0x8700
COMMUNICATION_ERROR = 0x11
"""Error register: generic and communication."""
SYNC_PATIENCE = 3.0
"""SYNC counts as lost after this many periods (1006h)."""
ABORT_NOTHING, ABORT_FAULT, ABORT_DISABLE, ABORT_QUICK_STOP = 0, 1, 2, 3


class Supervision:
    """Timers of all nodes. `due` is the time of the next one [s]."""

    def __init__(self, nodes: list[Node], drives: SimulatedDrives) -> None:
        """Nothing is monitored before configure()."""
        self._nodes, self._drives = nodes, drives
        n = drives.n
        self.due = math.inf
        self.watches_rpdos = False
        self._produce = [(0.0, math.inf)] * n
        self._consume: list[dict[int, float]] = [{} for _ in range(n)]
        self._consume_due: list[dict[int, float]] = [{} for _ in range(n)]
        self._rpdo: list[dict[int, float]] = [{} for _ in range(n)]
        self._rpdo_due: list[dict[int, float]] = [{} for _ in range(n)]
        self._sync: list[float] = [0.0] * n
        self._sync_due = [math.inf] * n

    def configure(self, node: Node, time: float) -> None:
        """Read 1006h, 1016h, 1017h and the RPDOs' event timers; unchanged timers keep running."""
        j = node.place
        period = node.value(0x1017) / 1000
        if period != self._produce[j][0]:
            self._produce[j] = (period, time + period if period else math.inf)
        consumed = {value >> 16 & 0x7F: (value & 0xFFFF) / 1000 for value in (node.value(0x1016, s) for s in (1, 2))}
        consumed = {master: timeout for master, timeout in consumed.items() if master and timeout}
        if consumed != self._consume[j]:
            self._consume[j], self._consume_due[j] = consumed, {}
        timers = {number: node.value(0x1400 + number, 5) / 1000 for number in range(4)}
        timers = {number: timeout for number, timeout in timers.items() if timeout}
        if timers != self._rpdo[j]:
            self._rpdo[j], self._rpdo_due[j] = timers, {}
        self.watches_rpdos = any(self._rpdo)
        sync = node.value(0x1006) * 1e-6 * SYNC_PATIENCE
        if sync != self._sync[j]:
            self._sync[j], self._sync_due[j] = sync, math.inf
        self._schedule()

    def heartbeat(self, master: int, time: float, tag: int) -> None:
        """A heartbeat of node id `master` arrived on the bus of that tag: its consumers' timers start."""
        for node in self._nodes:
            consumed = self._consume[node.place]
            if master in consumed and node.tag == tag and not node.unplugged:
                self._consume_due[node.place][master] = time + consumed[master]
        self._schedule()

    def rpdo(self, joint: int, number: int, time: float) -> None:
        """RPDO `number` of a node arrived."""
        if number in self._rpdo[joint]:
            self._rpdo_due[joint][number] = time + self._rpdo[joint][number]
            self.due = min(self.due, time + self._rpdo[joint][number])

    def sync(self, time: float) -> None:
        if any(self._sync):
            for node in self._nodes:
                period = self._sync[node.place]
                if not node.unplugged:
                    self._sync_due[node.place] = time + period if period else math.inf
            self.due = min(self.due, *self._sync_due)

    def postpone(self, seconds: float) -> None:
        """Postpone all deadlines for the host [s], because the simulated arm itself was late."""
        for table in (*self._consume_due, *self._rpdo_due):
            for key in table:
                table[key] += seconds
        self._sync_due = [due + seconds for due in self._sync_due]
        self._schedule()

    def left_operational(self, node: Node, time: float) -> None:
        """A node left operational: its PDO deadlines stop, and an enabled drive acts by 6007h."""
        self._rpdo_due[node.place] = {}
        self._sync_due[node.place] = math.inf
        self._abort_connection(node)

    def check(self, time: float) -> None:
        """Handle the timers that are due at `time` [s]."""
        for node in self._nodes:
            j = node.place
            period, due = self._produce[j]
            if due <= time:
                node.send(0x700 + node.node_id, bytes([node.nmt]))
                self._produce[j] = (period, max(due + period, time))
            for master, limit in list(self._consume_due[j].items()):
                if limit <= time:
                    del self._consume_due[j][master]
                    self._lost(node, HEARTBEAT_LOST, bytes([master]))
            for number, limit in list(self._rpdo_due[j].items()):
                if limit <= time:
                    del self._rpdo_due[j][number]
                    self._lost(node, RPDO_TIMEOUT, struct.pack("<H", 0x1400 + number))
            if self._sync_due[j] <= time:
                self._sync_due[j] = math.inf
                self._lost(node, SYNC_LOST, b"")
        self._schedule()

    def _lost(self, node: Node, code: int, detail: bytes) -> None:
        node.emergency(code, COMMUNICATION_ERROR, detail)
        self._abort_connection(node, code)
        if code == HEARTBEAT_LOST and node.nmt == OPERATIONAL:
            node.nmt = {0: PRE_OPERATIONAL, 2: STOPPED}.get(node.value(0x1029, 1), OPERATIONAL)

    def _abort_connection(self, node: Node, code: int = 0) -> None:
        """Act by the abort connection option (6007h): 0 nothing, 1 fault, 2 disable voltage, 3 quick stop."""
        if self._drives.state[node.place] is not PowerState.ENABLED:
            return
        option = node.value(0x6007)
        if option == ABORT_FAULT:
            self._drives.enter(node.place, PowerState.FAULT)
        elif option == ABORT_DISABLE:
            self._drives.enter(node.place, PowerState.SWITCH_ON_DISABLED)
        elif option == ABORT_QUICK_STOP:
            self._drives.quick_stop(node.place)
        self._drives.error_code[node.place] = code

    def _schedule(self) -> None:
        dues = [due for _, due in self._produce] + self._sync_due
        for table in (*self._consume_due, *self._rpdo_due):
            dues.extend(table.values())
        self.due = min(dues)
