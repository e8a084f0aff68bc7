"""Seven joint controllers of negligible cost: each answers SYNC with its TPDO1.

Where the kernel has can-gw, the kernel itself answers: a gateway rule a node turns each SYNC into that node's TPDO1, no
process runs. What a host needs before it cycles (SDO, NMT, the way to operation enabled) is answered by a process with
the tests' own nodes, which hears no SYNC any more once the rules stand. Without can-gw that process answers SYNC too.
"""

import multiprocessing
import socket
import struct
import sys
from pathlib import Path
from typing import Any

import can

from armlink.bus.sockets.datagram_port import SocketPort

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "armlink"))
from fake_joints import FakeBus, make_arm

__all__ = ["NODES", "answer_in_kernel", "make_arm", "remove_gateway", "start_nodes"]

NODES = tuple(range(1, 8))
SYNC = 0x80
_RTM_NEWROUTE, _RTM_DELROUTE, _REQUEST_ACK = 24, 25, 5
_CAN_TO_CAN, _ECHO_AND_BACK = 1, 5  # the frame goes to local sockets, out of the interface that it came in by
_SET, _SOURCE, _DESTINATION, _FILTER = 4, 9, 10, 11
_ID_LENGTH_DATA = 1 | 2 | 4


def readings(node: int) -> bytes:
    """TPDO1 of a node: position [user units] and torque reading [µN·m]."""
    return struct.pack("<ii", 1000 * node, 2_000_000 + node)


def answer_in_kernel(channel: str) -> bool:
    """Let the kernel answer SYNC for every node instead of the process; False if it cannot."""
    try:
        with can.Bus(interface="socketcan", channel=channel) as bus:
            bus.send(can.Message(arbitration_id=QUIET, is_extended_id=False))
        index = socket.if_nametoindex(channel)
        for node in NODES:
            frame = struct.pack("=IB3x8sB", 0x180 + node, 8, readings(node), _ID_LENGTH_DATA)
            content = struct.pack("=BBH", socket.AF_CAN, _CAN_TO_CAN, _ECHO_AND_BACK)
            content += _attribute(_SET, frame) + _attribute(_FILTER, struct.pack("=II", SYNC, 0xC00007FF))
            content += _attribute(_SOURCE, struct.pack("=I", index)) + _attribute(
                _DESTINATION, struct.pack("=I", index)
            )
            _ask_kernel(_RTM_NEWROUTE, content)
    except OSError:
        return False
    return True


def remove_gateway() -> None:
    """Remove all gateway rules."""
    every = _attribute(_SOURCE, bytes(4)) + _attribute(_DESTINATION, bytes(4))
    _ask_kernel(_RTM_DELROUTE, struct.pack("=BBH", socket.AF_CAN, _CAN_TO_CAN, 0) + every)


def start_nodes(channel: str) -> multiprocessing.Process:
    """The process of the tests' nodes on SocketCAN `channel`; it answers SYNC until answer_in_kernel."""
    listens = multiprocessing.Event()
    process = multiprocessing.Process(target=_serve, args=(channel, listens), daemon=True)
    process.start()
    listens.wait()
    return process


def _serve(channel: str, listens: Any) -> None:
    bus = can.Bus(interface="socketcan", channel=channel)
    port, nodes = SocketPort(bus.socket, channel), FakeBus(NODES)
    listens.set()
    for node in NODES:
        nodes.nodes[node].position, nodes.nodes[node].torque = struct.unpack("<ii", readings(node))
    while True:
        frame = port.receive(1.0)
        if frame is None:
            continue
        if frame[0] == QUIET:
            bus.set_filters([{"can_id": 0x600, "can_mask": 0x780, "extended": False}])
            continue
        nodes.put(*frame)
        if nodes.out:
            for each in nodes.out:
                port.send(*each)
            nodes.out.clear()


QUIET = 0x7FF
"""A frame with this identifier tells the process that the kernel answers SYNC from now on."""


def _attribute(kind: int, content: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(content), kind) + content + bytes(-len(content) % 4)


def _ask_kernel(kind: int, content: bytes) -> None:
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(struct.pack("=IHHII", 16 + len(content), kind, _REQUEST_ACK, 1, 0) + content)
        error = struct.unpack_from("=i", netlink.recv(4096), 16)[0]
        if error:
            raise OSError(-error, "can-gw")
