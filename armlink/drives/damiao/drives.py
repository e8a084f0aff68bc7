"""Damiao DM-J drives on one bus, in MIT mode: set-up by registers, one command and one reply a cycle."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import Frame
from armlink.drives.base import Ask
from armlink.drives.damiao import frames
from armlink.drives.damiao.frames import MODELS, OTHER_MODES, READ, TIMEOUT_UNIT, WRITE, DamiaoRegister, DamiaoStatus
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.mit_drives import MitDrives, MitMemory
from armlink.drives.mit_packing import Grid, Ranges, Special, grid_of, special, unpack_feedback, unwrap
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BadInput, BusFault

TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="reply", frame="11")
IDENTITY = (
    DamiaoRegister.HARDWARE_VERSION,
    DamiaoRegister.SOFTWARE_VERSION,
    DamiaoRegister.SERIAL_NUMBER,
    DamiaoRegister.REPLY_ID,
)
RANGE_FIELDS: dict[int, str] = {
    DamiaoRegister.POSITION_RANGE: "position",
    DamiaoRegister.VELOCITY_RANGE: "velocity",
    DamiaoRegister.TORQUE_RANGE: "torque",
}
NOTED_REGISTERS = (
    DamiaoRegister.TORQUE_CONSTANT,
    DamiaoRegister.OVER_CURRENT,
    DamiaoRegister.LARGEST_CURRENT,
    DamiaoRegister.GEAR_RATIO,
)
STOPPING_IDS = range(0x0D, 0x10)
"""Ids whose register requests stop a moteus controller that nobody could find, for its bus was opened without CAN FD:
to it they write a float near 0 to its mode."""
LARGEST_RANGE = 1e4
"""No range of a real drive is larger [rad, rad/s, N·m]."""
REGISTER_KINDS = frozenset((READ, WRITE))
ENABLED = int(DamiaoStatus.ENABLED)
POWERS: dict[int | None, Power] = {DamiaoStatus.DISABLED: Power.OFF, DamiaoStatus.LOST_COMMUNICATION: Power.STOPPED}
NO_FAULTS = frozenset((int(DamiaoStatus.DISABLED), int(DamiaoStatus.ENABLED), int(DamiaoStatus.LOST_COMMUNICATION)))
UNKNOWN_RANGES = Ranges(math.nan, math.nan, math.nan)
LABEL = re.compile(r"DM-?(?P<kind>[JHG]?)(?P<size>\d{4,5})(?P<variant>[A-Z]?)(-?2EC)?([ _-]?(24|48)V)?([ _-]?V[\d.]+)?")
"""A label, such as DM-J4340P-2EC V1.1."""


def model_on_label(label: str) -> str | None:
    """Key of `MODELS` for a label, in whatever case; None for one that is not known.

    Ranges differ by size; a variant that has none of its own has those of its size.
    """
    found = LABEL.fullmatch(label.strip().upper())
    if found is None:
        return None
    size = f"DM{found['kind'].replace('J', '')}{found['size']}"
    return next((model for model in (size + found["variant"], size) if model in MODELS), None)


class DamiaoSettings(DriveSettings):
    """A Damiao DM-J drive in MIT mode."""

    family: Literal["damiao"] = "damiao"
    id: Annotated[int, Field(ge=1, le=0xFF)]
    """Command id (ESC_ID, register 8)."""
    reply: Annotated[int, Field(ge=0, le=0x7FE)]
    """Reply id (MST_ID, register 7)."""
    model: str = ""
    """Model as on its label, for example DM8009 or DM-J8009P-2EC, kept in its short form; a host that only listens
    takes the scales of its frames from it, until it has heard the drive's own."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)]
    """Damping under position control [N·m·s/rad]; 0 with kp makes the motor oscillate."""

    @field_validator("model")
    @classmethod
    def _is_known(cls, label: str) -> str:
        model = model_on_label(label)
        if label and model is None:
            raise ValueError(f"Damiao model {label!r} is unknown; expected {', '.join(MODELS)} (or leave `model` out)")
        return model or ""

    @property
    def address(self) -> str:
        return f"id {self.id:02X}h"


@dataclass
class DamiaoMemory(MitMemory):
    """Its ranges are those that its model is delivered with, until its registers are known."""

    state: int | None = None


