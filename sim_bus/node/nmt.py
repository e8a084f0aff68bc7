"""Network management of the joints' nodes (CiA 301, 7.3.2): start, stop, pre-operational, the two resets."""

from collections.abc import Callable

from sim_bus.node.cia402 import PowerState
from sim_bus.node.drives import SimulatedDrives
from sim_bus.node.node import OPERATIONAL, PRE_OPERATIONAL, STOPPED, Node
from sim_bus.node.supervision import Supervision

RESET_NODE, RESET_COMMUNICATION = 0x81, 0x82
STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}


class NetworkManagement:
    """NMT states of all nodes; `operational[j]`: whether node j may use PDOs."""

    def __init__(
        self, nodes: list[Node], drives: SimulatedDrives, supervision: Supervision, apply: Callable[[Node], None]
    ) -> None:
        """`apply` applies a node's objects after a reset."""
        self._nodes, self._drives, self._supervision, self._apply = nodes, drives, supervision, apply
        self.operational = bytearray(drives.n)

    def frame(self, data: bytes, time: float, tag: int) -> None:
        """Process an NMT command on the bus of that tag."""
        if len(data) < 2:
            return
        for node in self._nodes:
            if data[1] in (0, node.node_id) and node.tag == tag and not node.unplugged:
                self.command(node, data[0], time)

    def command(self, node: Node, asked: int, time: float) -> None:
        """Bring one node into the commanded state."""
        if asked in (RESET_NODE, RESET_COMMUNICATION):
            if asked == RESET_NODE:
                self._drives.enter(node.place, PowerState.SWITCH_ON_DISABLED)
            node.reset(communication_only=asked == RESET_COMMUNICATION)
            self._apply(node)
            self._drives.take_commands()
        elif asked in STATES:
            node.nmt = STATES[asked]
        self.operational[node.place] = node.nmt == OPERATIONAL
        if node.nmt != OPERATIONAL:
            self._supervision.left_operational(node, time)

    def update(self) -> None:
        """Update after nodes changed their own state (1029h)."""
        for node in self._nodes:
            self.operational[node.place] = node.nmt == OPERATIONAL
