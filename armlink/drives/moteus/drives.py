"""moteus controllers on one CAN FD bus: one frame with command and query, one reply a cycle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.port import EXTENDED, Frame
from armlink.drives.base import Ask, BasicDrives, DriveMemory, no_order
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.moteus import frames
from armlink.drives.moteus.frames import (
    COMMAND,
    CYCLE_COMMAND,
    CYCLE_REPLY,
    HOMED_AT_OUTPUT,
    QUERY,
    READ_ERROR,
    REPLY,
    WRITE,
    MoteusRegister,
)
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup, real32_step, real32_within
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BadInput, BusFault


class MoteusSettings(DriveSettings):
    """A moteus controller, on a bus with `fd: true`."""

    family: Literal["moteus"] = "moteus"
    id: Annotated[int, Field(ge=1, le=0x7E)]
    """Controller id (id.id)."""
    source: Annotated[int, Field(ge=0, le=0x7F)] = 0
    """Our id, to which it replies."""
    torque_constant: Positive | None = None
    """Torque constant at its output [N·m/A], by which the scale check compares torque
    with current; None: not compared."""

    @property
    def address(self) -> str:
        return f"controller {self.id}"


TRAITS = Traits(torque="current", calibration="host", silence="damps", bounds=("torque",), cadence="reply", frame="fd")
NOMINAL_BITS, FAST_BITS, FASTER = 60, 40, 5
"""Bits of a CAN FD frame at the nominal rate (29-bit identifier, end) and besides the payload at the fast one, and how
many times faster that is."""
LARGEST_POSITION = 1e4
"""No joint's position is larger [rev]; a larger one is no reading."""
FAULTS = {
    32: "calibration fault",
    33: "motor driver",
    34: "overvoltage",
    35: "encoder",
    36: "motor not configured",
    37: "control loop overrun",
    38: "too hot",
    39: "start outside of servopos.position_min and position_max",
    40: "undervoltage",
    41: "configuration changed",
    42: "no valid commutation encoder",
    43: "no valid output encoder",
    44: "gate driver could not be enabled",
    45: "stop position with limits",
    46: "timing violation",
    47: "back-EMF feed-forward without an acceleration limit",
    48: "invalid position limits",
    49: "position error too large",
    50: "velocity error too large",
}
"""Fault codes of mode 1; in other modes 96 to 105 tell what limits the torque at present."""
POWERS = {
    frames.MoteusMode.STOPPED: Power.OFF,
    frames.MoteusMode.FAULT: Power.FAULT,
    frames.MoteusMode.POSITION: Power.ON,
}
STOPPED_MODES = (frames.MoteusMode.TIMEOUT, frames.MoteusMode.ZERO_VELOCITY, frames.MoteusMode.BRAKE)


@dataclass
class MoteusMemory(DriveMemory):
    mode: int | None = None
    fault: int = 0