class DamiaoDrives(MitDrives[DamiaoMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS, DamiaoMemory)
        for known, settings in zip(self.memory, self.settings, strict=True):
            known.grid = grid_of(MODELS[settings.model]) if settings.model in MODELS else None
        self._replies = {(each.reply, each.id & 0xF): joint for joint, each in reversed([*enumerate(self.settings)])}
        """Joint by reply id and by the id in a reply."""
        self._asked: tuple[int, int, int] | None = None
        """Joint, READ or WRITE and register of the newest register request of another host."""

    def commands(self) -> Mapping[int, str]:
        others = {
            drive + offset: f"{mode} command to {self.names[joint]}"
            for drive, joint in self._joint_of.items()
            for offset, mode in OTHER_MODES.items()
        }
        return {frames.REGISTERS_ID: "register request", **super().commands(), **others}

    def _refresh(self, joint: int) -> Frame:
        return frames.REGISTERS_ID, frames.refresh_request(self.settings[joint].id)

    def poll(self, first: bool) -> list[Frame]:
        return [self._refresh(joint) for joint in range(self.m)]

    def state_request(self, joint: int) -> list[Frame]:
        return [self._refresh(joint)]

    # ---- registers

    def _exchange(self, ask: Ask, joint: int, request: bytes) -> float | None:
        """The value in the answer to a register request; None where the drive does not answer."""
        kind, register = request[2:4]

        def answer(can_id: int, data: bytes) -> float | None:
            found = frames.register_answer(data, self.settings[joint].id)
            good = found is not None and found[:2] == (kind, register) and math.isfinite(found[2])
            return found[2] if good and found is not None else None

        return ask((frames.REGISTERS_ID, request), answer)

    def _read(self, ask: Ask, joint: int, registers: Iterable[int]) -> dict[int, float] | None:
        """Values of registers; None where the drive does not answer."""
        found: dict[int, float] = {}
        for register in registers:
            value = self._exchange(ask, joint, frames.read_request(self.settings[joint].id, register))
            if value is None:
                return None
            found[register] = value
        return found

    def _set(self, ask: Ask, joint: int, register: DamiaoRegister, value: int, otherwise: str) -> None:
        """Write a register in RAM and read it back. Raises BusFault."""
        self._exchange(ask, joint, frames.write_request(self.settings[joint].id, register, value))
        found = (self._read(ask, joint, (register,)) or {}).get(register)
        if found != value:
            raise BusFault(
                f"{self.names[joint]}: register {int(register)} ({register.name}) was set to {value}, but "
                f"reads back {found}: {otherwise}"
            )

    def _told_grid(self, joint: int, values: Mapping[int, float]) -> Grid:
        """By which a drive codes, by its range registers; raises BusFault."""
        for register in RANGE_FIELDS:
            if not 0.0 < values[register] < LARGEST_RANGE:
                name = DamiaoRegister(register).name
                raise BusFault(
                    f"{self.names[joint]}: register {register:d} ({name}) is {values[register]}, which is "
                    "not a usable scale"
                )
        return grid_of(Ranges(*(values[register] for register in RANGE_FIELDS)))

    def _state(self, ask: Ask, joint: int, grid: Grid) -> frames.DamiaoReply | None:
        settings = self.settings[joint]

        def state_of(can_id: int, data: bytes) -> frames.DamiaoReply | None:
            if can_id != settings.reply or frames.register_answer(data, settings.id) is not None:
                return None
            reply = frames.unpack_reply(data, grid)
            return reply if reply is not None and reply.drive == settings.id & 0xF else None

        return ask(self._refresh(joint), state_of)

    # ---- before the cycle

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        values = self._read(ask, joint, IDENTITY)
        if values is None:
            return self.absent(joint)
        hardware, software, serial, reply = map(int, values.values())
        own = self.settings[joint].reply
        wrong = "" if reply == own else f"replies on {reply:02X}h, but the arm file has {own:02X}h"
        return self.present(joint, "Damiao DM-J", f"{serial:08X}", f"{software} (hardware {hardware})", wrong)

    def position(self, joint: int, ask: Ask) -> float:
        """By the scales that it has at present."""
        values = self._read(ask, joint, RANGE_FIELDS)
        if values is None:
            return math.nan
        try:
            reply = self._state(ask, joint, self._told_grid(joint, values))
        except BusFault:
            return math.nan
        return math.nan if reply is None else reply.feedback.position

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        """Off, MIT mode, deadman, both read back."""
        settings, name = self.settings[joint], self.names[joint]
        ask.send(settings.id, special(Special.DISABLE))
        values = self._read(ask, joint, (*RANGE_FIELDS, DamiaoRegister.REPLY_ID, *NOTED_REGISTERS))
        if values is None:
            raise self.silent(joint, " and its id is right")
        reply_id = values[DamiaoRegister.REPLY_ID]
        if reply_id != settings.reply:
            raise BadInput(
                f"{name}: its drive replies on id {int(reply_id):02X}h (register 7), but the arm file has "
                f"`reply: {settings.reply:#04x}`"
            )
        grid = self._told_grid(joint, values)
        self.require_window(joint, limits, grid, " (register 21)")
        self._set(ask, joint, DamiaoRegister.CONTROL_MODE, frames.MIT_MODE, "the drive is not in MIT mode")
        deadman = round(limits.deadline / TIMEOUT_UNIT)
        otherwise = "the drive would keep on with its last command after its host died"
        self._set(ask, joint, DamiaoRegister.TIMEOUT, deadman, otherwise)
        reply = self._state(ask, joint, grid)
        if reply is None:
            raise BusFault(f"{name}: {settings.address} answers register requests, but sends no feedback")
        if reply.state == DamiaoStatus.ENABLED:
            raise BusFault(f"{name}: {settings.address} stays enabled although it was commanded to disable")
        constant = values[DamiaoRegister.TORQUE_CONSTANT]
        notes = (
            f"torque constant {constant:g} N·m/A"
            if constant
            else "the register of the torque constant reads 0, so the torque constant is unknown",
            f"gear {values[DamiaoRegister.GEAR_RATIO]:g}",
            f"current limit {values[DamiaoRegister.OVER_CURRENT] * values[DamiaoRegister.LARGEST_CURRENT]:g} A",
        )
        where = ("register 21 (PMAX)", "register 22 (VMAX)", "register 23 (TMAX)")
        remedy = "write a larger range with the maker's tool and store it"
        self.memory[joint].state = None
        return self.mit_setup(joint, limits, reply.feedback.position, grid, notes, where, remedy)

    # ---- cycle

    def follows(self, joint: int, now: float) -> bool:
        return self.memory[joint].limits is not None and self.memory[joint].state == ENABLED

    def switching(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known, drive = self.memory[joint], self.settings[joint].id
        if known.limits is None:
            return (self._refresh(joint),)
        if order.power is Power.OFF and known.state == ENABLED:
            return ((drive, special(Special.DISABLE)),)
        if order.power is Power.ON and order.walk:
            if known.state == DamiaoStatus.DISABLED:
                return ((drive, special(Special.ENABLE)),)
            if known.state is not None:
                return ((drive, special(Special.CLEAR_ERROR)),)
        return (self._refresh(joint),)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._replies.get((can_id, data[0] & 0xF)) if len(data) == 8 else None
        if joint is None:
            return None
        known = self.memory[joint]
        if data[2] in REGISTER_KINDS:
            told = frames.register_answer(data, self.settings[joint].id)
            if told is not None:
                self._overhear(joint, *told)
                return None
        grid = known.grid
        if grid is None:
            return None
        position, velocity, torque = unpack_feedback(data[1:6], grid)
        known.state = state = data[0] >> 4
        if abs(known.position - position) > grid.ranges.position:
            position = unwrap(position, known.position, grid.position.span)
        known.position, known.velocity = position, velocity
        self.powers[joint] = power = self._power(known)
        self.faults[joint] = fault = _fault_text(state)
        self.temperatures[joint] = temperature = float(max(data[6], data[7]))
        return Reading(joint, position, velocity, torque, math.nan, temperature, power, fault)

    def _overhear(self, joint: int, kind: int, register: int, value: float) -> None:
        """A register answer to another host's request: a range that it tells holds from now on.

        Without the request before it the bytes may as well be a reading near the lower end of the range.
        """
        known, asked = self.memory[joint], self._asked
        field = RANGE_FIELDS.get(register)
        if asked != (joint, kind, register) or field is None or not 0.0 < value < LARGEST_RANGE:
            return
        self._asked = None
        ranges = known.grid.ranges if known.grid else UNKNOWN_RANGES
        known.grid = grid_of(ranges._replace(**{field: value}))

    @staticmethod
    def _power(known: DamiaoMemory) -> Power:
        if known.state == ENABLED:
            return Power.STOPPED if known.damping else Power.ON
        return POWERS.get(known.state, Power.FAULT)

    def lets_go(self, joint: int) -> bool:
        return self.memory[joint].state != ENABLED

    def own_stop(self, joint: int) -> str:
        if self.memory[joint].state != DamiaoStatus.LOST_COMMUNICATION:
            return ""
        return f"{self.where(joint)}: lost communication (state Dh): its TIMEOUT ran out, the torque is off"

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """Of register requests it is noted which register was asked for, so that the answer is known."""
        if can_id == frames.REGISTERS_ID and len(data) == 8 and data[2] in REGISTER_KINDS:
            asked = self._joint_of.get(data[0] | data[1] << 8)
            self._asked = None if asked is None else (asked, data[2], data[3])
            return None
        return super().command_of(can_id, data)


def _fault_text(state: int) -> str:
    if state in NO_FAULTS:
        return ""
    name = next((each.name for each in DamiaoStatus if each == state), "unknown state")
    return f"{name.lower().replace('_', ' ')} (state {state:X}h)"


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By register 8, the command id, of every id, then the ranges of those that answered."""
    ids = [drive for drive in range(1, 0x100) if drive not in STOPPING_IDS]
    answers = _answers(bus, [(drive, DamiaoRegister.COMMAND_ID) for drive in ids])
    if answers:
        answers += _answers(bus, [(drive, DamiaoRegister.COMMAND_ID) for drive in STOPPING_IDS])
    replies = {drive: can_id for can_id, drive, _, _ in sorted(answers, key=lambda answer: answer[1])}
    commands = {drive + mode: drive for drive in replies for mode in (0, *OTHER_MODES)}
    # the answers of one that replies on a command id command the drive of that id: it is asked no more
    asked = [(drive, each) for drive, reply in replies.items() if reply not in commands for each in RANGE_FIELDS]
    told = {(drive, register): value for _, drive, register, value in _answers(bus, asked)}
    found = []
    for drive, reply in replies.items():
        ranges = Ranges(*(told.get((drive, each), math.nan) for each in RANGE_FIELDS))
        models = [name for name, usual in MODELS.items() if np.allclose(ranges, usual, rtol=1e-3)]
        alike = [each for each in replies if (replies[each], each & 0xF) == (reply, drive & 0xF) and each != drive]
        lack = "the value as delivered" if reply == 0 else ""
        lack = f"and cannot be distinguished from those of id {alike[0]:02X}h" if alike else lack
        lack = f"on which id {commands[reply]:02X}h takes commands" if reply in commands else lack
        wrong = f"answers come on {reply:02X}h, {lack}: set another reply id in it (register 7)" if lack else ""
        keys = {"id": drive, "reply": reply, "model": (*models, "")[0], "kp": 0.0, "kd": 0.0}
        each = FoundDrive(
            *("damiao", drive, f"id {drive:02X}h", None if reply in commands or alike else keys),
            reply=reply,
            model=" or ".join(models),
            wrong=wrong,
            max_torque=ranges.torque,
            largest_gains=(ranges.kp, ranges.kd),
            answers=sum(each[1] == drive for each in answers),
        )
        found.append(each)
    return found


def _answers(bus: SearchedBus, asked: Sequence[tuple[int, int]]) -> list[tuple[int, int, int, float]]:
    """Identifier, drive, register and value of each answer to reading these registers of these drives."""
    came = bus.gather([(frames.REGISTERS_ID, frames.read_request(*each)) for each in asked]) if asked else []
    heads = {frames.read_request(*each)[:4] for each in asked}
    return [
        (can_id, data[0], data[3], frames.unpack_value(data[3], data[4:8]))
        for can_id, data in came
        if len(data) == 8 and can_id < frames.REGISTERS_ID and data[:4] in heads
    ]


SEARCH = Discovery(find_drives, ("canopen", "moteus", "odrive"))
SUMMARY = "Damiao DM-J (OpenArm, YAM, reBot B601-DM), MIT mode"
FAMILY = Family("damiao", TRAITS, DamiaoSettings, DamiaoDrives, discovery=SEARCH, summary=SUMMARY)
