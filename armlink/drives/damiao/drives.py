"""Damiao DM-J drives on one bus, in MIT mode: set-up by registers, one command and one reply a cycle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import Frame
from armlink.drives.damiao import frames
from armlink.drives.damiao.frames import READ, WRITE, DamiaoRegister, DamiaoStatus
from armlink.drives.damiao.set_up import LARGEST_RANGE, prepare, read_position, read_registers
from armlink.drives.damiao.settings import MODELS, DamiaoSettings
from armlink.drives.family import Ask, Family
from armlink.drives.mit_drives import MitDrives, MitKnown
from armlink.drives.mit_packing import Ranges, Special, feedback_in, special, unwrap
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading, Setup
from armlink.drives.traits import Traits

TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="reply", frame="11")
OTHER_MODES = {0x100: "position", 0x200: "velocity", 0x300: "force"}
"""Offsets of the command ids of the modes that armlink does not use."""
IDENTITY = (
    DamiaoRegister.HARDWARE_VERSION,
    DamiaoRegister.SOFTWARE_VERSION,
    DamiaoRegister.SERIAL_NUMBER,
    DamiaoRegister.REPLY_ID,
)
REGISTER_KINDS = frozenset((READ, WRITE))
ENABLED = int(DamiaoStatus.ENABLED)
POWERS: dict[int | None, Power] = {DamiaoStatus.DISABLED: Power.OFF, DamiaoStatus.LOST_COMMUNICATION: Power.STOPPED}
RANGE_FIELDS: dict[int, str] = {
    DamiaoRegister.POSITION_RANGE: "position",
    DamiaoRegister.VELOCITY_RANGE: "velocity",
    DamiaoRegister.TORQUE_RANGE: "torque",
}
NO_FAULTS = frozenset((int(DamiaoStatus.DISABLED), int(DamiaoStatus.ENABLED), int(DamiaoStatus.LOST_COMMUNICATION)))
UNKNOWN_RANGES = Ranges(math.nan, math.nan, math.nan)
FAULTS = {
    DamiaoStatus.OVERVOLTAGE: "overvoltage",
    DamiaoStatus.UNDERVOLTAGE: "undervoltage",
    DamiaoStatus.OVERCURRENT: "overcurrent",
    DamiaoStatus.MOSFET_HOT: "power stage too hot",
    DamiaoStatus.ROTOR_HOT: "motor too hot",
    DamiaoStatus.OVERLOAD: "overload",
}


@dataclass
class _DamiaoState(MitKnown):
    """Its ranges are those that its model is delivered with, until its registers are known."""

    state: int | None = None


class DamiaoDrives(MitDrives):
    """The drives of one bus; see `Drives`."""

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        self._known: list[_DamiaoState] = [_DamiaoState() for _ in joints]
        super().__init__(joints, TRAITS, self._known)
        for known, settings in zip(self._known, self._settings, strict=True):
            known.use(MODELS.get(settings.model))
        self._replies = {(each.reply, each.id & 0xF): joint for joint, each in reversed([*enumerate(self._settings)])}
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

    def poll(self, first: bool) -> list[Frame]:
        return [(frames.REGISTERS_ID, frames.refresh_request(settings.id)) for settings in self._settings]

    # ---- set-up

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        found = []
        for joint, settings in enumerate(self._settings):
            values = read_registers(ask, settings.id, IDENTITY)
            if None in values.values():
                found.append(DriveIdentity(joint, settings.address, present=False))
                continue
            hardware, software, serial, reply = (int(value or 0) for value in values.values())
            wrong = (
                "" if reply == settings.reply else f"replies on {reply:02X}h, the arm file says {settings.reply:02X}h"
            )
            found.append(
                DriveIdentity(
                    joint,
                    settings.address,
                    True,
                    "Damiao DM-J",
                    f"{serial:08X}",
                    f"{software} (hardware {hardware})",
                    self.power(joint),
                    wrong,
                )
            )
        return found

    def positions(self, ask: Ask) -> list[float]:
        """See TellsPosition: by the scales that each drive has at present."""
        return [read_position(ask, self.names[joint], each) for joint, each in enumerate(self._settings)]

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        found = []
        for joint, (known, settings, limit) in enumerate(zip(self._known, self._settings, limits, strict=True)):
            ranges, result = prepare(ask, self.names[joint], settings, limit)
            known.use(ranges)
            known.limits, known.state = limit, None
            found.append(result)
            known.position = result.position
        return found

    # ---- cycle

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        return [self._frame(joint, order) for joint, order in enumerate(orders) if order is not None]

    def _frame(self, joint: int, order: Order) -> Frame:
        known, drive = self._known[joint], self._settings[joint].id
        known.damping = False
        if known.limits is None:
            known.sent = None
            return frames.REGISTERS_ID, frames.refresh_request(drive)
        on = known.state == ENABLED
        if order.power is Power.ON and on:
            return self._command(joint, order)
        if order.power is Power.STOPPED and on:
            return self._damp(joint)
        known.sent = None
        if order.power is Power.OFF and on:
            return drive, special(Special.DISABLE)
        if order.power is Power.ON and order.walk:
            if known.state == DamiaoStatus.DISABLED:
                return drive, special(Special.ENABLE)
            if known.state is not None:
                return drive, special(Special.CLEAR_ERROR)
        return frames.REGISTERS_ID, frames.refresh_request(drive)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._replies.get((can_id, data[0] & 0xF)) if len(data) == 8 else None
        if joint is None:
            return None
        known = self._known[joint]
        if data[2] in REGISTER_KINDS:
            told = frames.register_answer(data, self._settings[joint].id)
            if told is not None:
                self._overhear(joint, *told)
                return None
        grid = known.grid
        if grid is None:
            return None
        position, velocity, torque = feedback_in(data[1:6], grid)
        known.state = state = data[0] >> 4
        if abs(known.position - position) > grid.q:
            position = unwrap(position, known.position, grid.q_span)
        known.position, known.velocity = position, velocity
        self.powers[joint] = power = self._power(known)
        self.faults[joint] = fault = _fault_text(state)
        self.temperatures[joint] = temperature = float(max(data[6], data[7]))
        return Reading(joint, position, velocity, torque, math.nan, temperature, power, fault)

    def _overhear(self, joint: int, kind: int, register: int, value: float) -> None:
        """A register answer to another host's request: a range that it tells holds from now on.

        Without the request before it the bytes may as well be a reading near the lower end of the range.
        """
        known, asked = self._known[joint], self._asked
        field = RANGE_FIELDS.get(register)
        if asked != (joint, kind, register) or field is None or not 0.0 < value < LARGEST_RANGE:
            return
        self._asked = None
        known.use((known.ranges or UNKNOWN_RANGES)._replace(**{field: value}))

    @staticmethod
    def _power(known: _DamiaoState) -> Power:
        if known.state == ENABLED:
            return Power.STOPPED if known.damping else Power.ON
        return POWERS.get(known.state, Power.FAULT)

    def state_request(self, joint: int) -> list[Frame]:
        return [(frames.REGISTERS_ID, frames.refresh_request(self._settings[joint].id))]

    def lets_go(self, joint: int) -> bool:
        """See Drives: in every state but enabled."""
        return self._known[joint].state != ENABLED

    def own_stop(self, joint: int) -> str:
        if self._known[joint].state != DamiaoStatus.LOST_COMMUNICATION:
            return ""
        return f"{self.where(joint)}: lost communication (state Dh): its TIMEOUT ran out, the torque is off"

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """See Drives; of register requests it is noted which register was asked for, so that the answer is known."""
        if can_id == frames.REGISTERS_ID and len(data) == 8 and data[2] in (READ, WRITE):
            asked = self._joint_of.get(data[0] | data[1] << 8)
            self._asked = None if asked is None else (asked, data[2], data[3])
            return None
        return super().command_of(can_id, data)


def _fault_text(state: int) -> str:
    if state in NO_FAULTS:
        return ""
    words = FAULTS[DamiaoStatus(state)] if state in FAULTS else "unknown state"
    return f"{words} (state {state:X}h)"


FAMILY = Family(
    "damiao", TRAITS, DamiaoSettings, DamiaoDrives, summary="Damiao DM-J (OpenArm, YAM, reBot B601-DM), MIT mode"
)
