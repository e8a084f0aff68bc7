"""CiA 402 drives on one bus: what they are, their set-up by SDO, states and calibration; cycles are in `cyclic`."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.base import Ask, BasicDrives, DriveMemory
from armlink.drives.board import Board
from armlink.drives.canopen import controller_setup as device
from armlink.drives.canopen import faults, torque_sensor_record
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.check.guard_rules import guard_rules
from armlink.drives.canopen.cia402 import DriveState, state_of
from armlink.drives.canopen.cyclic.commands import SYNC, TARGETS, CommandFrames
from armlink.drives.canopen.cyclic.readings import ReadingFrames
from armlink.drives.canopen.cyclic.wire import Wire, check_fits
from armlink.drives.canopen.eds_file import of_joints
from armlink.drives.canopen.pdo import RPDO1, RPDO_BASES, STATUS_DECIMATION, TPDO1, TPDO2, TPDO3
from armlink.drives.canopen.profile import Profile, profile_of
from armlink.drives.canopen.sdo import NodeServices, PumpedNetwork
from armlink.drives.canopen.settings import TRAITS
from armlink.drives.canopen.units import assumed_units, read_units, unit_doubt
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup
from armlink.drives.traits import Traits
from armlink.errors import ArmlinkError, BusFault
from armlink.torque_calibration import Calibration

log = logging.getLogger("armlink")
_POWERS = {
    DriveState.ENABLED: Power.ON,
    DriveState.QUICK_STOP: Power.STOPPED,
    DriveState.FAULT: Power.FAULT,
    DriveState.FAULT_REACTION: Power.FAULT,
    DriveState.SWITCH_ON_DISABLED: Power.OFF,
    DriveState.NOT_READY: Power.OFF,
    DriveState.READY: Power.READY,
    DriveState.SWITCHED_ON: Power.READY,
}
_DOWNLOADS = (1, 6)
"""Command specifiers of SDO requests that write: initiate download, block download (CiA 301, 7.2.4.3)."""
_HARMLESS_WRITES = (0x1010, 0x2100)
"""Objects that another program may write: they store settings or hold the torque sensor's calibration."""


