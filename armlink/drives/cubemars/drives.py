"""CubeMars AK drives on one bus, in MIT mode: one command and one reply a cycle.

A reply tells no state (`armlink.drives.untold_power`). A drive that makes no torque although its commands ask for some
has left its motor mode. One that got no command for the link's deadline counts as stopped by its CAN timeout: that is
set over the serial port, and nothing on the bus tells it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.port import Frame
from armlink.drives.base import Ask
from armlink.drives.cubemars.frames import MODELS, CubeMarsReply, error_text, unpack_reply
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.mit_drives import MitDrives, MitMemory
from armlink.drives.mit_packing import NO_COMMAND, Ranges, Special, grid_of, pack_command, special, unwrap
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup, law_torque
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.drives.untold_power import UntoldMemory, UntoldPowerDrives, makes_torque
from armlink.errors import BadInput, BusFault

TRAITS = Traits(
    torque="current", calibration="host", silence="keeps on", kept="holds", bounds=(), cadence="reply", frame="11"
)
"""Of a drive with the default keys; with a CAN timeout it lets go."""
LISTEN_SECONDS = 0.1
"""A drive that answers another host is heard within this time [s]."""


class CubeMarsSettings(DriveSettings):
    """A CubeMars AK drive in MIT mode."""

    family: Literal["cubemars"] = "cubemars"
    id: Annotated[int, Field(ge=1, le=0x7F)]
    """CAN id: that of its commands."""
    reply: Annotated[int, Field(ge=0, le=0x7F)] = 0
    """Master id: that of its replies, which tell its own id in their first byte."""
    model: str = ""
    """Model as on its label, for example AK80-9: its ranges, where the keys below do not give them."""
    position_range: Positive | None = None
    """End of the packed positions [rad]; None: the model's."""
    velocity_range: Positive | None = None
    """[rad/s]."""
    torque_range: Positive | None = None
    """[N·m]."""
    can_timeout: Annotated[int, Field(ge=0, le=100_000)] = 0
    """CAN timeout as set in the drive over its serial port [cycles of its own loop]; 0: none, the drive keeps on."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)]
    """Damping under position control [N·m·s/rad]."""

    @model_validator(mode="after")
    def _ranges_are_known(self) -> "CubeMarsSettings":
        given = (self.position_range, self.velocity_range, self.torque_range)
        if self.model.upper() not in MODELS and None in given:
            raise ValueError(
                f"model {self.model!r} is unknown: give one of {', '.join(MODELS)}, or give position_range, "
                "velocity_range and torque_range from the manual"
            )
        return self

    @model_validator(mode="after")
    def _replies_differ_from_commands(self) -> "CubeMarsSettings":
        if self.reply == self.id:
            raise ValueError(
                f"reply {self.reply:#04x} is the id of the drive itself, so replies would look like commands "
                "of another host: set another master id in the drive (set_master_id, over its serial port)"
            )
        return self

    @property
    def ranges(self) -> Ranges:
        """By which its frames are coded."""
        of_model = MODELS.get(self.model.upper(), (0.0, 0.0, 0.0))
        given = (self.position_range, self.velocity_range, self.torque_range)
        return Ranges(*(own or usual for own, usual in zip(given, of_model, strict=True)))

    @property
    def address(self) -> str:
        return f"id {self.id:02X}h"


@dataclass
class CubeMarsMemory(UntoldMemory, MitMemory):
    """It is on in motor mode, by the newest switching that was answered."""

    switched: Special | None = None
    """Newest switching, while it waits for its answer."""
    skip: bool = False
    """The next reply answers a switching that a command follows at once: no reading."""
    lacking: float = math.inf
    """Since when it makes less torque than it is asked for [s]."""


class CubeMarsDrives(UntoldPowerDrives[CubeMarsMemory], MitDrives[CubeMarsMemory]):
    watch = "CAN timeout"

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        """Nothing is sent. Raises BadInput where one drive's replies have another's id."""
        super().__init__(joints, TRAITS, CubeMarsMemory)
        self.let_go_where(settings.can_timeout for settings in self.settings)
        for joint, (known, settings) in enumerate(zip(self.memory, self.settings, strict=True)):
            known.grid = grid_of(settings.ranges)
            other = self._joint_of.get(settings.reply)
            if other is not None:
                raise BadInput(
                    f"{arm.path}: {self.names[joint]}: drive.reply {settings.reply:#04x} is also the id of commands to "
                    f"{self.names[other]}: set a reply id that no drive has (master id, usually 0)"
                )
        self._replies = {(each.reply, each.id): joint for joint, each in enumerate(self.settings)}
        self._spare_canopen(arm)

    def _spare_canopen(self, arm: ArmFile) -> None:
        """Raise BadInput where CANopen nodes share the bus and would take replies for NMT commands."""
        buses = {row.bus for row in self.rows if row.settings.reply == 0}
        for joint in arm.require_link().joints:
            if joint.settings.family == "canopen" and joint.bus in buses:
                raise BadInput(
                    f"{arm.path}: {joint.name}: a CANopen node would read CubeMars replies on id 0 as NMT commands: "
                    "put the CANopen node on another bus, or set another master id in the CubeMars drives (drive.reply)"
                )

    # ---- before the cycle

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """Only a drive that nobody is heard to drive is asked, by what also leaves motor mode."""
        for known in self.memory:
            known.position = math.nan
        ask.wait(lambda: all(math.isfinite(known.position) for known in self.memory), LISTEN_SECONDS)
        return super().identify(ask)

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        there = math.isfinite(self.memory[joint].position) or self._exit(ask, joint) is not None
        return self.present(joint, f"CubeMars {self.settings[joint].model}".strip()) if there else self.absent(joint)

    def positions(self, ask: Ask) -> list[float]:
        self.identify(ask)
        return [known.position for known in self.memory]

    def _exit(self, ask: Ask, joint: int) -> CubeMarsReply | None:
        return ask((self.settings[joint].id, special(Special.DISABLE)), self._reply_of(joint))

    def _reply_of(self, joint: int) -> Callable[[int, bytes], CubeMarsReply | None]:
        def reply(can_id: int, data: bytes) -> CubeMarsReply | None:
            mine = self._replies.get((can_id, data[0])) == joint if data else False
            return unpack_reply(data, self.grid_of(joint)) if mine else None

        return reply

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        """No torque, then out of motor mode; nothing in such a drive can be read or set over CAN."""
        settings, name, grid = self.settings[joint], self.names[joint], self.grid_of(joint)
        self.require_window(joint, limits, grid)
        ask(self._quiet(joint), self._reply_of(joint))
        reply = self._exit(ask, joint)
        if reply is None:
            raise BusFault(
                f"{name}: no answer from {settings.address} on id {settings.reply:02X}h: check that the "
                "drive is powered and in MIT mode, and that its CAN id and its master id are right"
            )
        self.memory[joint] = CubeMarsMemory(on=False)
        self.powers[joint], self.faults[joint] = Power.OFF, error_text(reply.error)
        notes = (_watched(settings), "the scales are taken from the arm file, since the drive reports none")
        where = ("position_range", "velocity_range", "torque_range")
        remedy = "correct this range or `model` in the `drive:` section, or take a drive with a larger range"
        return self.mit_setup(joint, limits, reply.feedback.position, grid, notes, where, remedy)

    # ---- cycle

    def _quiet(self, joint: int) -> Frame:
        return self.settings[joint].id, pack_command(NO_COMMAND, self.grid_of(joint))

    def follows(self, joint: int, now: float) -> bool:
        known = self.memory[joint]
        self.expire(joint, now, self.limits_of(joint).deadline)
        known.commanded = now if known.on else known.commanded
        return bool(known.on)

    def switching(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known, drive = self.memory[joint], self.settings[joint].id
        known.lacking = math.inf
        if order.power is Power.ON and order.walk and known.on is False:
            # motor mode goes on with the command that was in force when it was left
            known.switched, known.skip, known.commanded, known.stopped = Special.ENABLE, True, now, False
            return [(drive, special(Special.ENABLE)), self._quiet(joint)]
        if known.on:
            known.on = None
            return [self._quiet(joint)]
        known.switched = Special.DISABLE
        return [(drive, special(Special.DISABLE))]

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._replies.get((can_id, data[0])) if data else None
        if joint is None:
            return None
        known, grid = self.memory[joint], self.grid_of(joint)
        reply = unpack_reply(data, grid)
        if reply is None:
            return None
        position, velocity, torque = reply.feedback
        if math.isfinite(known.position):
            position = unwrap(position, known.position, grid.position.span)
        known.position, known.velocity = position, velocity
        if known.switched is not None:
            known.on, known.switched = known.switched is Special.ENABLE, None
        if known.skip:
            known.skip = False
            return None
        self._judge(joint, torque, now)
        fault = error_text(reply.error) or self._idle_text(joint, now)
        power = Power.FAULT if fault else self.power_shown(joint, known.damping)
        temperature = math.nan if reply.temperature is None else float(reply.temperature)
        return self.note(Reading(joint, position, velocity, torque, math.nan, temperature, power, fault))

    def _judge(self, joint: int, torque: float, now: float) -> None:
        """Whether the drive makes the torque of the newest command, by a reading of it [N·m]."""
        known = self.memory[joint]
        if known.sent is None:
            return
        wanted = law_torque(known.sent, known.position, known.velocity)
        follows = makes_torque(torque, wanted, self.grid_of(joint).ranges.torque)
        known.lacking = min(known.lacking, now) if follows is False else math.inf
        if known.asked:
            self.answered(joint, follows)

    def _idle_text(self, joint: int, now: float) -> str:
        known = self.memory[joint]
        if known.limits is None or not now - known.lacking > known.limits.deadline:
            return ""
        return "makes no torque although its commands ask for torque: it has left motor mode, or restarted"

    def state_request(self, joint: int) -> list[Frame]:
        """A command of no torque, whose reply has the torque that the drive made until then."""
        known = self.memory[joint]
        if known.limits is None:
            return []
        known.asked = True
        return [self._quiet(joint)]

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        for known in self.memory:
            known.lacking = math.inf


def _watched(settings: CubeMarsSettings) -> str:
    if not settings.can_timeout:
        return (
            "`can_timeout` is not given in the `drive:` section: the drive may keep on with its last "
            "command after its host died"
        )
    return (
        f"the CAN timeout of {settings.can_timeout} cycles is taken from the arm file: it cannot be read over "
        "CAN, so check it in the drive"
    )


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By answers to another host that are heard, its commands too; nothing in them tells a model."""
    commanded = {can_id for can_id, data in bus.heard if len(data) == 8}
    heard = {(*data[:1], can_id) for can_id, data in bus.heard if can_id <= 0x7F and len(data) in (6, 8)}
    note = "the drive does not report its model: write its keys by hand"
    return [
        FoundDrive("cubemars", drive, f"id {drive:02X}h", reply=reply, note=note)
        for drive, reply in sorted(heard)
        if 0 < drive != reply and drive in commanded
    ]


SEARCH = Discovery(find_drives, ("damiao", "odrive"))
SUMMARY = "CubeMars AK (firmware 1 and 2), MIT mode"
FAMILY = Family("cubemars", TRAITS, CubeMarsSettings, CubeMarsDrives, discovery=SEARCH, summary=SUMMARY)
