"""Joints of an AgileX Piper arm: MIT commands to each, and readings that its controller sends by its own clock.

It has no time-out of communication: it goes on with the newest command after its host died, so a keeper has to send the
last one (`armlink.link.keeper`). A joint that got no command for the link's deadline counts as stopped, by its keeper.
The hand is passed over.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.base import BROADCAST, Ask, no_order
from armlink.drives.board import Board
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.mit_drives import MitDrives, MitMemory, Steps, order_of
from armlink.drives.mit_packing import Grid, MitCommand
from armlink.drives.orders import DriveIdentity, Gains, Limits, Mode, Order, Power, Reading, ReadingRange, Setup
from armlink.drives.piper import frames
from armlink.drives.piper.frames import JOINTS, PiperGrid, PiperState
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault, Refused

TRAITS = Traits(
    torque="current", calibration="host", silence="keeps on", kept="holds", bounds=(), cadence="cyclic", frame="11"
)
LONE_POSITIONS = 5
"""A joint with so many positions and no motion in between has left the arm's own bus: its position is of the past."""
START_SECONDS = 0.3
"""Longest wait for positions, which come every 5 ms, and for states [s]."""


class PiperSettings(DriveSettings):
    """One joint of a Piper arm."""

    family: Literal["piper"] = "piper"
    joint: Annotated[int, Field(ge=1, le=6)]
    """From the base on."""
    firmware: Annotated[str, Field(pattern=f"^{frames.FIRMWARE}$")]
    """Of the arm's controller, as `armlink scan` tells it: the scale of torques depends on it."""
    torque_constant: Positive | None = None
    """[N·m/A]; None: as the maker's SDK has it."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)] = 10.0
    """Stiffness under position control; by default the SDK's reference [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)] = 0.8
    """Damping under position control; by default the SDK's reference [N·m·s/rad]."""

    @property
    def id(self) -> int:
        """Identifier of its MIT commands."""
        return frames.MIT_ID + self.joint - 1

    @property
    def address(self) -> str:
        return f"joint {self.joint}"

    @property
    def amplification(self) -> float:
        """Torque that the joint makes by that of an MIT command."""
        return frames.amplification(self.joint, self.firmware)

    @property
    def constant(self) -> float:
        """Torque that a current tells of, by that current [N·m/A]."""
        told = self.torque_constant or frames.TORQUE_CONSTANTS[self.joint - 1]
        return told / self.amplification


@dataclass
class PiperMemory(MitMemory):
    state: int | None = None
    """Bits of PiperState."""
    commanded: float = -math.inf
    """When the newest MIT command was made [s]."""
    stopped: bool = False
    """It was left without commands for longer than the deadline."""
    positions_alone: int = 0
    """Positions that came since its motion did, which comes as often."""