class CanopenDrives(BasicDrives[DriveMemory]):
    """The nodes of one bus, all with one SYNC."""

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS)
        section = arm.require_link()
        self.arm, self.nodes = arm, tuple(settings.node for settings in self.settings)
        self.protection = device.protection_of(section, self.nodes)
        self._commands = {
            objects.NMT_ID: "NMT command",
            objects.SYNC_ID: "SYNC",
            objects.LSS_ID: "LSS command",
            objects.HEARTBEAT_ID + self.protection.host: "heartbeat of the host",
            **{base + node: f"RPDO{k} of node {node}" for k, base in enumerate(RPDO_BASES, 1) for node in self.nodes},
        }
        self._deadline = section.deadline
        self._joint_of = {node: joint for joint, node in enumerate(self.nodes)}
        self.known = faults.JointStates(self.names)
        self._sound: tuple[list[int], list[int], list[int]] | None = None
        """Modes, mode displays and status words that were no fault when last seen, every mode being displayed."""
        self.beat_every = section.deadline / 2
        """Time from one heartbeat of the host to the next [s]."""
        self.cycle = CommandFrames(self.known, self.protection.host, self.beat_every, 1.0 / section.rate)
        self._readings = ReadingFrames(self.known)
        self.wires: list[Wire] = []
        profiles = [profile_of(settings) for settings in self.settings]
        self._use([Wire(*row) for row in zip(self.nodes, profiles, assumed_units(joints), strict=True)])
        self._network: PumpedNetwork | None = None
        self._services: tuple[NodeServices, ...] = ()

    def _use(self, wires: list[Wire]) -> None:
        """Layouts, scales and limits of the cycles from now on."""
        self.wires = wires
        self.cycle.use(wires)
        self._readings.use(wires)

    # ---- what they are

    def traits(self, joint: int) -> Traits:
        settings, profile = self.settings[joint], self.wires[joint].profile
        if settings.torque == "record" and settings.calibration is None:
            return TRAITS
        watched = profile.has(objects.RPDO_DEADLINE) or profile.has(objects.HEARTBEAT_CONSUMER)
        bounds = [(objects.MAX_TORQUE, "torque"), (objects.POSITION_LOWER, "window")]
        return Traits(
            torque="current" if profile.reading is None else "link",
            calibration=settings.calibration or ("controller" if settings.torque == "record" else "host"),
            silence="holds" if watched else "keeps on",
            bounds=tuple(bound for entry, bound in bounds if profile.has(entry)),  # type: ignore[misc]
            cadence="sync",
            frame="11",
            torque_cycles=STATUS_DECIMATION if profile.reading is None else 1,
        )

    def routes(self) -> Mapping[int, int]:
        pdos = [pdo.cob_base for pdo in (TPDO1, TPDO2, TPDO3)]
        services = (*pdos, objects.EMCY_ID, objects.HEARTBEAT_ID, objects.SDO_RESPONSE_ID)
        return {base + node: joint for joint, node in enumerate(self.nodes) for base in services}

    def commands(self) -> Mapping[int, str]:
        return self._commands

    def intrusion(self, can_id: int, data: bytes) -> str:
        """Frames that only a host sends, and SDO requests that write, but of settings and calibration."""
        node = can_id - objects.SDO_REQUEST_ID
        if node not in self._joint_of or len(data) < 4 or data[0] >> 5 not in _DOWNLOADS:
            return self._commands.get(can_id, "")
        index = int.from_bytes(data[1:3], "little")
        return "" if index in _HARMLESS_WRITES else f"SDO write of {index:04X}h to node {node}"

    def cycle_bits(self) -> float:
        """RPDO1 and TPDO1 in every cycle, TPDO2 in every fourth, SYNC."""
        each = sum(longest_frame_bits(pdo.layout.size) for pdo in (RPDO1, TPDO1))
        slow = longest_frame_bits(TPDO2.layout.size) / STATUS_DECIMATION
        return self.m * (each + slow) + longest_frame_bits(0)

    def cycle_ids(self) -> frozenset[int]:
        return frozenset((objects.SYNC_ID,))

    def services(self, ask: Ask) -> tuple[NodeServices, ...]:
        if self._network is None:
            self._network = network = PumpedNetwork(ask.send)
            pairs = zip(self.rows, of_joints(self.arm, self.rows), strict=True)
            self._services = tuple(
                NodeServices(network, row.name, row.settings.node, each, ask.wait) for row, each in pairs
            )
        return self._services

    def missing(self, ask: Ask) -> list[int]:
        return [joint for joint, services in enumerate(self.services(ask)) if not services.present()]

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        services = self.services(ask)[joint]
        if not services.present():
            return self.absent(joint)
        told = device.identify(services)
        serial = f"{told.vendor:x}:{told.product:x}:{told.revision:x}:{told.serial}"
        power = _POWERS.get(told.state, Power.UNKNOWN)
        return DriveIdentity(joint, self.settings[joint].address, True, told.name, serial, power=power)

    def position(self, joint: int, ask: Ask) -> float:
        services = self.services(ask)[joint]
        try:
            unit = read_units(services, self.rows[joint]).position if services.present() else math.nan
            return float(services.read(objects.POSITION) * unit) if unit == unit else math.nan
        except ArmlinkError:  # told, with its reason, by who checks the units
            return math.nan

    # ---- set-up

    def fits(self, limits: Sequence[Limits]) -> None:
        """Data sheets are read, limits tried with the usual units."""
        of_joints(self.arm, self.rows)
        for row, limit, unit in zip(self.rows, limits, assumed_units(self.rows), strict=True):
            check_fits(row, limit, unit)

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """Nodes pre-operational, everything set and read back, nodes started (NMT)."""
        all_services = self.services(ask)
        for services, row in zip(all_services, self.rows, strict=True):
            device.check_identity(services, row)
        for node in self.nmt_targets():
            self.send_nmt(ask, objects.NMT_PRE_OPERATIONAL, node)
        profiles = [device.examine_device(*each) for each in zip(all_services, self.settings, strict=True)]
        found = [self._set_up(*each) for each in zip(range(self.m), all_services, limits, profiles, strict=True)]
        self._use([wire for wire, _ in found])
        self.cycle.restart()
        for node in self.nodes:
            self.send_nmt(ask, objects.NMT_START, node)
        return [setup for _, setup in found]

    def guard_rules(self, ask: Ask, limits: Sequence[Limits]) -> dict[str, Any]:
        """Scales and objects as the devices tell them."""
        return guard_rules(self.rows, self.services(ask), limits, self.protection)

    def nmt_targets(self) -> tuple[int, ...]:
        """Whom NMT commands go to: all, or these nodes where others may be on the bus."""
        return (0,) if all(settings.torque == "record" for settings in self.settings) else self.nodes

    def _set_up(self, joint: int, services: NodeServices, limits: Limits, profile: Profile) -> tuple[Wire, Setup]:
        row, known = self.rows[joint], self.known
        unit = read_units(services, row)
        if doubt := unit_doubt(services, row):
            log.warning(doubt)
        check_fits(row, limits, unit)
        supported = self.offered(services, joint)
        device.configure(services, row, unit, limits, self.protection, supported, profile)
        torque = services.read(objects.MOTOR_TORQUE) * unit.torque if profile.has(objects.MOTOR_TORQUE) else math.nan
        if profile.has(objects.MODE_DISPLAY):
            known.displays[joint] = services.read(objects.MODE_DISPLAY)
        self._readings.take_status(joint, services.read(objects.STATUS_WORD))
        known.positions[joint] = services.read(objects.POSITION) * unit.position
        setup = Setup(
            position=known.positions[joint],
            torque=torque,
            position_step=max(unit.position, unit.encoder_step),
            modes=profile.usable_modes(supported),
            lost=profile.lost,
            ranges=device.reading_ranges(services, row, unit, limits, profile),
            scales={"torque [N·m]": unit.torque, "position [rad]": unit.position, "velocity [rad/s]": unit.velocity},
        )
        return Wire(self.nodes[joint], profile, unit, limits), setup

    def offered(self, services: NodeServices, joint: int) -> int:
        """Modes of a device as bits of 6502h; raises BusFault where one that the link needs is not among them."""
        if self.settings[joint].torque == "record":
            return device.check_modes(services)
        return device.offered_modes(services)

    def send_nmt(self, ask: Ask, command: int, node: int = 0) -> None:
        ask.send(objects.NMT_ID, bytes([command, node]))

    def beat(self, ask: Ask) -> None:
        ask.send(*self.cycle.heartbeat)
        self.cycle.beaten(ask.now())

    def recover(self, ask: Ask) -> None:
        """Start the nodes that left operation."""
        self.beat(ask)  # their watches have run on
        for node in self.nodes:
            self.send_nmt(ask, objects.NMT_START, node)

    # ---- orders to frames

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        return self.cycle.frames(orders, now)

    def sent(self, joint: int) -> Order | None:
        return self.cycle.sent(joint)

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._joint_of.get(can_id - RPDO1.cob_base)
        order = None if joint is None else self.cycle.decoded(joint, data)
        if joint is None or order is None:
            return None
        return joint, order._replace(velocity=math.nan, kp=math.nan, kd=math.nan)

    # ---- frames to readings

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        return self._readings.fill(board, places)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """Emergencies, heartbeats and SDO; the cyclic frames take the way of `fill`."""
        joint, service = self._joint_of.get(can_id & 0x7F), can_id & ~0x7F
        if joint is None:
            return None
        if service == objects.EMCY_ID:
            self._readings.take_emergency(joint, data)
        elif service == objects.HEARTBEAT_ID:
            self.known.node_states[joint] = state = data[0] & 0x7F if data else 0
            if state == 0:
                self.known.restarted.add(joint)
        elif service == objects.SDO_RESPONSE_ID and self._network is not None:
            self._network.notify(can_id, bytearray(data), 0.0)
        return None

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        """Node id and NMT state; only operational nodes send TPDOs."""
        nmt = objects.OPERATIONAL if sends else self.known.node_states.get(joint)
        told = None if nmt is None else objects.NMT_STATES.get(nmt, str(nmt))
        return {"node": self.nodes[joint], "nmt": told}

    def reading_ids(self) -> Mapping[int, int]:
        return {TPDO1.cob_base + node: joint for joint, node in enumerate(self.nodes)}

    def poll(self, first: bool) -> list[Frame]:
        """SYNC, nodes started (NMT) before the first."""
        start: list[Frame] = [(objects.NMT_ID, bytes([objects.NMT_START, 0]))]
        return start if first else [SYNC]

    def replayed(self, first: bool, readings: Sequence[Reading]) -> list[Frame]:
        return self._readings.replayed(first, readings)

    # ---- states

    def power(self, joint: int) -> Power:
        return _POWERS.get(state_of(self.known.statuses[joint]), Power.UNKNOWN)

    def ready(self, joint: int) -> bool:
        displayed = self.wires[joint].entries.get(TPDO3.name, ())
        told = len(displayed) < 2 or self.known.displays[joint] == self.cycle.modes[joint]
        return told and super().ready(joint)

    def alarm(self) -> BusFault | None:
        return faults.alarm(self.known)

    def fault(self, modes: Sequence[int], now: float) -> BusFault | None:
        known, own = self.known, self.cycle.own_modes(modes)
        if self._sound == (own, known.displays, known.statuses):
            return None
        fault = faults.state_fault(known, now, own, self._deadline)
        if fault is None and own == known.displays:  # no time runs out while nothing changes
            self._sound = (list(own), known.displays.copy(), known.statuses.copy())
        return fault

    def has_restarted(self, joint: int) -> bool:
        return joint in self.known.restarted

    def own_stop(self, joint: int) -> str:
        return faults.stopped_itself(self.known, joint)

    def stuck(self, joint: int, target: Power, seconds: float) -> str:
        return faults.stuck(self.known, joint, TARGETS[target], self.cycle.modes[joint], seconds)

    def forget(self, restarts: bool = False) -> None:
        if restarts:
            self.known.restarted.clear()
        self.cycle.forget_walk()
        self.known.emergencies.clear()
        self.known.node_states.clear()

    def temperature(self, joint: int, ask: Ask) -> float:
        return device.read_temperature(self.services(ask)[joint])

    def serial_number(self, joint: int, ask: Ask) -> str:
        return device.serial_number(self.services(ask)[joint])

    # ---- calibration in the controller

    def read_calibration(self, joint: int, ask: Ask) -> Calibration:
        return torque_sensor_record.read_record(self.services(ask)[joint])

    def write_calibration(self, joint: int, ask: Ask, calibration: Calibration, store: bool = False) -> Calibration:
        return torque_sensor_record.write_record(self.services(ask)[joint], calibration, store)
