"""Joints of an AgileX Piper arm: heard, and never commanded.

Its controller sends for all joints by its own clock and has no time-out of communication: it goes on with the newest
command after its host died. armlink gives no power to such an arm, so this family makes no command: it reads an arm
that stands, or is driven by its own host.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from pydantic import Field

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.base import BROADCAST, Ask, BasicDrives, DriveMemory, no_order
from armlink.drives.board import Board
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.mit_drives import order_of
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.piper import frames
from armlink.drives.piper.frames import JOINTS, PiperState
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault

TRAITS = Traits(torque="current", calibration="host", silence="keeps on", bounds=(), cadence="cyclic", frame="11")
PATIENCE = 0.3
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
class PiperMemory(DriveMemory):
    state: int | None = None
    """Bits of PiperState."""


class PiperDrives(BasicDrives[PiperMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS, PiperMemory)
        self._joint_of = {settings.joint: joint for joint, settings in enumerate(self.settings)}
        self._arm_fault = ""

    # ---- identifiers

    def routes(self) -> Mapping[int, int]:
        found = dict.fromkeys((frames.STATUS_ID, frames.FIRMWARE_ID, *self.reading_ids()), BROADCAST)
        for number, joint in self._joint_of.items():
            found |= {frames.MOTION_ID + number: joint, frames.STATE_ID + number: joint}
        return found

    def commands(self) -> Mapping[int, str]:
        single = (frames.STOP_ID, frames.MODE_ID, frames.ENABLE_ID, *frames.HAND_IDS)
        several = (*(frames.TARGETS_ID + place for place in range(3)), *(frames.MIT_ID + place for place in range(6)))
        return dict.fromkeys((*single, *several), "command to the Piper arm")

    def cycle_bits(self) -> float:
        """Motion of each joint, positions of two, a fifth of the states; of the arm state, tool pose and hand."""
        return (1.7 * self.m + 5) * longest_frame_bits(8)

    def reading_ids(self) -> Mapping[int, int]:
        return {frames.POSITIONS_ID + (number - 1) // 2: joint for number, joint in self._joint_of.items()}

    # ---- before the cycle

    def _wait(self, ask: Ask) -> None:
        for known in self.memory:
            known.position, known.state = math.nan, None
        ask.wait(lambda: all(each.state is not None and math.isfinite(each.position) for each in self.memory), PATIENCE)

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
        self._wait(ask)
        return super().set_up(ask, limits)

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        known, settings = self.memory[joint], self.settings[joint]
        if known.state is None or not math.isfinite(known.position):
            raise BusFault(
                f"{self.names[joint]}: nothing is heard of {settings.address}: check that the arm is powered, and that "
                "it is no master arm, which is silent while nobody moves it"
            )
        known.limits = limits
        return Setup(
            position=known.position,
            torque=0.0,
            position_step=frames.ANGLE,
            modes=frozenset((int(Mode.POSITION), int(Mode.TORQUE))),
            notes=("its controller has no time-out of communication: armlink reads the arm, and gives it no power",),
            scales={"torque constant, N·m/A": settings.constant},
        )

    # ---- the cycle

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        """None: who drives the arm, or left it with power, is another host, and without power it would fall."""
        self.memory[joint].sent = None
        return []

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """Positions, which come in frames of two joints each."""
        return {can_id: partial(self._put, board, places, can_id) for can_id in self.reading_ids()}

    def _put(self, board: Board, places: Sequence[int], can_id: int, data: bytes) -> None:
        if len(data) != 8:
            board.errors += 1
            return
        for joint, position in self._of_two(frames.POSITIONS_ID, can_id, data):
            self.memory[joint].position = position
            board.reading(places[joint], position, math.nan)

    def _of_two(self, base: int, can_id: int, data: bytes) -> list[tuple[int, float]]:
        """Joints and their positions [rad], or targets, where a frame has those of two, by `base`."""
        first = 2 * (can_id - base) + 1
        if first not in (1, 3, 5) or len(data) != 8:
            return []
        pairs = zip((first, first + 1), frames.unpack_positions(data), strict=True)
        return [(self._joint_of[number], position) for number, position in pairs if number in self._joint_of]

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if len(data) != 8:
            return None
        if can_id == frames.STATUS_ID:
            self._arm_fault = frames.ARM_FAULTS.get(data[1], "")
        joint = self._joint_of.get(can_id & 0xF) if can_id & ~0xF in (frames.MOTION_ID, frames.STATE_ID) else None
        if joint is None:
            for each, position in self._of_two(frames.POSITIONS_ID, can_id, data):  # no board takes them before a cycle
                self.memory[each].position = position
            return None
        known, settings = self.memory[joint], self.settings[joint]
        if can_id & ~0xF == frames.MOTION_ID:
            known.velocity, current = frames.unpack_motion(data)
            return Reading(joint, velocity=known.velocity, motor_torque=current * settings.constant)
        temperature, known.state = frames.unpack_state(data)
        fault = frames.fault_text(known.state) or self._arm_fault
        on = Power.ON if known.state & PiperState.ENABLED else Power.OFF
        power = Power.FAULT if fault else on
        return self.note(Reading(joint, temperature=temperature, power=power, fault=fault))

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
            joint = BROADCAST if data[0] == 0xFF else self._joint_of.get(data[0])
            power = Power.ON if data[1] == frames.ENABLE else Power.OFF
            return None if joint is None else (joint, no_order()._replace(power=power))
        joint = self._joint_of.get(can_id - frames.MIT_ID + 1)
        command = None if joint is None else frames.unpack_mit(data)
        if joint is None or command is None:
            return None
        torque = command.torque * self.settings[joint].amplification
        return joint, order_of(command._replace(torque=torque))


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
    note = "" if firmware else "the arm does not report its firmware: S-V1.8-2 assumed"
    stated = firmware or "S-V1.8-2"
    return [
        FoundDrive("piper", n, f"joint {n}", {"joint": n, "firmware": stated}, model="AgileX Piper", note=note)
        for n in JOINTS
    ]


SEARCH = Discovery(find_drives, ("odrive",))
SUMMARY = "AgileX Piper arms: read beside their own host, not driven"
FAMILY = Family("piper", TRAITS, PiperSettings, PiperDrives, discovery=SEARCH, summary=SUMMARY)