class MoteusDrives(BasicDrives[MoteusMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        """Nothing is sent. Raises BadInput for a bus without CAN FD."""
        super().__init__(joints, TRAITS, MoteusMemory)
        self._joint_of = {_reply_id(settings): joint for joint, settings in enumerate(self.settings)}
        section = arm.require_link()
        bus = section.buses[joints[0].bus] if joints[0].bus else section.bus
        if not bus.fd:
            raise BadInput(f"{arm.path}: {joints[0].name}: moteus drives need CAN FD: set `fd: true` for their bus")

    def routes(self) -> Mapping[int, int]:
        return self._joint_of

    def commands(self) -> Mapping[int, str]:
        """Frames to our controllers, from any source, with or without a wish for a reply."""
        return {
            _flagged(head << 8 | settings.id): f"command to {name}"
            for settings, name in zip(self.settings, self.names, strict=True)
            for head in range(0x100)
        }

    def cycle_bits(self) -> float:
        """Identifiers at the nominal rate, the rest five times as fast."""
        payload = CYCLE_COMMAND.size + CYCLE_REPLY.size
        return self.m * (2 * NOMINAL_BITS + (8 * payload + 2 * FAST_BITS) * 1.25 / FASTER)

    def _frame(self, joint: int, data: bytes) -> Frame:
        settings = self.settings[joint]
        return _flagged(frames.identifier(settings.source, settings.id, True)), data

    def poll(self, first: bool) -> list[Frame]:
        return [self._frame(joint, frames.pack({}, QUERY)) for joint in range(self.m)]

    # ---- set-up

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        asked = (
            MoteusRegister.MODEL,
            MoteusRegister.FIRMWARE,
            MoteusRegister.SERIAL1,
            MoteusRegister.SERIAL2,
            MoteusRegister.SERIAL3,
        )
        values = self._ask(ask, joint, {}, asked)
        if values is None:
            return self.absent(joint)
        model, firmware, *serial = (int(values.get(register, 0)) for register in asked)
        text = "".join(f"{part & 0xFFFFFFFF:08X}" for part in reversed(serial))
        return self.present(joint, f"moteus model {model}", text, f"{firmware >> 8 & 0xFF}.{firmware & 0xFF}")

    def position(self, joint: int, ask: Ask) -> float:
        """Only that of the output counts."""
        values = self._ask(ask, joint, {}, (*QUERY, MoteusRegister.HOME_STATE)) or {}
        at_output = values.get(MoteusRegister.HOME_STATE) == HOMED_AT_OUTPUT
        return values.get(MoteusRegister.POSITION, math.nan) * math.tau if at_output else math.nan

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        """Stopped, and referenced to its output; torque and watchdog go with every command."""
        known, name, asked = self.memory[joint], self.names[joint], (*QUERY, MoteusRegister.HOME_STATE)
        values = self._ask(ask, joint, {MoteusRegister.MODE: frames.MoteusMode.STOPPED}, asked)
        if values is None:
            raise self.silent(joint, ", its id is right, and the bus is CAN FD")
        if values.get(MoteusRegister.HOME_STATE) != HOMED_AT_OUTPUT:
            raise BusFault(
                f"{name}: its position is not the position of its output (home state "
                f"{values.get(MoteusRegister.HOME_STATE, math.nan):.0f}, expected 2): set the output "
                "position (register 130h), or use an encoder at the output"
            )
        position = values.get(MoteusRegister.POSITION, math.nan) * math.tau
        if not math.isfinite(position):
            raise BusFault(f"{name}: its drive reports no position")
        known.limits, known.mode = limits, None
        return Setup(
            position=position,
            torque=0.0,
            position_step=real32_step(position / math.tau) * math.tau,
            modes=frozenset((int(Mode.POSITION), int(Mode.TORQUE))),
            notes=("every command carries the largest torque and the time of the watchdog",),
        )

    def _ask(self, ask: Ask, joint: int, writes: Mapping[int, float], asked: Sequence[int]) -> dict[int, float] | None:
        """Values of the registers that came, or None without an answer."""
        reply_id = _reply_id(self.settings[joint])

        def answer(can_id: int, data: bytes) -> dict[int, float] | None:
            if can_id != reply_id:
                return None
            subframes = [each for each in frames.unpack(data) if each.kind in (REPLY, READ_ERROR)]
            if {each.register for each in subframes} != set(asked):
                return None
            return {each.register: each.value for each in subframes if each.kind == REPLY}

        return ask(self._frame(joint, frames.pack(writes, asked)), answer)

    # ---- cycle

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        writes = self._writes(joint, order)
        data = CYCLE_COMMAND.pack(writes) if len(writes) == len(COMMAND) else frames.pack(writes, QUERY)
        told = _order_of(data)
        self.memory[joint].sent = told if told is not None and told.power is Power.ON else None
        return (self._frame(joint, data),)

    def _writes(self, joint: int, order: Order) -> dict[int, float]:
        known = self.memory[joint]
        on = known.mode == frames.MoteusMode.POSITION
        if order.power is Power.STOPPED and known.mode in (frames.MoteusMode.POSITION, *STOPPED_MODES):
            damps = known.mode == frames.MoteusMode.TIMEOUT
            return {} if damps else {MoteusRegister.MODE: frames.MoteusMode.ZERO_VELOCITY}
        if order.power is Power.ON and on:
            return self._command(joint, order)
        if order.power is Power.ON and order.walk and known.mode is not None:
            if known.mode == frames.MoteusMode.STOPPED:
                return self._command(joint, order)
            return {MoteusRegister.MODE: frames.MoteusMode.STOPPED}
        return {MoteusRegister.MODE: frames.MoteusMode.STOPPED} if order.power is Power.OFF else {}

    def _command(self, joint: int, order: Order) -> dict[int, float]:
        limits = self.limits_of(joint)
        if not all(math.isfinite(value) for value in (order.position, order.velocity, order.torque)):
            raise ValueError(f"{self.names[joint]}: the order is not finite: {order}")
        stiff = float(order.mode == Mode.POSITION)
        return {
            MoteusRegister.MODE: frames.MoteusMode.POSITION,
            MoteusRegister.COMMAND_POSITION: order.position / math.tau if stiff else math.nan,
            MoteusRegister.COMMAND_VELOCITY: order.velocity / math.tau if stiff else 0.0,
            MoteusRegister.COMMAND_TORQUE: 0.0 if stiff else real32_within(order.torque, limits.max_torque),
            MoteusRegister.COMMAND_KP_SCALE: stiff,
            MoteusRegister.COMMAND_KD_SCALE: stiff,
            MoteusRegister.COMMAND_MAX_TORQUE: real32_within(math.inf, limits.max_torque),
            MoteusRegister.COMMAND_STOP_POSITION: math.nan,
            MoteusRegister.COMMAND_WATCHDOG: limits.deadline,
            MoteusRegister.COMMAND_ILIMIT_SCALE: stiff,
        }

    def torque_by_current(self, joint: int, ask: Ask) -> tuple[float, float] | None:
        constant = self.settings[joint].torque_constant
        if constant is None:
            return None
        values = self._ask(ask, joint, {}, (MoteusRegister.TORQUE, MoteusRegister.Q_CURRENT))
        if values is None:
            return None
        return values.get(MoteusRegister.TORQUE, math.nan), constant * values.get(MoteusRegister.Q_CURRENT, math.nan)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._joint_of.get(can_id)
        if joint is None:
            return None
        values = CYCLE_REPLY.unpack(data) or {
            each.register: each.value for each in frames.unpack(data) if each.kind == REPLY
        }
        mode, fault = values.get(MoteusRegister.MODE, math.nan), values.get(MoteusRegister.FAULT, math.nan)
        if not math.isfinite(mode):
            return None
        known = self.memory[joint]
        known.mode = int(mode)
        if math.isfinite(fault):
            known.fault = int(fault)
        position = values.get(MoteusRegister.POSITION, math.nan)
        if not abs(position) < LARGEST_POSITION:
            position = math.nan
        return self.note(
            Reading(
                joint,
                position * math.tau,
                _finite(values.get(MoteusRegister.VELOCITY, math.nan)) * math.tau,
                _finite(values.get(MoteusRegister.TORQUE, math.nan)),
                temperature=_finite(values.get(MoteusRegister.TEMPERATURE, math.nan)),
                power=_power(known),
                fault=_fault_text(known),
            )
        )

    def state_request(self, joint: int) -> list[Frame]:
        return [self.poll(first=False)[joint]]

    def own_stop(self, joint: int) -> str:
        if self.memory[joint].mode != frames.MoteusMode.TIMEOUT:
            return ""
        return f"{self.where(joint)}: its watchdog ran out: it damps the motion until it is stopped (mode 11)"

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        for joint, settings in enumerate(self.settings):
            if can_id & 0xFF == settings.id and can_id & 0x1FFFFFFF < 0x10000 and _flagged(can_id & 0xFFFF) == can_id:
                order = _order_of(data)
                return None if order is None else (joint, order)
        return None


def _power(known: MoteusMemory) -> Power:
    if known.mode in STOPPED_MODES:
        return Power.STOPPED
    return POWERS[frames.MoteusMode(known.mode)] if known.mode in POWERS else Power.READY


def _fault_text(known: MoteusMemory) -> str:
    if known.mode == frames.MoteusMode.FAULT:
        return f"{FAULTS.get(known.fault, 'unknown fault')} (fault {known.fault})"
    return ""


def _reply_id(settings: MoteusSettings) -> int:
    return _flagged(settings.id << 8 | settings.source)


def _flagged(number: int) -> int:
    """Identifier with its flag: 29 bits where it does not fit 11."""
    return number | EXTENDED * (number > 0x7FF)


def _order_of(data: bytes) -> Order | None:
    """The order that the bytes of a frame give; None if they command no mode."""
    values = CYCLE_COMMAND.unpack(data) or {
        each.register: each.value for each in frames.unpack(data) if each.kind == WRITE
    }
    mode = values.get(MoteusRegister.MODE)
    if mode is None:
        return None
    if mode != frames.MoteusMode.POSITION:
        power = {0: Power.OFF, 12: Power.STOPPED, 15: Power.STOPPED}.get(int(mode) if math.isfinite(mode) else 0)
        return no_order()._replace(power=power or Power.UNKNOWN)
    stiff = values.get(MoteusRegister.COMMAND_KP_SCALE, 1.0) > 0
    position = values.get(MoteusRegister.COMMAND_POSITION, math.nan) * math.tau
    velocity = values.get(MoteusRegister.COMMAND_VELOCITY, 0.0) * math.tau
    torque = values.get(MoteusRegister.COMMAND_TORQUE, 0.0)
    return Order(Power.ON, False, Mode.POSITION if stiff else Mode.TORQUE, position, velocity, torque, 0.0, 0.0)


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    model = frames.pack({}, (MoteusRegister.MODEL,))
    heard = bus.gather([(_flagged(frames.identifier(0, each, True)), model) for each in range(1, 0x7F)])
    replies = [
        can_id >> 8 & 0x7F
        for can_id, data in heard
        if not can_id & 0x1FFF80FF and any(each[:2] == (REPLY, MoteusRegister.MODEL) for each in frames.unpack(data))
    ]
    return [
        FoundDrive("moteus", each, f"controller {each}", {"id": each}, answers=replies.count(each))
        for each in sorted({*replies} & {*range(1, 0x7F)})
    ]


SEARCH = Discovery(find_drives)
FAMILY = Family(
    "moteus", TRAITS, MoteusSettings, MoteusDrives, discovery=SEARCH, summary="mjbots moteus r4, c1, n1, x1, on CAN FD"
)
