"""Communication of the joints' nodes (CiA 301): network management, and the timers that watch it.

Timers are a node's own heartbeat, the heartbeats of masters, the deadlines of RPDOs, and the SYNC period.
"""

import math
import struct
from collections.abc import Callable

from armlink.drives.canopen.cia402 import DriveState
from sim_bus.node.drives import SimulatedDrives
from sim_bus.node.node import OPERATIONAL, PRE_OPERATIONAL, STOPPED, Node

RESET_NODE, RESET_COMMUNICATION = 0x81, 0x82
STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
"""Commands of network management and the states that they lead to (CiA 301, 7.3.2)."""
OWN_HEARTBEAT, HEARTBEAT_LOST, RPDO_TIMEOUT, SYNC_LOST = 0, 0x8130, 0x8250, 0x8700
"""A timer that is due sends a heartbeat, or an EMCY with this code."""
COMMUNICATION_ERROR = 0x11
"""Error register: generic and communication."""
SYNC_PATIENCE = 3.0
"""SYNC counts as lost after this many periods (1006h)."""
ABORT_NOTHING, ABORT_FAULT, ABORT_DISABLE, ABORT_QUICK_STOP = 0, 1, 2, 3
Timer = tuple[int, int, int]
"""Joint, what it does, and the master's node id or the number of the RPDO."""


class Supervision:
    """NMT states and timers of all nodes. `due` is not later than the next timer [s]."""

    def __init__(self, nodes: list[Node], drives: SimulatedDrives, apply: Callable[[Node], None]) -> None:
        """Nothing is monitored before configure(); `apply` applies a node's objects after a reset."""
        self._nodes, self._drives, self._apply = {node.place: node for node in nodes}, drives, apply
        self.operational = bytearray(drives.n)
        """Whether each joint's node may use PDOs."""
        self.due = math.inf
        self.watches_rpdos = self._watches_sync = False
        self._periods: dict[Timer, float] = {}
        self._due: dict[Timer, float] = {}
        """When each running timer is due [s]."""

    # ---- network management

    def frame(self, data: bytes, tag: int) -> None:
        """Process an NMT command on the bus of that tag."""
        if len(data) < 2:
            return
        for node in self._nodes.values():
            if data[1] in (0, node.node_id) and node.tag == tag and not node.unplugged:
                self.command(node, data[0])

    def command(self, node: Node, asked: int) -> None:
        if asked in (RESET_NODE, RESET_COMMUNICATION):
            if asked == RESET_NODE:
                self._drives.enter(node.place, DriveState.SWITCH_ON_DISABLED)
            node.reset(communication_only=asked == RESET_COMMUNICATION)
            self._apply(node)
            self._drives.take_commands()
        elif asked in STATES:
            node.nmt = STATES[asked]
        self.operational[node.place] = node.nmt == OPERATIONAL
        if node.nmt != OPERATIONAL:  # its PDO deadlines stop, and an enabled drive acts by 6007h
            for timer in [each for each in self._due if each[0] == node.place and each[1] in (RPDO_TIMEOUT, SYNC_LOST)]:
                del self._due[timer]
            self._abort_connection(node)

    # ---- timers

    def configure(self, node: Node, time: float) -> None:
        """Read 1006h, 1016h, 1017h and the RPDOs' event timers; unchanged timers keep running."""
        place, masters = node.place, (node.value(0x1016, 1), node.value(0x1016, 2))
        own = place, OWN_HEARTBEAT, 0
        wanted: dict[Timer, float] = {
            own: node.value(0x1017) / 1000,
            (place, SYNC_LOST, 0): node.value(0x1006) * 1e-6 * SYNC_PATIENCE,
            **{(place, RPDO_TIMEOUT, number): node.value(0x1400 + number, 5) / 1000 for number in range(4)},
            **{(place, HEARTBEAT_LOST, value >> 16 & 0x7F): (value & 0xFFFF) / 1000 for value in masters},
        }
        wanted.pop((place, HEARTBEAT_LOST, 0), None)
        for timer in wanted.keys() | self._periods.keys():
            if timer[0] == place and wanted.get(timer, 0.0) != self._periods.get(timer, 0.0):
                self._due.pop(timer, None)
        others = {timer: period for timer, period in self._periods.items() if timer[0] != place}
        self._periods = others | {timer: period for timer, period in wanted.items() if period}
        kinds = {kind for _, kind, _ in self._periods}
        self.watches_rpdos, self._watches_sync = RPDO_TIMEOUT in kinds, SYNC_LOST in kinds
        if own not in self._due:
            self._start(own, time)
        self._schedule()

    def heartbeat(self, master: int, time: float, tag: int) -> None:
        """A heartbeat of node id `master` arrived on the bus of that tag."""
        for node in self._nodes.values():
            if node.tag == tag and not node.unplugged:
                self._start((node.place, HEARTBEAT_LOST, master), time)

    def rpdo(self, joint: int, number: int, time: float) -> None:
        self._start((joint, RPDO_TIMEOUT, number), time)

    def sync(self, time: float) -> None:
        for node in self._nodes.values() if self._watches_sync else ():
            if not node.unplugged:
                self._start((node.place, SYNC_LOST, 0), time)

    def postpone(self, seconds: float) -> None:
        """Postpone all deadlines for the host [s], because the simulated arm itself was late."""
        for timer in self._due:
            if timer[1] != OWN_HEARTBEAT:
                self._due[timer] += seconds
        self._schedule()

    def check(self, time: float) -> None:
        """Handle the timers that are due at `time` [s]."""
        for timer in sorted(timer for timer, due in self._due.items() if due <= time):
            place, kind, which = timer
            node, due = self._nodes[place], self._due.pop(timer)
            if kind == OWN_HEARTBEAT:
                node.send(0x700 + node.node_id, bytes([node.nmt]))
                self._due[timer] = max(due + self._periods[timer], time)
            elif kind == HEARTBEAT_LOST:
                self._lost(node, kind, bytes([which]))
                if node.nmt == OPERATIONAL:
                    node.nmt = {0: PRE_OPERATIONAL, 2: STOPPED}.get(node.value(0x1029, 1), OPERATIONAL)
            else:
                self._lost(node, kind, struct.pack("<H", 0x1400 + which) if kind == RPDO_TIMEOUT else b"")
        for place, node in self._nodes.items():
            self.operational[place] = node.nmt == OPERATIONAL
        self._schedule()

    def _start(self, timer: Timer, time: float) -> None:
        period = self._periods.get(timer)
        if period is not None:
            self._due[timer] = due = time + period
            if due < self.due:
                self.due = due

    def _schedule(self) -> None:
        self.due = min(self._due.values(), default=math.inf)

    def _lost(self, node: Node, code: int, detail: bytes) -> None:
        node.emergency(code, COMMUNICATION_ERROR, detail)
        self._abort_connection(node, code)

    def _abort_connection(self, node: Node, code: int = 0) -> None:
        """Act by the abort connection option (6007h): 0 nothing, 1 fault, 2 disable voltage, 3 quick stop."""
        if self._drives.state[node.place] is not DriveState.ENABLED:
            return
        option = node.value(0x6007)
        if option == ABORT_FAULT:
            self._drives.enter(node.place, DriveState.FAULT)
        elif option == ABORT_DISABLE:
            self._drives.enter(node.place, DriveState.SWITCH_ON_DISABLED)
        elif option == ABORT_QUICK_STOP:
            self._drives.quick_stop(node.place)
        self._drives.error_code[node.place] = code
