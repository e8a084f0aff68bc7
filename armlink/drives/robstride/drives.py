"""RobStride drives on one bus, in the private protocol: one motion command and one feedback a cycle."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from armlink.arm_file import LinkJoint, LinkSection
from armlink.bus.port import EXTENDED, Frame
from armlink.drives.family import Ask, Drives
from armlink.drives.mit_packing import MitCommand, Ranges, round_within
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.robstride import frames
from armlink.drives.robstride.frames import RANGES, Type, fault_names
from armlink.drives.robstride.set_up import identify, prepare
from armlink.drives.traits import Traits
from armlink.errors import BusFault, Stall

TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="reply", frame="29")
HOST_TYPES = frozenset((Type.MOTION, Type.ENABLE, Type.STOP, Type.SET_ZERO, Type.SET_ID, Type.WRITE, Type.SAVE))
"""Frames that change something, which one host alone may send."""
NOTHING = Order(Power.UNKNOWN, False, Mode.OFF, *[math.nan] * 5)


@dataclass
class _Known:
    """What is known of one drive."""

    ranges: Ranges
    limits: Limits | None = None
    mode: int | None = None
    faults: int = 0
    position: float = math.nan
    velocity: float = math.nan
    damping: bool = False
    was_on: bool = False
    """It has been on since forget()."""
    sent: Order = NOTHING


class CommandIds(Mapping[int, int]):
    """Identifiers of a host's commands → joint: the torque of a motion command is part of its identifier."""

    def __init__(self, joint_of: Mapping[int, int]) -> None:
        """`joint_of`: motor id → joint."""
        self._joint_of = joint_of

    def __getitem__(self, can_id: int) -> int:
        if not can_id & EXTENDED or frames.kind_of(can_id) not in HOST_TYPES:
            raise KeyError(can_id)
        return self._joint_of[can_id & 0xFF]

    def __iter__(self) -> Iterator[int]:
        """One identifier of each type and drive."""
        return (frames.identifier(kind, 0, drive) | EXTENDED for drive in self._joint_of for kind in HOST_TYPES)

    def __len__(self) -> int:
        """Number of types and drives."""
        return len(self._joint_of) * len(HOST_TYPES)


