"""RobStride drives on one bus, in the private protocol: one motion command and one feedback a cycle."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import EXTENDED, Frame
from armlink.drives.base import ANY, BROADCAST, Ask, no_order
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.mit_drives import MitDrives, MitMemory, Steps, order_of
from armlink.drives.mit_packing import Grid, MitCommand
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup
from armlink.drives.robstride import frames
from armlink.drives.robstride.frames import (
    GRIDS,
    IDENTITY_TARGET,
    MOTION_MODE,
    OUR_ID,
    RANGES,
    TIMEOUT_UNIT,
    RobStrideParameter,
    RunMode,
    Type,
    fault_names,
)
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault

TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="reply", frame="29")
HOST_TYPES = frozenset((Type.MOTION, Type.ENABLE, Type.STOP, Type.SET_ZERO, Type.SET_ID, Type.WRITE, Type.SAVE))
"""Frames that change something, which one host alone may send."""
MOST_TORQUE = max(RANGES, key=lambda model: RANGES[model].torque)
"""Model with the largest torque range."""
READBACK_TOLERANCE = 1e-3
"""Relative difference between a float that was written and its reading."""


class RobStrideSettings(DriveSettings):
    """A RobStride drive in the private protocol (29-bit identifiers)."""

    family: Literal["robstride"] = "robstride"
    id: Annotated[int, Field(ge=1, le=0x7F)]
    host: Annotated[int, Field(ge=0, le=0xFF)] = OUR_ID
    """Our id, to which it replies."""
    model: Literal["RS00", "RS01", "RS02", "RS03", "RS04", "RS05", "RS06"]
    """Model as on its label: its frames are scaled by it, and the drive has no register that tells it."""
    kp: Annotated[FiniteFloat, Field(ge=0)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0)]
    """Damping under position control [N·m·s/rad]."""

    @model_validator(mode="after")
    def _gains_fit_the_model(self) -> "RobStrideSettings":
        ranges = RANGES[self.model]
        if self.kp > ranges.kp or self.kd > ranges.kd:
            raise ValueError(f"kp {self.kp}, kd {self.kd}: the {self.model} has at most {ranges.kp} and {ranges.kd}")
        return self

    @property
    def address(self) -> str:
        return f"motor {self.id}"


@dataclass
class RobStrideMemory(MitMemory):
    mode: int | None = None
    faults: int = 0
    was_on: bool = False
    """It has been on since forget()."""


class RobStrideDrives(MitDrives[RobStrideMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS, RobStrideMemory)
        for known, settings in zip(self.memory, self.settings, strict=True):
            known.grid = GRIDS[settings.model]
        self._intruder = ""

    def routes(self) -> Mapping[int, int]:
        """Any: the identifiers carry mode and faults, and another host's carry torques."""
        return {ANY: BROADCAST}

    def commands(self) -> Mapping[int, str]:
        """None by identifier, for a motion command's tells its torque: alarm() names another host."""
        return {}

    def intrusion(self, can_id: int, data: bytes) -> str:
        """Another host's command, by the type in its identifier."""
        joint = self._joint_of.get(can_id & 0xFF)
        if joint is None or not can_id & EXTENDED or frames.kind_of(can_id) not in HOST_TYPES:
            return ""
        return f"{Type(frames.kind_of(can_id)).name.lower().replace('_', ' ')} to {self.names[joint]}"

    def reading_ids(self) -> Mapping[int, int]:
        """Feedback and reports, with all modes and faults that their identifiers may tell."""
        return {
            frames.identifier(kind, head << 8 | settings.id, settings.host) | EXTENDED: joint
            for joint, settings in enumerate(self.settings)
            for kind in (Type.FEEDBACK, Type.REPORT)
            for head in range(0x100)
        }

    # ---- parameters

    def read_parameter(self, ask: Ask, joint: int, parameter: int) -> float | None:
        """Value of a parameter; None where the drive does not answer or does not have it."""
        settings = self.settings[joint]

        def value(can_id: int, data: bytes) -> tuple[float | None] | None:
            found = frames.parameter_answer(can_id, data) if can_id & EXTENDED else None
            return (found[2],) if found is not None and found[:2] == (settings.id, parameter) else None

        answer = ask(_extended(frames.read_frame(settings.id, settings.host, parameter)), value)
        return None if answer is None else answer[0]

    def _fed_back(self, ask: Ask, joint: int, frame: Frame) -> frames.Feedback | None:
        def feedback(can_id: int, data: bytes) -> frames.Feedback | None:
            found = frames.unpack_feedback(can_id, data, self.grid_of(joint)) if can_id & EXTENDED else None
            return found if found is not None and found.drive == self.settings[joint].id else None

        return ask(_extended(frame), feedback)

    def _set(self, ask: Ask, joint: int, parameter: RobStrideParameter, value: float, otherwise: str) -> None:
        """Write a parameter in RAM and read it back. Raises BusFault."""
        settings, name = self.settings[joint], self.names[joint]
        self._fed_back(ask, joint, frames.write_frame(settings.id, settings.host, parameter, value))
        found = self.read_parameter(ask, joint, parameter)
        if found is None:
            raise BusFault(
                f"{name}: its firmware has no parameter {int(parameter):04X}h ({parameter.name}): "
                f"{otherwise}; update the firmware"
            )
        if abs(found - value) > READBACK_TOLERANCE * abs(value):
            raise BusFault(
                f"{name}: parameter {int(parameter):04X}h ({parameter.name}) was set to {value:g}, but reads "
                f"back {found:g}: {otherwise}; update the firmware, or write it with the maker's tool"
            )

    # ---- before the cycle

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        settings = self.settings[joint]

        def unique_id(can_id: int, data: bytes) -> str | None:
            known = can_id & EXTENDED and frames.kind_of(can_id) == Type.IDENTITY and len(data) == 8
            return data[::-1].hex().upper() if known and frames.data_of(can_id) & 0xFF == settings.id else None

        serial = ask(_extended(frames.identity_frame(settings.id, settings.host)), unique_id)
        return self.absent(joint) if serial is None else self.present(joint, f"RobStride {settings.model}", serial)

    def position(self, joint: int, ask: Ask) -> float:
        found = self.read_parameter(ask, joint, RobStrideParameter.POSITION)
        return math.nan if found is None else found

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        """Stopped, motion mode, torque limit, deadman, each read back."""
        settings, known, grid = self.settings[joint], self.memory[joint], self.grid_of(joint)
        self.require_window(joint, limits, grid)
        feedback = self._fed_back(ask, joint, frames.stop_frame(settings.id, settings.host))
        if feedback is None:
            raise self.silent(joint, ", its id is right, and its protocol is private")
        most = min(limits.max_torque, grid.ranges.torque)
        self._set(ask, joint, RobStrideParameter.RUN_MODE, MOTION_MODE, "the drive is not in motion mode")
        self._set(ask, joint, RobStrideParameter.LIMIT_TORQUE, most, "the drive would not limit its torque")
        deadman = round(limits.deadline / TIMEOUT_UNIT)
        otherwise = "the drive would keep on with its last command after its host died"
        self._set(ask, joint, RobStrideParameter.TIMEOUT, deadman, otherwise)
        known.mode, known.was_on = None, False
        note = f"the scales are taken from the manual of the {settings.model}, since the drive has no register for them"
        where = (f"the range of an {settings.model}",) * 3
        remedy = "correct `model` in the `drive:` section, or take a drive with a larger range"
        return self.mit_setup(joint, limits, feedback.motion.position, grid, (note,), where, remedy)

    # ---- cycle

    def coded(self, joint: int, steps: Steps) -> Frame:
        return _extended(frames.motion_frame(self.settings[joint].id, *steps))

    def decoded(self, can_id: int, data: bytes, grid: Grid) -> MitCommand:
        return frames.unpack_motion(can_id, data, grid)

    def follows(self, joint: int, now: float) -> bool:
        return self.memory[joint].mode == RunMode.RUN and not self.memory[joint].faults

    def command(self, joint: int, order: Order) -> Frame:
        self.memory[joint].was_on = True
        return super().command(joint, order)

    def switching(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known, settings = self.memory[joint], self.settings[joint]
        known.was_on = known.was_on and order.power is Power.ON
        if order.power is Power.ON and order.walk and known.mode is not None and not known.faults:
            self.limits_of(joint)
            return (_extended(frames.enable_frame(settings.id, settings.host)),)
        clear = order.walk and bool(known.faults)
        return (_extended(frames.stop_frame(settings.id, settings.host, clear_fault=clear)),)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if not can_id & EXTENDED:
            return None
        if intruder := self.intrusion(can_id, data):
            self._intruder = f"another host sends {intruder} ({can_id & 0x1FFFFFFF:08X}h)"
        joint = self._joint_of.get(frames.data_of(can_id) & 0xFF)
        if joint is None:
            return None
        known = self.memory[joint]
        if known.limits is not None and can_id & 0xFF != self.settings[joint].host:
            return None  # a listener, who has set nothing up, takes what is said to any host
        feedback = frames.unpack_feedback(can_id, data, self.grid_of(joint))
        if feedback is None:
            return None
        known.mode, known.faults = feedback.mode, feedback.faults
        known.position, known.velocity, torque = feedback.motion
        fault = f"{fault_names(known.faults)} (fault bits {known.faults:02X}h)" if known.faults else ""
        heat, power = feedback.temperature, _power(known)
        return self.note(Reading(joint, known.position, known.velocity, torque, math.nan, heat, power, fault))

    def alarm(self) -> BusFault | None:
        return BusFault(self._intruder) if self._intruder else None

    def state_request(self, joint: int) -> list[Frame]:
        """The torque limit, written as it is, since a reading is answered without the mode."""
        settings, limits = self.settings[joint], self.memory[joint].limits
        if limits is None:
            return []
        most = min(limits.max_torque, self.grid_of(joint).ranges.torque)
        return [_extended(frames.write_frame(settings.id, settings.host, RobStrideParameter.LIMIT_TORQUE, most))]

    def lets_go(self, joint: int) -> bool:
        return self.memory[joint].mode != RunMode.RUN

    def own_stop(self, joint: int) -> str:
        """A watchdog that ran out shows as mode reset alone."""
        known = self.memory[joint]
        if not known.was_on or known.mode != RunMode.RESET or known.faults:
            return ""
        return f"{self.where(joint)}: its canTimeout ran out, so it went to mode reset, and the torque is off"

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        self._intruder = ""
        for known in self.memory:
            known.damping = known.was_on = False

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._joint_of.get(can_id & 0xFF)
        if joint is None or not can_id & EXTENDED or len(data) != 8:
            return None
        kind = frames.kind_of(can_id)
        if kind == Type.MOTION:
            return joint, order_of(self.decoded(can_id, data, self.grid_of(joint)))
        powers: dict[int, Power] = {Type.ENABLE: Power.ON, Type.STOP: Power.OFF}
        power = powers.get(kind)
        return None if power is None else (joint, no_order()._replace(power=power))


def _power(known: RobStrideMemory) -> Power:
    if known.faults:
        return Power.FAULT
    if known.mode == RunMode.RUN:
        return Power.STOPPED if known.damping else Power.ON
    return Power.OFF if known.mode == RunMode.RESET else Power.READY


def _extended(frame: Frame) -> Frame:
    return frame[0] | EXTENDED, frame[1]


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By the device id of every motor id, then the torque limit and the deadman of those that answered."""
    came = Counter(
        frames.data_of(can_id) & 0xFF
        for can_id, _ in bus.gather([_extended(frames.identity_frame(motor, OUR_ID)) for motor in range(1, 0x80)])
        if can_id & EXTENDED and frames.kind_of(can_id) == Type.IDENTITY and can_id & 0xFF == IDENTITY_TARGET
    )
    wanted = (RobStrideParameter.LIMIT_TORQUE, RobStrideParameter.TIMEOUT)
    heard = bus.gather([_extended(frames.read_frame(motor, OUR_ID, each)) for motor in came for each in wanted])
    answers = [frames.parameter_answer(*frame) for frame in heard if frame[0] & EXTENDED]
    told = {answer[:2]: answer[2] for answer in answers if answer is not None}
    found = []
    for motor in sorted(came.keys() & range(1, 0x80)):
        limit, timeout = (told.get((motor, int(each))) for each in wanted)
        # a host that has set up a drive since its power-on has set the limit, and with it the deadman
        models = [] if timeout != 0 else [name for name, ranges in RANGES.items() if ranges.torque == limit]
        model = (*models, MOST_TORQUE)[0]
        why = "the drive's torque limit is the factory value of this model"
        if not models:
            why = "it has the largest torque range, so any other model makes less torque than commanded, never more"
        each = FoundDrive(
            *("robstride", motor, f"motor {motor}", {"id": motor, "model": model, "kp": 0.0, "kd": 0.0}),
            max_torque=RANGES[model].torque,
            largest_gains=(RANGES[model].kp, RANGES[model].kd),
            model=" or ".join(models),
            note=f"model {model} is assumed, so compare it with the label: {why}",
            answers=came[motor],
        )
        found.append(each)
    return found


SEARCH = Discovery(find_drives, ("moteus",))
SUMMARY = "RobStride RS00 to RS06 (reBot B601-RS), private protocol"
FAMILY = Family("robstride", TRAITS, RobStrideSettings, RobStrideDrives, discovery=SEARCH, summary=SUMMARY)
