"""A tiny lock-step arm: nodes that answer from a dictionary and follow their targets."""

import struct
import zlib
from collections import deque
from pathlib import Path

from armlink.arm_file import parse_arm
from armlink.bus.in_process import InProcessBus
from armlink.drives.canopen import object_dictionary as objects

SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08


class FakeClock:
    def __init__(self):
        self.time = 10.0

    def now(self):
        return self.time

    def sleep_until(self, instant):
        self.time = max(self.time, instant)


class FakeNode:
    def __init__(self, node, rated_mnm=40_000):
        self.node, self.values = node, {}
        self.status, self.mode, self.operational = SWITCH_ON_DISABLED, 0, False
        self.position, self.torque, self.motor, self.velocity = 0, 2_000_000, 50, 0
        self.control = (0, 0, 0)
        self.previous_control = 0
        self.syncs = 0
        self.silent = self.no_tpdo = False
        self.mapping_lies = False
        self.modes = (8, 10)  # those that it enters when told to
        self.display = self.shown = 0
        self.commands = []
        u32 = struct.Struct("<I").pack
        self.values |= {
            (0x1000, 0): u32(0x20192),
            (0x1018, 1): u32(0x11),
            (0x1018, 2): u32(0x22),
            (0x1018, 3): u32(0x33),
            (0x1018, 4): u32(100 + node),
            (0x6076, 0): u32(rated_mnm),
            (0x608F, 1): u32(65536),
            (0x608F, 2): u32(1),
            (0x6091, 1): u32(100),
            (0x6091, 2): u32(1),
            (0x6092, 1): u32(1 << 20),
            (0x6092, 2): u32(1),
            (0x6502, 0): u32(1 << 7 | 1 << 9),
            (0x2100, 2): struct.pack("<f", 1.0),
            (0x2100, 3): struct.pack("<f", 0.0),
            (0x2100, 7): u32(0),
            (0x2100, 8): u32(0),
            (0x2100, 9): u32(0),
        }

    def sdo(self, data):
        command, index, sub = struct.unpack_from("<BHB", data)
        if command == 0x40:
            dynamic = {
                (0x6041, 0): struct.pack("<H", self.status),
                (0x6061, 0): struct.pack("<b", self.display),
                (0x6064, 0): struct.pack("<i", self.position),
                (0x6077, 0): struct.pack("<h", self.motor),
            }
            value = dynamic.get((index, sub)) or self.values.get((index, sub))
            if value is None:
                return struct.pack("<BHBI", 0x80, index, sub, 0x06020000)
            return struct.pack("<BHB", 0x43 | (4 - len(value)) << 2, index, sub) + value.ljust(4, b"\0")
        if command & 0xE0 == 0x20:
            value = bytes(data[4 : 8 - (command >> 2 & 3)])
            if (index, sub) == (0x2100, 6):
                content = b"".join(self.values[0x2100, i] for i in (4, 5, 7, 8))
                if zlib.crc32(content) != struct.unpack("<I", self.values[0x2100, 9])[0]:
                    return struct.pack("<BHBI", 0x80, index, sub, 0x08000022)
                self.values[0x2100, 2], self.values[0x2100, 3] = self.values[0x2100, 4], self.values[0x2100, 5]
            if self.mapping_lies and (index, sub) == (0x1A00, 2):
                value = struct.pack("<I", 0x60770010)
            self.values[index, sub] = value
            return struct.pack("<BHB", 0x60, index, sub) + bytes(4)
        return None

    def apply(self):
        control, torque, position = self.control
        self.commands.append((control, torque, position, self.mode))
        step = {
            (SWITCH_ON_DISABLED, 6): READY,
            (READY, 7): SWITCHED_ON,
            (SWITCHED_ON, 15): ENABLED,
            (ENABLED, 2): QUICK_STOP,
            (QUICK_STOP, 15): ENABLED,
            (ENABLED, 0): SWITCH_ON_DISABLED,
            (QUICK_STOP, 0): SWITCH_ON_DISABLED,
            (READY, 2): SWITCH_ON_DISABLED,
            (SWITCHED_ON, 2): SWITCH_ON_DISABLED,
        }
        before = self.status
        if self.status == FAULT:
            if control & 0x80 and not self.previous_control & 0x80:
                self.status = SWITCH_ON_DISABLED
        else:
            self.status = step.get((self.status, control & 0x0F), self.status)
        self.previous_control = control
        if self.status == ENABLED and self.mode == 8:
            self.position = position
        if self.status == ENABLED and self.mode == 10:
            self.motor = torque
        return self.status != before


class FakeBus(InProcessBus):
    """Lock-step bus."""

    channel_info = "fake"

    def __init__(self, nodes, period=0.004):
        self.nodes = {node: FakeNode(node) for node in nodes}
        self.clock, self.period = FakeClock(), period
        self.out, self.sent = deque(), []
        self.closed = False

    def put(self, can_id, data):
        self.sent.append((can_id, bytes(data)))
        node = self.nodes.get(can_id & 0x7F)
        if can_id == objects.NMT_ID:
            for each in self.nodes.values():
                if data[1] in (0, each.node):
                    each.operational = data[0] == 1
        elif can_id == objects.SYNC_ID:
            self.clock.time += self.period
            for each in self.nodes.values():
                self._sync(each)
        elif node is None or node.silent:
            return
        elif can_id & 0x780 == 0x600:
            answer = node.sdo(data)
            if answer:
                self.out.append((0x580 + node.node, answer))
        elif can_id & 0x780 == 0x200:
            node.control = struct.unpack("<Hhi", data)
        elif can_id & 0x780 == 0x300:
            node.mode = data[0]
            if node.mode in node.modes:
                node.display = node.mode

    def _sync(self, node):
        if node.silent or not node.operational:
            return
        changed = node.apply()
        node.syncs += 1
        if node.no_tpdo:
            return
        self.out.append((0x180 + node.node, struct.pack("<ii", node.position, node.torque)))
        if node.syncs % 4 == 0:
            self.out.append((0x280 + node.node, struct.pack("<Hhi", node.status, node.motor, node.velocity)))
        if changed or node.shown != node.display:
            node.shown = node.display
            self.out.append((0x380 + node.node, struct.pack("<Hb", node.status, node.display)))

    def take(self, timeout=0.0):
        if not self.out and timeout > 0:
            self.clock.time += timeout
        return self.out.popleft() if self.out else None

    def shutdown(self):
        self.closed = True


def make_arm(n=3, link=(), joint=()):
    joints = [{"name": f"joint_{i}", "d": 0.1, "lower": -2.0, "upper": 2.0} for i in range(1, n + 1)]
    linked = [
        {"name": f"joint_{i}", "node": i, "rated_torque": 40.0, "max_torque": 30.0, **dict(joint)}
        for i in range(1, n + 1)
    ]
    content = {"name": "test", "kinematics": {"joints": joints}, "link": {"joints": linked, **dict(link)}}
    return parse_arm(content, Path("test.yaml"))