class RobStrideDrives(Drives):
    """The drives of one bus; see `Drives`."""

    def __init__(self, joints: Sequence[LinkJoint], section: LinkSection) -> None:
        """Nothing is sent."""
        self._names = [joint.name for joint in joints]
        self._settings = [joint.settings for joint in joints]
        self._known = [_Known(RANGES[settings.model]) for settings in self._settings]
        self._joint_of = {settings.id: joint for joint, settings in enumerate(self._settings)}

    def traits(self, joint: int) -> Traits:
        """See Drives."""
        return TRAITS

    def routes(self) -> Mapping[int, int]:
        """Feedback and reports, with all modes and faults that their identifiers may tell."""
        found = {}
        for joint, settings in enumerate(self._settings):
            for kind in (Type.FEEDBACK, Type.REPORT):
                for head in range(0x100):
                    found[frames.identifier(kind, head << 8 | settings.id, settings.host) | EXTENDED] = joint
        return found

    def commands(self) -> Mapping[int, int]:
        """See Drives."""
        return CommandIds(self._joint_of)

    # ---- set-up

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """See Drives."""
        found = []
        for joint, settings in enumerate(self._settings):
            serial = identify(ask, settings)
            there = serial is not None
            found.append(
                DriveIdentity(
                    joint,
                    settings.address,
                    there,
                    f"RobStride {settings.model}" if there else "",
                    serial or "",
                    power=self.power(joint),
                )
            )
        return found

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """See Drives."""
        found = []
        for joint, (known, settings, limit) in enumerate(zip(self._known, self._settings, limits, strict=True)):
            result = prepare(ask, self._names[joint], settings, limit, known.ranges)
            known.limits, known.mode, known.position, known.was_on = limit, None, result.position, False
            found.append(result)
        return found

    # ---- cycle

    def frames(self, orders: Sequence[Order], now: float) -> list[Frame]:
        """See Drives."""
        found = []
        for joint, order in enumerate(orders):
            can_id, data = self._frame(joint, order)
            found.append((can_id | EXTENDED, data))
        return found

    def _frame(self, joint: int, order: Order) -> Frame:
        known, settings = self._known[joint], self._settings[joint]
        known.damping = False
        on = known.mode == frames.Mode.RUN and not known.faults
        if on and order.power is Power.ON:
            known.was_on = True
            return self._command(joint, order)
        if on and order.power is Power.STOPPED:
            known.damping = True
            quiet = MitCommand(known.position, 0.0, 0.0, settings.kd, 0.0)
            return self._motion(joint, quiet, Power.STOPPED)
        known.sent = NOTHING._replace(power=Power.OFF)
        if order.power is Power.ON and order.walk and known.mode is not None and not known.faults:
            known.sent = NOTHING._replace(power=Power.READY)
            return frames.enable_frame(settings.id, settings.host)
        return frames.stop_frame(settings.id, settings.host, clear_fault=order.walk and bool(known.faults))

    def _command(self, joint: int, order: Order) -> Frame:
        known = self._known[joint]
        if known.limits is None:
            raise BusFault(f"{self._names[joint]}: a command before the set-up")
        stiff = order.mode == Mode.POSITION
        asked = MitCommand(
            order.position, order.velocity, order.kp if stiff else 0.0, order.kd if stiff else 0.0, order.torque
        )
        ranges, drive = known.ranges, self._settings[joint].id
        rounded = round_within(
            asked,
            lambda command: frames.unpack_motion(*frames.motion_frame(drive, command, ranges), ranges),
            ranges,
            2 * ranges.torque / 0xFFFF,
            known.limits,
            known.position,
            known.velocity,
        )
        return self._motion(joint, rounded, Power.ON)

    def _motion(self, joint: int, command: MitCommand, power: Power) -> Frame:
        known = self._known[joint]
        frame = frames.motion_frame(self._settings[joint].id, command, known.ranges)
        known.sent = _order_of(frames.unpack_motion(*frame, known.ranges))._replace(power=power)
        return frame

    def sent(self, joint: int) -> Order:
        """See Drives."""
        return self._known[joint].sent

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """See Drives."""
        joint = self._joint_of.get(frames.data_of(can_id) & 0xFF)
        if joint is None or not can_id & EXTENDED or can_id & 0xFF != self._settings[joint].host:
            return None
        known = self._known[joint]
        feedback = frames.unpack_feedback(can_id, data, known.ranges)
        if feedback is None:
            return None
        known.mode, known.faults = feedback.mode, feedback.faults
        known.position, known.velocity = feedback.motion.position, feedback.motion.velocity
        return Reading(
            joint,
            feedback.motion.position,
            feedback.motion.velocity,
            feedback.motion.torque,
            temperature=feedback.temperature,
            power=self.power(joint),
            fault=fault_names(feedback.faults),
        )

    def power(self, joint: int) -> Power:
        """See Drives."""
        known = self._known[joint]
        if known.mode is None:
            return Power.UNKNOWN
        if known.faults:
            return Power.FAULT
        if known.mode == frames.Mode.RUN:
            return Power.STOPPED if known.damping else Power.ON
        return Power.OFF if known.mode == frames.Mode.RESET else Power.READY

    def fault(self, joint: int, wanted_on: bool, now: float) -> BusFault | None:
        """See Drives. A watchdog that ran out shows as mode reset alone."""
        known, name = self._known[joint], self._names[joint]
        if known.faults:
            return BusFault(f"{name}: {fault_names(known.faults)} (fault bits {known.faults:02X}h)")
        if wanted_on and known.mode is not None and known.mode != frames.Mode.RUN:
            text = f"{name}: the drive went to mode {known.mode} (reset) by itself"
            if known.was_on:
                return Stall(f"{text}: its canTimeout ran out, the torque is off")
            return BusFault(f"{text}, expected run")
        return None

    def forget(self, joint: int) -> None:
        """See Drives; mode and faults are those of the newest feedback."""
        self._known[joint].damping = self._known[joint].was_on = False

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """See Drives."""
        joint = self._joint_of.get(can_id & 0xFF)
        if joint is None or not can_id & EXTENDED or len(data) != 8:
            return None
        kind = frames.kind_of(can_id)
        if kind == Type.MOTION:
            return joint, _order_of(frames.unpack_motion(can_id, data, self._known[joint].ranges))
        powers: dict[int, Power] = {Type.ENABLE: Power.ON, Type.STOP: Power.OFF}
        power = powers.get(kind)
        return None if power is None else (joint, NOTHING._replace(power=power))


def _order_of(command: MitCommand) -> Order:
    mode = Mode.POSITION if command.kp > 0 else Mode.TORQUE
    return Order(Power.ON, False, mode, command.position, command.velocity, command.torque, command.kp, command.kd)
