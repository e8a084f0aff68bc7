"""CiA 402 drives on one bus: orders become RPDOs and SYNC, TPDOs become readings; SDO sets everything up."""

import math
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.board import NO_STATUS, Board, Event
from armlink.drives.canopen import controller_setup as device
from armlink.drives.canopen import emcy, faults, torque_sensor_record
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.check.guard_rules import NodeRules, shared_rules
from armlink.drives.canopen.cia402 import (
    CYCLIC_VELOCITY,
    Control,
    State,
    loop_gain,
    next_control,
    set_point_control,
    state_of,
    supports,
    velocity_towards,
)
from armlink.drives.canopen.eds_file import of_joints
from armlink.drives.canopen.host_frames import HostFrames
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import RPDO1, RPDO2, STATUS_DECIMATION, TPDO1, TPDO2, TPDO3
from armlink.drives.canopen.profile import Profile, profile_of
from armlink.drives.canopen.sdo import NodeServices, PumpedNetwork, joint_services
from armlink.drives.canopen.units import Units, assumed_units, read_units
from armlink.drives.family import Ask
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.traits import Traits
from armlink.errors import BadInput, BusFault
from armlink.torque_calibration import Calibration

EMERGENCIES_KEPT = 64
"""So many emergencies are kept; a storm of them costs no memory."""
NO_MODE = 0
"""Stands for the mode display of a joint that has sent none: no mode is active."""
OFF, PROFILE_POSITION = int(Mode.OFF), int(Mode.PROFILE_POSITION)
ENABLE, DISABLE_VOLTAGE = int(Control.ENABLE), int(Control.DISABLE_VOLTAGE)
FAULT_RESET, QUICK_STOP = int(Control.FAULT_RESET), int(Control.QUICK_STOP)
INT16_MAX, INT32_MAX, UINT32_MAX = 2**15 - 1, 2**31 - 1, 2**32 - 1
_TARGETS = {Power.ON: State.ENABLED, Power.OFF: State.SWITCH_ON_DISABLED, Power.STOPPED: State.QUICK_STOP}
_POWERS = {
    State.ENABLED: Power.ON,
    State.QUICK_STOP: Power.STOPPED,
    State.FAULT: Power.FAULT,
    State.FAULT_REACTION: Power.FAULT,
    State.SWITCH_ON_DISABLED: Power.OFF,
    State.NOT_READY: Power.OFF,
    State.READY: Power.READY,
    State.SWITCHED_ON: Power.READY,
}
_ALL = (-INT32_MAX - 1, INT32_MAX)
_NO_LIMITS = Limits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_SYNC: Frame = (objects.SYNC_ID, b"")
_OPERATIONAL = bytes([objects.OPERATIONAL])


