"""Injects faults between the simulated arm and its bus, frame by frame, with the interface of the arm."""

import math
import struct
from collections import deque
from collections.abc import Callable

import numpy as np

from armlink.bus.port import ERROR
from armlink.errors import BadInput
from sim_bus.bus.fault_kinds import CANOPEN_FAULTS, Fault
from sim_bus.drives.drive_faults import DRIVE_KINDS, FALSE_READINGS, QUANTITIES, FalseReadings
from sim_bus.drives.simulated_drive import SimulatedDrive
from sim_bus.node.node import Node
from sim_bus.node.pdo import Frame
from sim_bus.simulated_arm import SERVICE, SimulatedArm

PROTOCOL_ERROR, BUS_OFF, RESTARTED = 0x08, 0x40, 0x100
"""Classes of an error frame, as in SocketCAN."""
ABORT_CODE, STORM_CODE = 0x08000022, 0x7305
BABBLE = (0x001, bytes(8))
TPDO1, SDO_ANSWER, SDO_REQUEST = 0x180, 0x580, 0x600
OBJECTS = {0x6064: "position", 0x606C: "velocity", 0x6077: "torque"}
"""Objects of a node that falsehoods are about."""
TO_NODES = (0x200, 0x300, 0x400, 0x500, SDO_REQUEST)
"""Function codes of frames to one node: RPDO1 to 4 and SDO."""
HOST_REFUSES = {
    "bus.off": "bus-off: check wiring, termination and bit rate",
    "bus.full": "transmit queue stays full: does any node acknowledge?",
    "link.down": "cannot send: Network is down",
}
"""Faults of the host's interface → error when the host sends."""