class PiperDrives(MitDrives[PiperMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS, PiperMemory)
        self._joint_at = {settings.joint: joint for joint, settings in enumerate(self.settings)}
        self._arm_fault, self._follows_mit = "", False
        for known, settings in zip(self.memory, self.settings, strict=True):
            known.grid = PiperGrid(settings.amplification)

    # ---- identifiers

    def routes(self) -> Mapping[int, int]:
        found = dict.fromkeys((frames.STATUS_ID, frames.FIRMWARE_ID, *self.reading_ids()), BROADCAST)
        for number, joint in self._joint_at.items():
            found |= {frames.MOTION_ID + number: joint, frames.STATE_ID + number: joint}
        return found

    def commands(self) -> Mapping[int, str]:
        single = (frames.STOP_ID, frames.MODE_ID, frames.ENABLE_ID, *frames.HAND_IDS)
        several = (*(frames.TARGETS_ID + place for place in range(3)), *(frames.MIT_ID + place for place in range(6)))
        return dict.fromkeys((*single, *several), "command to the Piper arm")

    def cycle_bits(self) -> float:
        """Command and motion of each joint, positions of two, a fifth of the states; of the arm state, tool pose and
        hand."""
        return (2.7 * self.m + 5) * longest_frame_bits(8)

    def reading_ids(self) -> Mapping[int, int]:
        return {frames.POSITIONS_ID + (number - 1) // 2: joint for number, joint in self._joint_at.items()}

    # ---- before the cycle

    def _wait(self, ask: Ask) -> None:
        known = self.memory
        for each in known:
            each.position, each.state = math.nan, None
        ask.wait(lambda: all(each.state is not None and math.isfinite(each.position) for each in known), START_SECONDS)

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        self._wait(ask)
        firmware = read_firmware(ask)
        return [self._identity(joint, firmware) for joint in range(self.m)]

    def _identity(self, joint: int, firmware: str) -> DriveIdentity:
        if self.memory[joint].state is None:
            return self.absent(joint)
        stated = self.settings[joint].firmware
        wrong = f"its firmware is {firmware}, the arm file states {stated}" if firmware not in ("", stated) else ""
        return self.present(joint, "AgileX Piper", firmware=firmware, mismatch=wrong)

    def positions(self, ask: Ask) -> list[float]:
        self._wait(ask)
        return [known.position for known in self.memory]

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """Nothing is sent but the question for the firmware. Raises Refused for an arm with power, which would fall."""
        self._wait(ask)
        firmware = read_firmware(ask)
        for joint, (known, settings) in enumerate(zip(self.memory, self.settings, strict=True)):
            if firmware not in ("", settings.firmware):
                raise Refused(
                    f"{self.names[joint]}: the arm's firmware is {firmware}, the arm file states {settings.firmware}: "
                    "correct `firmware`, since the scale of torques depends on it"
                )
            if known.state is not None and known.state & PiperState.ENABLED:
                raise Refused(
                    f"{self.names[joint]}: the arm has power: another host drives the arm, or a host died and the "
                    "drives still hold it: support the arm, which falls without power, then switch its power off and on"
                )
        return super().set_up(ask, limits)

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        known, settings = self.memory[joint], self.settings[joint]
        if known.state is None or not math.isfinite(known.position):
            raise BusFault(
                f"{self.names[joint]}: no message from {settings.address}: check that the arm is powered and is not a "
                "master arm (a master arm is silent while nobody moves it)"
            )
        grid = self.grid_of(joint)
        self.require_window(joint, limits, grid)
        known.limits, known.sent, known.commanded, known.stopped = limits, None, -math.inf, False
        self.powers[joint] = Power.OFF
        remedy = "correct `torque_constant` in the `drive:` section, or give the joint a smaller range"
        return Setup(
            position=known.position,
            torque=0.0,
            position_step=frames.ANGLE,
            modes=frozenset((int(Mode.POSITION), int(Mode.TORQUE))),
            gains=Gains(settings.kp, settings.kd, grid.ranges.kp, grid.ranges.kd),
            notes=("its controller has no time-out of communication: it keeps on with its last command",),
            scales={"torque constant, N·m/A": settings.constant, "torque range, N·m": grid.ranges.torque},
            ranges=(
                ReadingRange("velocity", frames.MOST_SPEED, "the range of its frames", remedy),
                ReadingRange("torque", frames.MOST_CURRENT * settings.constant, "the range of its currents", remedy),
            ),
        )

    # ---- the cycle

    def coded(self, joint: int, steps: Steps) -> Frame:
        return self.settings[joint].id, frames.pack_mit(*steps)

    def decoded(self, can_id: int, data: bytes, grid: Grid) -> MitCommand:
        command = frames.unpack_mit(data)
        if command is None:
            raise ValueError(f"{data.hex()}: its checksum is wrong")
        return command._replace(torque=command.torque * self.settings[self._joint_of[can_id]].amplification)

    def follows(self, joint: int, now: float) -> bool:
        known = self.memory[joint]
        if self._has_power(joint) and now - known.commanded > self.limits_of(joint).deadline:
            known.stopped, self.powers[joint] = True, Power.STOPPED
        return self._has_power(joint) and self._follows_mit and not known.stopped and not self.faults[joint]

    def _has_power(self, joint: int) -> bool:
        return bool((self.memory[joint].state or 0) & PiperState.ENABLED)

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        found = super().joint_frames(joint, order, now)
        if self.memory[joint].sent is not None:
            self.memory[joint].commanded = now
        return found

    def switching(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known, number = self.memory[joint], self.settings[joint].joint
        if order.power is Power.OFF:
            off = known.state is not None and not self._has_power(joint)
            return [] if off else [(frames.ENABLE_ID, frames.switch(number, frames.DISABLE))]
        if order.power is Power.STOPPED:
            return [self.damp(joint)] if self._has_power(joint) else []
        if not order.walk or self.faults[joint]:
            return []
        if not self._follows_mit:
            return [(frames.MODE_ID, frames.mit_mode())]
        known.stopped = False
        # a joint that takes power has no command yet: it gets one before it can sink
        return [(frames.ENABLE_ID, frames.switch(number, frames.ENABLE)), self.command(joint, order)]

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """Positions, which come in frames of two joints each."""
        return {can_id: partial(self._put, board, places, can_id) for can_id in self.reading_ids()}

    def _put(self, board: Board, places: Sequence[int], can_id: int, data: bytes) -> None:
        if len(data) != 8:
            board.errors += 1
            return
        for joint, position in self._of_two(frames.POSITIONS_ID, can_id, data):
            known = self.memory[joint]
            known.positions_alone += 1
            if known.positions_alone <= LONE_POSITIONS:
                known.position = position
                board.reading(places[joint], position, math.nan)

    def _of_two(self, base: int, can_id: int, data: bytes) -> list[tuple[int, float]]:
        """Joints and their positions [rad], or targets, where a frame has those of two, by `base`."""
        first = 2 * (can_id - base) + 1
        if first not in (1, 3, 5) or len(data) != 8:
            return []
        pairs = zip((first, first + 1), frames.unpack_positions(data), strict=True)
        return [(self._joint_at[number], position) for number, position in pairs if number in self._joint_at]

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if len(data) != 8:
            return None
        if can_id == frames.STATUS_ID:
            self._arm_fault = frames.ARM_FAULTS.get(data[1], "")
            self._follows_mit = (data[0], data[2]) == (frames.BY_CAN, frames.MOVE_M)
        joint = self._joint_at.get(can_id & 0xF) if can_id & ~0xF in (frames.MOTION_ID, frames.STATE_ID) else None
        if joint is None:
            for each, position in self._of_two(frames.POSITIONS_ID, can_id, data):  # no board takes them before a cycle
                self.memory[each].position = position
            return None
        known, settings = self.memory[joint], self.settings[joint]
        if can_id & ~0xF == frames.MOTION_ID:
            known.positions_alone = 0
            known.velocity, current = frames.unpack_motion(data)
            return Reading(joint, velocity=known.velocity, motor_torque=current * settings.constant)
        temperature, known.state = frames.unpack_state(data)
        fault = frames.fault_text(known.state) or self._arm_fault
        power = Power.FAULT if fault else self._power(joint)
        return self.note(Reading(joint, temperature=temperature, power=power, fault=fault))

    def _power(self, joint: int) -> Power:
        known = self.memory[joint]
        if not self._has_power(joint):
            return Power.OFF
        astray = known.limits is not None and not self._follows_mit
        return Power.STOPPED if known.stopped or known.damping or astray else Power.ON

    def lets_go(self, joint: int) -> bool:
        return not self._has_power(joint)

    def own_stop(self, joint: int) -> str:
        if not self.memory[joint].stopped:
            return ""
        return f"{self.where(joint)}: no command came within the deadline, so the keeper holds the joint"

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        for known in self.memory:
            known.stopped = False

    # ---- beside its host

    def commands_of(self, can_id: int, data: bytes) -> list[tuple[int, Order]]:
        targets = self._of_two(frames.TARGETS_ID, can_id, data)
        order = no_order()._replace(mode=Mode.POSITION, torque=0.0, kp=0.0, kd=0.0)
        return [(joint, order._replace(position=at)) for joint, at in targets] or super().commands_of(can_id, data)

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """A command to one joint, or to all."""
        if len(data) != 8:
            return None
        if can_id == frames.STOP_ID and data[0] == 1:
            return BROADCAST, no_order()._replace(power=Power.STOPPED)
        if can_id == frames.ENABLE_ID and data[1] in (frames.ENABLE, frames.DISABLE):
            joint = BROADCAST if data[0] == 0xFF else self._joint_at.get(data[0])
            power = Power.ON if data[1] == frames.ENABLE else Power.OFF
            return None if joint is None else (joint, no_order()._replace(power=power))
        joint = self._joint_of.get(can_id)
        if joint is None or frames.unpack_mit(data) is None:
            return None
        return joint, order_of(self.decoded(can_id, data, self.grid_of(joint)))


def read_firmware(ask: Ask) -> str:
    """Empty where the arm does not tell it. Its answer is several frames of text."""
    pieces = list[bytes]()

    def told(can_id: int, data: bytes) -> str | None:
        if can_id == frames.FIRMWARE_ID:
            pieces.append(data)
        return frames.firmware_in(iter(pieces)) or None

    return ask((frames.FIRMWARE_ID, frames.firmware_request()), told) or ""


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By the frames of all joints that are heard, then the firmware."""
    wanted = {base + number for base in (frames.MOTION_ID, frames.STATE_ID) for number in JOINTS}
    wanted |= {frames.POSITIONS_ID + place for place in range(3)}
    if not wanted <= {can_id for can_id, data in bus.heard if len(data) == 8}:
        return []
    firmware = read_firmware(bus)
    note = "" if firmware else "the arm does not report its firmware: S-V1.8-2 is assumed"
    stated = firmware or "S-V1.8-2"
    return [
        FoundDrive("piper", n, f"joint {n}", {"joint": n, "firmware": stated}, model="AgileX Piper", note=note)
        for n in JOINTS
    ]


SEARCH = Discovery(find_drives, ("odrive",))
SUMMARY = "AgileX Piper arms, MIT commands to each joint"
FAMILY = Family("piper", TRAITS, PiperSettings, PiperDrives, discovery=SEARCH, summary=SUMMARY)