class CanopenDrives:
    """Implements `armlink.drives.family.Drives`, `FillsBoard` and `KeepsCalibration`."""

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint], traits: Traits) -> None:
        """The drives of these joints; `traits` of one with our torque sensor record."""
        section = arm.require_link()
        self.arm, self.rows = arm, tuple(joints)
        self.names = tuple(joint.name for joint in joints)
        self.nodes = tuple(joint.settings.node for joint in joints)
        self.m = m = len(self.rows)
        self.protection = device.protection_of(section, self.nodes)
        self.profiles = [profile_of(joint.settings) for joint in joints]
        self.units: list[Units] = list(assumed_units(joints))
        self._host_frames = HostFrames(self.nodes, self.protection.host)
        self.beating = True
        """Whether the host's heartbeat is sent; not, so that the joints' watching it is put to the test."""
        self.statuses, self.displays = [NO_STATUS] * m, [NO_MODE] * m
        """Newest status word (6041h) and mode display (6061h) of each joint."""
        self.emergencies: deque[tuple[int, int, int]] = deque(maxlen=EMERGENCIES_KEPT)
        """(joint, code, error register) in the order of arrival, the newest; resets (code 0) are not kept."""
        self.node_states: dict[int, int] = {}
        """Joint → NMT state of its newest heartbeat."""
        self.restarted: set[int] = set()
        """Joints whose controller has sent its boot-up message."""
        self._traits, self._deadline = traits, section.deadline
        self.beat_every, self._period = section.deadline / 2, 1.0 / section.rate
        """Time from one heartbeat of the host to the next [s]."""
        self._beat = -math.inf
        self._joint_of = {node: joint for joint, node in enumerate(self.nodes)}
        self._supported = [0] * m
        self._modes, self._mode_since = [OFF] * m, [-math.inf] * m
        self._words, self._walking = [FAULT_RESET] * m, [False] * m
        self._limits = [_NO_LIMITS] * m
        self._sent: list[bytes | None] = [None] * m
        self._command_ids = tuple(RPDO1.cob_base + node for node in self.nodes)
        self._heartbeat: Frame = (objects.HEARTBEAT_ID + self.protection.host, _OPERATIONAL)
        self._known = faults.Known(
            self.names,
            self.statuses,
            self.displays,
            self._mode_since,
            self.emergencies,
            self.node_states,
            self.restarted,
        )
        self._seen, self._aimed = [math.nan] * m, [math.nan] * m
        """Newest reading of each joint, and the last target of one that is led by velocity [rad]."""
        self._board: Board | None = None
        self._places: Sequence[int] = range(m)
        self._network: PumpedNetwork | None = None
        self._services: tuple[NodeServices, ...] = ()
        self._map()

    def _map(self) -> None:
        """Layouts of the PDOs by the profiles."""
        self._layouts: list[dict[str, struct.Struct]] = [
            {each.name: each.layout for each in profile.pdos} for profile in self.profiles
        ]
        self._entries: list[dict[str, tuple[Entry, ...]]] = [
            {each.name: each.entries for each in profile.pdos} for profile in self.profiles
        ]
        self._any_velocity = any(profile.by_velocity for profile in self.profiles)
        self._with_torque = [objects.TARGET_TORQUE in entries[RPDO1.name] for entries in self._entries]
        self._compile()

    def _compile(self) -> None:
        """What each cycle needs of layouts, units and windows, in one place."""
        self._compiled: list[tuple[int, Callable[..., bytes], float, float, float, float, int, int]] = []
        self._read: list[tuple[int, Callable[[bytes], tuple[int, ...]], float, float, float]] = []
        for joint, (layouts, unit, limits) in enumerate(zip(self._layouts, self.units, self._limits, strict=True)):
            low, high = math.ceil(limits.lower / unit.position), math.floor(limits.upper / unit.position)
            torque = unit.torque if self._with_torque[joint] else 0.0
            window = (limits.lower, limits.upper, low, high)
            self._aimed[joint] = math.nan
            self._compiled.append((self._command_ids[joint], layouts[RPDO1.name].pack, torque, unit.position, *window))
            profile, layout = self.profiles[joint], layouts[TPDO1.name]
            scale = 0.0 if profile.reading is None else profile.torque_scale
            self._read.append((layout.size, layout.unpack, unit.position, scale, profile.torque_zero))

    # ---- what they are

    def traits(self, joint: int) -> Traits:
        """See Drives."""
        settings, profile = self.rows[joint].settings, self.profiles[joint]
        if settings.torque == "record" and settings.calibration is None:
            return self._traits
        watched = profile.has(objects.RPDO_DEADLINE) or profile.has(objects.HEARTBEAT_CONSUMER)
        bounds = [(objects.MAX_TORQUE, "torque"), (objects.POSITION_LOWER, "window")]
        return Traits(
            torque="current" if profile.reading is None else "link",
            calibration=settings.calibration or ("controller" if settings.torque == "record" else "host"),
            silence="holds" if watched else "keeps on",
            bounds=tuple(bound for entry, bound in bounds if profile.has(entry)),  # type: ignore[misc]
            cadence="sync",
            frame="11",
        )

    def routes(self) -> Mapping[int, int]:
        """See Drives."""
        services = (TPDO1.cob_base, TPDO2.cob_base, TPDO3.cob_base, objects.EMCY_ID, objects.HEARTBEAT_ID, 0x580)
        return {base + node: joint for joint, node in enumerate(self.nodes) for base in services}

    def commands(self) -> Mapping[int, str]:
        """See Drives."""
        return self._host_frames.by_id

    def intrusion(self, can_id: int, data: bytes) -> str:
        """See Drives: what only a host sends, and SDO requests that write, but of settings and calibration."""
        return self._host_frames(can_id, data)

    def cycle_bits(self) -> float:
        """See Drives: RPDO1 and TPDO1 in every cycle, TPDO2 in every fourth, SYNC."""
        each = sum(longest_frame_bits(pdo.layout.size) for pdo in (RPDO1, TPDO1))
        slow = longest_frame_bits(TPDO2.layout.size) / STATUS_DECIMATION
        return self.m * (each + slow) + longest_frame_bits(0)

    def cycle_ids(self) -> frozenset[int]:
        """See Drives."""
        return frozenset((objects.SYNC_ID,))

    def services(self, ask: Ask) -> tuple[NodeServices, ...]:
        """SDO access to each joint's controller."""
        if self._network is None:
            self._network = PumpedNetwork(ask.send)
            self._services = joint_services(self._network, self.arm, self.rows, ask.wait)
        return self._services

    def missing(self, ask: Ask) -> list[int]:
        """See Drives."""
        return [joint for joint, services in enumerate(self.services(ask)) if not services.present()]

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """See Drives."""
        found = []
        for joint, services in enumerate(self.services(ask)):
            address = self.rows[joint].settings.address
            if not services.present():
                found.append(DriveIdentity(joint, address, present=False))
                continue
            told = device.identify(services)
            serial = f"{told.vendor:x}:{told.product:x}:{told.revision:x}:{told.serial}"
            power = _POWERS.get(told.state, Power.UNKNOWN)
            found.append(DriveIdentity(joint, address, True, told.name, serial, power=power))
        return found

    # ---- set-up

    def fits(self, limits: Sequence[Limits]) -> None:
        """See Drives: data sheets are read, limits tried with the usual units."""
        of_joints(self.arm, self.rows)
        for row, limit, unit in zip(self.rows, limits, assumed_units(self.rows), strict=True):
            check_fits(row.name, limit, unit)

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """See Drives: nodes pre-operational, everything set and read back, nodes started (NMT)."""
        all_services = self.services(ask)
        for services, row in zip(all_services, self.rows, strict=True):
            device.check_identity(services, row)
        for node in self.nmt_targets():
            self.send_nmt(ask, objects.NMT_PRE_OPERATIONAL, node)
        found = []
        self._limits = list(limits)
        for joint, services in enumerate(all_services):
            self.profiles[joint] = device.examined(services, self.rows[joint].settings)
        self._map()
        for joint, services in enumerate(all_services):
            found.append(self._set_up(joint, services, limits[joint]))
        self._compile()
        self._beat = -math.inf
        self._words, self._walking, self._modes = [FAULT_RESET] * self.m, [False] * self.m, [OFF] * self.m
        for node in self.nodes:
            self.send_nmt(ask, objects.NMT_START, node)
        return found

    def guard_rules(self, ask: Ask, limits: Sequence[Limits]) -> dict[str, Any]:
        """See Guarded: scales and objects as the devices tell them."""
        rules: dict[str, Any] = {"frames": shared_rules(self.nodes, self.protection.host), "stop": [], "restarts": {}}
        for row, services, limit in zip(self.rows, self.services(ask), limits, strict=True):
            device.check_identity(services, row)
            unit, profile = read_units(services, row), device.examined(services, row.settings)
            if profile.by_velocity:
                raise BadInput(f"{row.name}: led by velocity (mode 9): no frame tells a guard where that ends")
            check_fits(row.name, limit, unit)
            sheet = list(services.remote.object_dictionary)
            node = NodeRules(row.name, row.settings.node, profile, unit, limit, self.protection, sheet)
            rules["frames"] |= node.frames()
            rules["stop"].append(node.stop)
            boot_up, answers = node.restart
            rules["restarts"][f"{boot_up}"] = answers
        return rules

    def nmt_targets(self) -> tuple[int, ...]:
        """Whom NMT commands go to: all, or these nodes where others may be on the bus."""
        return (0,) if all(row.settings.torque == "record" for row in self.rows) else self.nodes

    def _set_up(self, joint: int, services: NodeServices, limits: Limits) -> Setup:
        row, profile = self.rows[joint], self.profiles[joint]
        unit = read_units(services, row)
        check_fits(row.name, limits, unit)
        supported = self.offered(services, joint)
        device.configure(services, row, unit, limits, self.protection, supported, profile)
        self.units[joint], self._supported[joint] = unit, supported
        torque = services.read(objects.MOTOR_TORQUE) * unit.torque if profile.has(objects.MOTOR_TORQUE) else math.nan
        if profile.has(objects.MODE_DISPLAY):
            self.displays[joint] = services.read(objects.MODE_DISPLAY)
        self.statuses[joint] = services.read(objects.STATUS_WORD)
        if self._board is not None:
            self._board.status[self._places[joint]] = self.statuses[joint]
        self._seen[joint] = services.read(objects.POSITION) * unit.position
        return Setup(
            position=self._seen[joint],
            torque=torque,
            position_step=max(unit.position, unit.encoder_step),
            modes=usable_modes(supported, profile),
            lost=profile.lost,
            scales={"torque [N·m]": unit.torque, "position [rad]": unit.position, "velocity [rad/s]": unit.velocity},
        )

    def offered(self, services: NodeServices, joint: int) -> int:
        """Modes of a device as bits of 6502h; raises BusFault where one that the link needs is not among them."""
        if self.rows[joint].settings.torque == "record":
            return device.check_modes(services)
        return device.offered_modes(services)

    def send_nmt(self, ask: Ask, command: int, node: int = 0) -> None:
        """An NMT command (CiA 301) to one node, or to all."""
        ask.send(objects.NMT_ID, bytes([command, node]))

    def beat(self, ask: Ask) -> None:
        """The host's heartbeat, at once."""
        ask.send(*self._heartbeat)
        self._beat = ask.now()

    def recover(self, ask: Ask) -> None:
        """See Drives: start the nodes that left operation."""
        self.beat(ask)  # their watches have run on
        for node in self.nodes:
            self.send_nmt(ask, objects.NMT_START, node)

    # ---- orders to frames

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        """See Drives: RPDO2 where a mode changes, RPDO1 of every joint, heartbeat when due, SYNC."""
        modes: list[Frame] = []
        commands: list[Frame] = []
        rows = self._compiled
        for joint, order in enumerate(orders):
            if order is None:
                self._sent[joint], self._walking[joint] = None, False
                continue
            power, walk, mode, position, _, torque, _, _, _ = order
            if walk:
                word = self._step(joint, order, modes, now)
            else:
                self._walking[joint] = False
                if power is Power.ON:
                    word = ENABLE
                    if mode and self._own_mode(joint, mode) != self._modes[joint]:
                        self._select(joint, mode, modes, now)
                    if mode == PROFILE_POSITION:
                        word = set_point_control(self.statuses[joint])
                else:
                    word = QUICK_STOP if power is Power.STOPPED else DISABLE_VOLTAGE
            if self.profiles[joint].by_velocity:
                data = self._velocity_frame(joint, word, order)
                self._words[joint], self._sent[joint] = word, data
                commands.append((self._command_ids[joint], data))
                continue
            can_id, pack, torque_unit, position_unit, lower, upper, low, high = rows[joint]
            if not lower <= position <= upper:
                low, high = -INT32_MAX - 1, INT32_MAX
            target = max(low, min(high, round(position / position_unit)))
            data = pack(word, int(torque / torque_unit), target) if torque_unit else pack(word, target)
            self._words[joint], self._sent[joint] = word, data
            commands.append((can_id, data))
        if modes:
            commands = modes + commands
        if self.beating and now - self._beat > self.beat_every - 0.5 * self._period:
            commands.append(self._heartbeat)
            self._beat = now
        commands.append(_SYNC)
        return commands

    def _velocity_frame(self, joint: int, word: int, order: Order) -> bytes:
        """RPDO1 of a joint that is led by velocity; none where it is not enabled."""
        velocity, before = 0.0, self._aimed[joint]
        if word == ENABLE:
            before = order.position if math.isnan(before) else before
            velocity = velocity_towards(order.position, before, self._seen[joint], self._limits[joint])
        self._aimed[joint] = order.position if word == ENABLE else math.nan
        counts = int(velocity / self.units[joint].velocity)
        return self._layouts[joint]["RPDO1"].pack(word, max(-INT32_MAX, min(INT32_MAX, counts)))

    def _own_mode(self, joint: int, mode: int) -> int:
        """The device's mode for one of an order."""
        return CYCLIC_VELOCITY if self.profiles[joint].by_velocity and mode == Mode.POSITION else mode

    def _select(self, joint: int, mode: int, frames: list[Frame], now: float) -> None:
        mode = self._own_mode(joint, mode)
        self._modes[joint], self._mode_since[joint] = mode, now
        if RPDO2.name in self._layouts[joint]:
            frames.append((RPDO2.cob_base + self.nodes[joint], struct.pack("<b", mode)))

    def _step(self, joint: int, order: Order, frames: list[Frame], now: float) -> int:
        """Control word of the next step towards the power of an order; the first of a walk changes nothing yet, so that
        the next one is an edge; a joint with power keeps it."""
        target, state = _TARGETS[order.power], state_of(self.statuses[joint])
        if not self._walking[joint]:
            self._walking[joint] = True
            self._select(joint, order.mode, frames, now)
            if state is State.QUICK_STOP:
                return QUICK_STOP
            return next_control(state, target) if state is State.ENABLED else DISABLE_VOLTAGE
        reset_again = state is State.FAULT and self._words[joint] == FAULT_RESET
        return DISABLE_VOLTAGE if reset_again else next_control(state, target)

    def sent(self, joint: int) -> Order | None:
        """See Drives."""
        data = self._sent[joint]
        if data is None:
            return None
        return self._decoded(joint, data)

    def _decoded(self, joint: int, data: bytes) -> Order | None:
        layout, unit = self._layouts[joint]["RPDO1"], self.units[joint]
        if len(data) != layout.size:
            return None
        values = layout.unpack(data)
        torque = values[1] * unit.torque if self._with_torque[joint] else math.nan
        word = values[0] & 0x8F
        power = Power.ON if word == ENABLE else Power.STOPPED if word & 0x86 == QUICK_STOP else Power.OFF
        if self.profiles[joint].by_velocity:
            velocity, gain = values[-1] * unit.velocity, loop_gain(self._period)
            mode = Mode.POSITION if self._modes[joint] else OFF
            return Order(power, False, mode, self._aim(joint, velocity / gain), velocity, math.nan, 0.0, 0.0)
        return Order(power, False, self._modes[joint], values[-1] * unit.position, 0.0, torque, 0.0, 0.0)

    def _aim(self, joint: int, way: float) -> float:
        """Where a velocity leads that would be so much way by the position loop [rad].

        A joint outside its window that is led back, or rests, counts as being at the window's end.
        """
        seen, limits = self._seen[joint], self._limits[joint]
        if (seen < limits.lower and way >= 0) or (seen > limits.upper and way <= 0):
            return limits.lower if seen < limits.lower else limits.upper
        return seen + way

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """See Drives."""
        joint = self._joint_of.get(can_id - RPDO1.cob_base)
        order = None if joint is None else self._decoded(joint, data)
        if joint is None or order is None:
            return None
        return joint, order._replace(velocity=math.nan, kp=math.nan, kd=math.nan)

    # ---- frames to readings

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """See FillsBoard."""
        self._board, self._places = board, places
        table: dict[int, Callable[[bytes], None]] = {}
        for joint, node in enumerate(self.nodes):
            table[TPDO1.cob_base + node] = partial(self._take_reading, joint, places[joint], board)
            table[TPDO2.cob_base + node] = partial(self._take_slow, joint, places[joint], board)
            table[TPDO3.cob_base + node] = partial(self._take_display, joint, places[joint], board)
        return table

    def _take_reading(self, joint: int, place: int, board: Board, data: bytes) -> None:
        size, unpack, unit, scale, zero = self._read[joint]
        if len(data) != size:
            board.errors += 1
        elif scale:
            position, torque = unpack(data)
            board.reading(place, position * unit, (torque - zero) * scale)
            self._seen[joint] = position * unit
        else:
            self._seen[joint] = seen = unpack(data)[0] * unit
            board.reading(place, seen, math.nan)

    def _reading(self, joint: int, data: bytes) -> tuple[float, float] | None:
        size, unpack, unit, scale, zero = self._read[joint]
        if len(data) != size:
            return None
        values = unpack(data)
        return values[0] * unit, (values[1] - zero) * scale if scale else math.nan

    def _take_slow(self, joint: int, place: int, board: Board, data: bytes) -> None:
        slow = self._slow(joint, data)
        if slow is None:
            board.errors += 1
        else:
            self.statuses[joint] = board.status[place] = slow[0]
            board.slow(place, slow[1], slow[2])

    def _slow(self, joint: int, data: bytes) -> tuple[int, float, float] | None:
        layout = self._layouts[joint]["TPDO2"]
        if len(data) != layout.size:
            return None
        values, unit = layout.unpack(data), self.units[joint]
        if len(values) == 3:
            return values[0], values[1] * unit.torque, values[2] * unit.velocity
        told = dict(zip(self._entries[joint]["TPDO2"], values, strict=True))
        motor, velocity = told.get(objects.MOTOR_TORQUE, math.nan), told.get(objects.VELOCITY, math.nan)
        return values[0], motor * unit.torque, velocity * unit.velocity

    def _take_display(self, joint: int, place: int, board: Board, data: bytes) -> None:
        layout = self._layouts[joint]["TPDO3"]
        if len(data) != layout.size:
            board.errors += 1
            return
        values = layout.unpack(data)
        self.statuses[joint] = board.status[place] = values[0]
        if len(values) == 2:
            self.displays[joint] = values[1]

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """See Drives. The cyclic frames of a link take the way of `fill`; emergencies, heartbeats and SDO come here."""
        joint, service = self._joint_of.get(can_id & 0x7F), can_id & ~0x7F
        if joint is None:
            return None
        if service == objects.EMCY_ID:
            self._take_emergency(joint, data)
            return None
        if service == objects.HEARTBEAT_ID:
            self.node_states[joint] = state = data[0] & 0x7F if data else 0
            if state == 0:
                self.restarted.add(joint)
        elif service == 0x580:
            if self._network is not None:
                self._network.notify(can_id, bytearray(data), 0.0)
        elif service == TPDO1.cob_base and (reading := self._reading(joint, data)) is not None:
            return Reading(joint, reading[0], sensor_torque=reading[1])
        elif service == TPDO2.cob_base and (slow := self._slow(joint, data)) is not None:
            self.statuses[joint] = slow[0]
            return Reading(joint, velocity=slow[2], motor_torque=slow[1], power=self.power(joint))
        return None

    def _take_emergency(self, joint: int, data: bytes) -> None:
        code, register = emcy.parse(data)
        if not code:
            return
        self.emergencies.append((joint, code, register))
        if self._board is not None:
            evidence = {"code": code, "register": register}
            self._board.events.append(Event(self._places[joint], f"{code:04X}h", emcy.name_of(code), evidence))

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        """See Drives: node id and NMT state; only operational nodes send TPDOs."""
        nmt = objects.OPERATIONAL if sends else self.node_states.get(joint)
        told = None if nmt is None else objects.NMT_STATES.get(nmt, str(nmt))
        return {"node": self.nodes[joint], "nmt": told}

    def reading_ids(self) -> Mapping[int, int]:
        """See Drives: TPDO1."""
        return {TPDO1.cob_base + node: joint for joint, node in enumerate(self.nodes)}

    def poll(self, first: bool) -> list[Frame]:
        """See Drives: SYNC, nodes started (NMT) before the first."""
        start: list[Frame] = [(objects.NMT_ID, bytes([objects.NMT_START, 0]))]
        return start if first else [_SYNC]

    def replayed(self, first: bool, readings: Sequence[Reading]) -> list[Frame]:
        """See Replays: SYNC and TPDO1, TPDO2 if its values are there; the joints are enabled, in no mode."""
        frames = [_SYNC]
        for reading in readings:
            joint = reading.joint
            node, unit, profile = self.nodes[joint], self.units[joint], self.profiles[joint]
            if math.isfinite(reading.position) and (profile.reading is None or math.isfinite(reading.sensor_torque)):
                counts = [_whole(reading.position / unit.position, 31)]
                if profile.reading is not None:
                    counts.append(_whole(reading.sensor_torque / profile.torque_scale + profile.torque_zero, 31))
                frames.append((TPDO1.cob_base + node, self._layouts[joint]["TPDO1"].pack(*counts)))
            if first:
                frames.append((TPDO3.cob_base + node, TPDO3.layout.pack(faults.ENABLED_BITS, 0)))
            if math.isfinite(reading.motor_torque) and math.isfinite(reading.velocity):
                motor = _whole(reading.motor_torque / unit.torque, 15)
                velocity = _whole(reading.velocity / unit.velocity, 31)
                frames.append((TPDO2.cob_base + node, TPDO2.layout.pack(faults.ENABLED_BITS, motor, velocity)))
        return frames

    # ---- states

    def power(self, joint: int) -> Power:
        """See Drives."""
        return _POWERS.get(state_of(self.statuses[joint]), Power.UNKNOWN)

    def state_request(self, joint: int) -> list[Frame]:
        """See Drives: TPDO3 tells a change by itself."""
        return []

    def lets_go(self, joint: int) -> bool:
        """See Drives."""
        return self.power(joint) in (Power.OFF, Power.READY, Power.FAULT)

    def ready(self, joint: int) -> bool:
        """See Drives."""
        told = "TPDO3" not in self._layouts[joint] or len(self._entries[joint]["TPDO3"]) < 2
        return self.power(joint) is Power.ON and (told or self.displays[joint] == self._modes[joint])

    def alarm(self) -> BusFault | None:
        """See Drives."""
        if self.emergencies or self.restarted or self.node_states:
            return faults.alarm(self._known)
        return None

    def fault(self, modes: Sequence[int], now: float) -> BusFault | None:
        """See Drives."""
        own = [self._own_mode(joint, mode) for joint, mode in enumerate(modes)] if self._any_velocity else modes
        return faults.state_fault(self._known, now, own, self._deadline)

    def has_restarted(self) -> int | None:
        """See Drives."""
        return min(self.restarted, default=None)

    def own_stop(self) -> str:
        """See Drives."""
        return faults.stopped_itself(self._known)

    def stuck(self, joint: int, target: Power, seconds: float) -> str:
        """See Drives."""
        return faults.stuck(self._known, joint, _TARGETS[target], self._modes[joint], seconds)

    def forget(self, restarts: bool = False) -> None:
        """See Drives."""
        if restarts:
            self.restarted.clear()
        self._walking = [False] * self.m
        self.emergencies.clear()
        self.node_states.clear()

    def temperature(self, joint: int, ask: Ask) -> float:
        """See Drives."""
        return device.read_temperature(self.services(ask)[joint])

    # ---- calibration in the controller

    def read_calibration(self, joint: int, ask: Ask) -> Calibration:
        """See KeepsCalibration."""
        return torque_sensor_record.read_record(self.services(ask)[joint])

    def write_calibration(self, joint: int, ask: Ask, calibration: Calibration, store: bool = False) -> Calibration:
        """See KeepsCalibration."""
        return torque_sensor_record.write_record(self.services(ask)[joint], calibration, store)