class Injector:
    """The arm's end of a faulty bus, with on_frame(), advance() and `outbox` of a SimulatedArm."""

    def __init__(self, arm: SimulatedArm, seed: int = 0) -> None:
        """Start without faults; `seed` is for faults that affect a share of the frames."""
        self.arm = arm
        self.outbox, arm.outbox = arm.outbox, deque()
        self.dropped = 0
        """Frames lost by the host's full receive queue."""
        self._sent = arm.outbox
        self._random = np.random.default_rng((seed, 2))
        self._planned: list[Fault] = []
        self._until: dict[str, float] = {}
        self._on: dict[tuple[str, int], float] = {}
        self._owed: dict[tuple[str, int], float] = {}
        self._false: dict[int, FalseReadings] = {}
        """Falsehoods about CANopen nodes."""

    def inject(self, fault: Fault) -> None:
        """Inject a fault now, or at its time. Raises BadInput for a fault that the joint's drive cannot have."""
        if fault.joint:
            device = self.arm.device(self.arm.names.index(fault.joint))
            if fault.id in (CANOPEN_FAULTS if isinstance(device, SimulatedDrive) else DRIVE_KINDS):
                family = self.arm.arm.require_link().joints[self.arm.names.index(fault.joint)].settings.family
                raise BadInput(f"fault {fault.id}: {fault.joint} has a {family} drive, which cannot have this fault")
        self._planned.append(fault)
        self._planned.sort(key=lambda planned: planned.time)
        self._begin()

    def clear(self) -> None:
        self._planned.clear()
        for joint in range(self.arm.n):
            device = self.arm.device(joint)
            device.unplugged = False
            self.arm.drives.refused_modes[joint].clear()
            if isinstance(device, SimulatedDrive):
                device.end_faults()
        if "bus.off" in self._until:
            self._error(RESTARTED)
        self._until.clear()
        self._on.clear()
        self._false.clear()

    @property
    def refusal(self) -> str:
        """Why the host's interface rejects frames at present; empty if it accepts them."""
        return next((words for fault, words in HOST_REFUSES.items() if fault in self._until), "")

    # ---- interface of the arm

    def on_frame(self, can_id: int, data: bytes) -> None:
        """Process a frame from the host, unless a fault stops it."""
        self._begin()
        if self.refusal:
            return
        place = self.arm.node_place(can_id)
        service = can_id & SERVICE
        if place is not None and service in TO_NODES and self.arm.device(place).unplugged:
            return
        if place is not None and service == SDO_REQUEST and self._answered(place, data):
            return
        self.arm.on_frame(can_id, data)
        self._carry()

    def advance(self, duration: float) -> None:
        self._begin()
        self.arm.advance(duration)
        for (fault, place), rate in self._on.items():
            if fault in ("node.babbling", "emcy.storm"):
                self._owed[fault, place] = self._owed.get((fault, place), 0.0) + rate * duration
                whole = int(self._owed[fault, place])
                self._owed[fault, place] -= whole
                self._sent.extend([BABBLE if fault == "node.babbling" else self._storm(place)] * whole)
        self._carry()
        self._end()

    # ---- internals

    def _storm(self, place: int) -> Frame:
        device = self.arm.device(place)
        assert isinstance(device, Node)
        return device.tag | 0x80 + device.node_id, struct.pack("<HB5x", STORM_CODE, 0x21)

    def _begin(self) -> None:
        while self._planned and self._planned[0].time <= self.arm.time:
            fault = self._planned.pop(0)
            place = self.arm.names.index(fault.joint) if fault.joint else -1
            self._start(fault, place)
            self._carry()

    def _start(self, fault: Fault, place: int) -> None:
        arm = self.arm
        device = arm.device(place) if place >= 0 else None
        if isinstance(device, SimulatedDrive) and (
            fault.id in DRIVE_KINDS or fault.id in FALSE_READINGS or fault.id == "mode.refused"
        ):
            device.inject(fault.id, fault.amount)
            return
        once: dict[str, Callable[[], None]] = {
            "node.reboot": lambda: arm.reboot(place),
            "mode.refused": lambda: arm.drives.refused_modes[place].add(int(fault.amount)),
            "clock.jump": lambda: arm.advance(fault.amount),
        }
        if fault.id in once:
            once[fault.id]()
        elif fault.id in FALSE_READINGS:
            self._false.setdefault(place, FalseReadings()).begin(fault.id, fault.amount)
        elif fault.id in HOST_REFUSES:
            self._until[fault.id] = arm.time + fault.amount
            if fault.id == "bus.off":
                self._error(BUS_OFF)
        elif fault.id == "node.silent":
            assert device is not None
            device.unplugged = True
            self._until[fault.joint] = arm.time + fault.amount
        else:
            self._on[fault.id, place] = fault.amount

    def _end(self) -> None:
        for what in [what for what, until in self._until.items() if until <= self.arm.time + 1e-9]:
            del self._until[what]
            if what == "bus.off":
                self._error(RESTARTED)
            elif what in self.arm.names:
                self.arm.device(self.arm.names.index(what)).unplugged = False

    def _answered(self, place: int, request: bytes) -> bool:
        """Whether a fault handles an SDO request, by an abort or by silence."""
        if ("sdo.abort", place) in self._on:
            answer = struct.pack("<B3sI", 0x80, request[1:4].ljust(3, b"\0"), ABORT_CODE)
            device = self.arm.device(place)
            assert isinstance(device, Node)
            self._sent.append((device.tag | SDO_ANSWER + device.node_id, answer))
            self._carry()
            return True
        return ("sdo.timeout", place) in self._on

    def _carry(self) -> None:
        """Pass the nodes' frames on to the host, changed or dropped by faults."""
        sent, lost = self._sent, bool(self.refusal)
        most = self._on.get(("reader.slow", -1), math.inf)
        while sent:
            frame = sent.popleft()
            for arriving in () if lost else self._arriving(*frame):
                if len(self.outbox) < most:
                    self.outbox.append(arriving)
                else:
                    self.dropped += 1

    def _arriving(self, can_id: int, data: bytes) -> tuple[Frame, ...]:
        place = self.arm.joint_of(can_id)
        if place is None:
            return ((can_id, data),)
        if self.arm.device(place).unplugged:
            return ()
        is_reading = place in self.arm.drive_at or can_id & SERVICE == TPDO1
        if self._strikes("frame.corrupt", place):
            return ((ERROR | PROTOCOL_ERROR, bytes(8)),)
        if is_reading and self._strikes("frame.short", place):
            return ((can_id, data[:3]),)
        if ("node.duplicate", place) in self._on:
            return ((can_id, data), (can_id, bytes(len(data)) if is_reading else data))
        false = self._false.get(place)
        return ((can_id, data),) if false is None else self._told(place, false, can_id, data)

    def _told(self, place: int, false: FalseReadings, can_id: int, data: bytes) -> tuple[Frame, ...]:
        """A node's frame with what falsehoods make of it, and a second node's where there is one."""
        device = self.arm.device(place)
        assert isinstance(device, Node)
        pdo = next((each for each in device.pdos(receive=False) if each.cob_id == can_id), None)
        if pdo is None or len(data) != pdo.packed.itemsize:
            return ((can_id, data),)
        pairs = zip(pdo.packed.names or (), pdo.keys, strict=True)
        carried = {OBJECTS[index]: name for name, (index, _) in pairs if index in OBJECTS}
        units, found = self.arm.drives.units(place), []
        for second in (False, True) if false.repeated(tuple(carried)) else (False,):
            values = np.frombuffer(data, pdo.packed).copy()
            for quantity, name in carried.items():
                unit = units[QUANTITIES.index(quantity)]
                told = false.told(quantity, float(values[name][0]) * unit, second) / unit
                ends = np.iinfo(values[name].dtype)
                values[name] = min(max(round(told), ends.min), ends.max)
            found.append((can_id, values.tobytes()))
        return tuple(found)

    def _strikes(self, fault: str, place: int) -> bool:
        share = self._on.get((fault, place))
        return share is not None and self._random.random() < share

    def _error(self, kind: int) -> None:
        self.outbox.append((ERROR | kind, bytes(8)))
