"""Two joints behind a guard that a compromised program commands: they follow at once, and judge what reached them."""

import json
import math
import struct

from fake_joints import FakeBus, make_arm

from armlink.guard.bus_guard import SCHEMA, Policy
from armlink.link.link import Link

N, RATED, MAX_TORQUE, SPEED, RATE, PERIOD = 2, 40.0, 30.0, 1.0, 200.0, 0.004
UNIT = 2 * math.pi / 2**20
WINDOW = (2.0 + 0.02 * 2.0 + 0.05) / UNIT
SPEED_COUNTS, RATE_COUNTS, MOST = SPEED / UNIT, RATE / RATED * 1000, MAX_TORQUE / RATED * 1000
BURST, COUNTS = 5 * PERIOD, 3
"""What may come at once [s] of the rate, and by rounding [counts] a frame."""
REMEMBERED = 60
JOINT = {"max_velocity": SPEED, "max_torque_rate": RATE}
READING, MOTOR = struct.Struct("<ii"), struct.Struct("<Hhi")
COMMAND = struct.Struct("<Hhi")


def content_of(n=N, link=()):
    """The policy of an arm of n joints."""
    with Link(make_arm(n, link, JOINT), FakeBus(range(1, n + 1))) as opened:
        return {"schema": SCHEMA, **json.loads(json.dumps(opened.guard_rules()))}


class GuardedBus(FakeBus):
    """Nodes behind a guard, as one process: what is refused is noted and does not reach them."""

    def __init__(self, nodes, policy):
        super().__init__(nodes)
        self.policy, self.refused, self.heard = policy, [], []

    def put(self, can_id, data):
        why = self.policy.refusal(can_id, bytes(data), self.clock.time)
        if why:
            self.refused.append(why)
        else:
            super().put(can_id, data)

    def take(self, timeout=0.0):
        frame = super().take(timeout)
        if frame:
            self.heard.append((*frame, self.clock.time))
            self.policy.hear(*self.heard[-1])
        return frame


def guarded(content, n=N):
    """The bus of an arm behind a guard with this policy, and its link."""
    bus = GuardedBus(range(1, n + 1), Policy(content))
    link = Link(make_arm(n, (), JOINT), bus)
    link.commander.motion.update = lambda *readings: None  # these joints have no mass and tell no velocity
    return bus, link


CONTENT = content_of()


def _heard_while_enabling():
    bus, link = guarded(CONTENT)
    with link:
        link.start()
        link.enable()
        return list(bus.heard), bus.clock.time


HEARD, ENABLED_AT = _heard_while_enabling()
"""What came from the wire while a link enabled the joints, each frame with its time, and the time after."""


class Joints:
    """The joints, enabled by a link that the program now is; what they are told they do at once."""

    def __init__(self):
        self.policy, self.now = Policy(CONTENT), ENABLED_AT
        for each in HEARD:
            self.policy.hear(*each)
        self.position, self.torque = {1: 0, 2: 0}, {1: 50, 2: 50}
        self.furthest = dict.fromkeys(self.position, WINDOW + 1)
        self._past = {node: [(self.now, 0, 50)] for node in self.position}
        self._free = dict.fromkeys(self.position, False)
        """Whether no power was given since: then it may come with no torque."""

    def stand(self, node, position, torque=0):
        """Put a joint without power somewhere."""
        self.position[node], self.torque[node] = position, torque
        self.furthest[node] = max(WINDOW, abs(position)) + 1
        self._past[node] = [(self.now, position, torque)]
        self._free[node] = True
        self._tell(node)

    def send(self, can_id, data, pause=0.0):
        """A frame of the program; whether it passed, and what is beyond a limit in it, in words."""
        self.now += pause
        if self.policy.refusal(can_id, data, self.now):
            return False, ""
        node = can_id & 0x7F
        if can_id & 0x780 == 0x200 and node in self.position:
            return True, self._told(node, *COMMAND.unpack(data))
        if can_id & 0x780 == 0x600 and data[0] >> 5 == 1:
            index, sub = struct.unpack_from("<HB", data, 1)
            known = CONTENT["frames"][str(can_id)]["sdo"]
            return True, "" if f"{index:X}:{sub:X}" in known else f"a write of {index:X}h:{sub:X}"
        harmless = can_id in (0x000, 0x080, 0x300 + node, 0x77F) or data[0] >> 5 in (2, 3, 4)
        return True, "" if harmless else f"{can_id:X}h"

    def _told(self, node, word, torque, position):
        if word & 0x0F != 0x0F:
            self.torque[node], self._free[node] = 0, True
            self._tell(node)
            return ""
        wrong = f"torque {torque}" if abs(torque) > MOST else ""
        if abs(position) > self.furthest[node]:
            wrong = f"position {position}"
        if self._free[node]:
            self._past[node] = [(self.now, self.position[node], self.torque[node])]
        for frames, (then, last, pull) in enumerate(reversed(self._past[node]), start=1):
            room = self.now - then + BURST
            if abs(position - last) > SPEED_COUNTS * room + COUNTS * frames:
                wrong = f"from {last} to {position} in {self.now - then:.4f} s"
            if abs(torque - pull) > RATE_COUNTS * room + COUNTS * frames:
                wrong = f"from torque {pull} to {torque} in {self.now - then:.4f} s"
        self._past[node] = [*self._past[node][-REMEMBERED:], (self.now, position, torque)]
        self.position[node], self.torque[node], self._free[node] = position, torque, False
        self.furthest[node] = max(WINDOW + 1, min(self.furthest[node], abs(position) + 1))
        self._tell(node)
        return wrong

    def _tell(self, node):
        self.policy.hear(0x180 + node, READING.pack(self.position[node], 2_000_000), self.now)
        self.policy.hear(0x280 + node, MOTOR.pack(0x27, self.torque[node], 0), self.now)