def usable_modes(supported: int, profile: Profile) -> frozenset[int]:
    """Modes that a device can be ordered in while it cycles: where its mode cannot be mapped, the one it is left in."""
    if profile.by_velocity:
        return frozenset((int(Mode.OFF), int(Mode.POSITION)))
    modes = frozenset(int(mode) for mode in Mode if supports(supported, mode))
    if profile.modes_by_pdo:
        return modes
    return modes & {min((Mode.POSITION, Mode.PROFILE_POSITION), key=lambda mode: mode not in modes)}


def check_fits(name: str, limits: Limits, unit: Units) -> None:
    """Raise BadInput where limits fit no frame and no object."""
    if limits.max_torque / unit.torque > INT16_MAX:
        most = INT16_MAX * unit.torque
        raise BadInput(f"{name}: max_torque {limits.max_torque} N·m: 6071h carries at most {most:.6g} N·m")
    if limits.max_velocity / unit.velocity > UINT32_MAX:
        fastest = UINT32_MAX * unit.velocity
        raise BadInput(f"{name}: max_velocity {limits.max_velocity} rad/s: 6081h carries at most {fastest:.6g} rad/s")
    if limits.torque_rate / unit.torque > UINT32_MAX:
        most = UINT32_MAX * unit.torque
        raise BadInput(f"{name}: max_torque_rate {limits.torque_rate} N·m/s: 6087h carries at most {most:.6g} N·m/s")
    if max(abs(limits.lower), abs(limits.upper)) / unit.position > INT32_MAX:
        raise BadInput(f"{name}: its range is more than 607Ah carries at {unit.position:.3g} rad a user unit")


def _whole(value: float, bits: int) -> int:
    return max(-(1 << bits), min((1 << bits) - 1, round(value)))
