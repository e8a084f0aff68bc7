"""RobStride drives on one bus, in the private protocol: one motion command and one feedback a cycle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.port import EXTENDED, Frame
from armlink.drives.base import BasicDrives, no_order
from armlink.drives.family import ANY, BROADCAST, Ask, Family
from armlink.drives.mit_leash import damping, order_of, round_within
from armlink.drives.mit_packing import MitCommand, Ranges, grid_of
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.robstride import frames
from armlink.drives.robstride.frames import RANGES, RobStrideParameter, Type, fault_names
from armlink.drives.robstride.set_up import identify, prepare, read_parameter
from armlink.drives.robstride.settings import RobStrideSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault

TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="reply", frame="29")
HOST_TYPES = frozenset((Type.MOTION, Type.ENABLE, Type.STOP, Type.SET_ZERO, Type.SET_ID, Type.WRITE, Type.SAVE))
"""Frames that change something, which one host alone may send."""


@dataclass
class _RobStrideState:
    """Newest state of one drive."""

    ranges: Ranges
    limits: Limits | None = None
    mode: int | None = None
    faults: int = 0
    position: float = math.nan
    velocity: float = math.nan
    damping: bool = False
    was_on: bool = False
    """It has been on since forget()."""
    sent: Order | None = None


class RobStrideDrives(BasicDrives):
    """The drives of one bus; see `Drives`."""

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS)
        self._settings = [joint.settings for joint in joints]
        self._known = [_RobStrideState(RANGES[settings.model]) for settings in self._settings]
        self._joint_of = {settings.id: joint for joint, settings in enumerate(self._settings)}
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
            for joint, settings in enumerate(self._settings)
            for kind in (Type.FEEDBACK, Type.REPORT)
            for head in range(0x100)
        }

    # ---- set-up

    def identify(self, ask: Ask) -> list[DriveIdentity]:
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

    def positions(self, ask: Ask) -> list[float]:
        found = [read_parameter(ask, settings, RobStrideParameter.POSITION) for settings in self._settings]
        return [math.nan if position is None else position for position in found]

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        found = []
        for joint, (known, settings, limit) in enumerate(zip(self._known, self._settings, limits, strict=True)):
            result = prepare(ask, self.names[joint], settings, limit, known.ranges)
            known.limits, known.mode, known.position, known.was_on = limit, None, result.position, False
            found.append(result)
        return found

    # ---- cycle

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        found = [self._frame(joint, order) for joint, order in enumerate(orders) if order is not None]
        return [(can_id | EXTENDED, data) for can_id, data in found]

    def _frame(self, joint: int, order: Order) -> Frame:
        known, settings = self._known[joint], self._settings[joint]
        known.damping = False
        on = known.mode == frames.RunMode.RUN and not known.faults
        if on and order.power is Power.ON:
            known.was_on = True
            return self._command(joint, order)
        if on and order.power is Power.STOPPED:
            known.damping = True
            assert known.limits is not None
            quiet = damping(settings.kd, known.position, known.velocity, known.limits.max_torque)
            return self._motion(joint, frames.motion_frame(settings.id, quiet, known.ranges), Power.STOPPED)
        known.sent = None
        known.was_on = known.was_on and order.power is Power.ON
        if order.power is Power.ON and order.walk and known.mode is not None and not known.faults:
            if known.limits is None:
                raise BusFault(f"{self.names[joint]}: a command before the set-up")
            return frames.enable_frame(settings.id, settings.host)
        return frames.stop_frame(settings.id, settings.host, clear_fault=order.walk and bool(known.faults))

    def _command(self, joint: int, order: Order) -> Frame:
        known = self._known[joint]
        if known.limits is None:
            raise BusFault(f"{self.names[joint]}: a command before the set-up")
        stiff = order.mode == Mode.POSITION
        asked = MitCommand(
            order.position, order.velocity, order.kp if stiff else 0.0, order.kd if stiff else 0.0, order.torque
        )
        ranges, drive = known.ranges, self._settings[joint].id
        steps = round_within(asked, grid_of(ranges, frames.MOTION_BITS), known.limits, known.position, known.velocity)
        return self._motion(joint, frames.motion_of_steps(drive, *steps), Power.ON)

    def _motion(self, joint: int, frame: Frame, power: Power) -> Frame:
        known = self._known[joint]
        known.sent = order_of(frames.unpack_motion(*frame, known.ranges))._replace(power=power)
        return frame

    def sent(self, joint: int) -> Order | None:
        return self._known[joint].sent

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if not can_id & EXTENDED:
            return None
        if intruder := self.intrusion(can_id, data):
            self._intruder = f"another host sends {intruder} ({can_id & 0x1FFFFFFF:08X}h)"
        joint = self._joint_of.get(frames.data_of(can_id) & 0xFF)
        if joint is None:
            return None
        known = self._known[joint]
        if known.limits is not None and can_id & 0xFF != self._settings[joint].host:
            return None  # a listener, who has set nothing up, takes what is said to any host
        feedback = frames.unpack_feedback(can_id, data, known.ranges)
        if feedback is None:
            return None
        known.mode, known.faults = feedback.mode, feedback.faults
        known.position, known.velocity = feedback.motion.position, feedback.motion.velocity
        return self.note(
            Reading(
                joint,
                feedback.motion.position,
                feedback.motion.velocity,
                feedback.motion.torque,
                temperature=feedback.temperature,
                power=_power(known),
                fault=_fault_text(feedback.faults),
            )
        )

    def alarm(self) -> BusFault | None:
        """See Drives: another host."""
        return BusFault(self._intruder) if self._intruder else None

    def state_request(self, joint: int) -> list[Frame]:
        """See Drives: the torque limit, written as it is, since a reading is answered without the mode."""
        known, settings = self._known[joint], self._settings[joint]
        if known.limits is None:
            return []
        most = min(known.limits.max_torque, known.ranges.torque)
        can_id, data = frames.write_frame(settings.id, settings.host, frames.RobStrideParameter.LIMIT_TORQUE, most)
        return [(can_id | EXTENDED, data)]

    def lets_go(self, joint: int) -> bool:
        """See Drives: in every mode but run."""
        return self._known[joint].mode != frames.RunMode.RUN

    def own_stop(self, joint: int) -> str:
        """See Drives: a watchdog that ran out shows as mode reset alone."""
        known = self._known[joint]
        if not known.was_on or known.mode != frames.RunMode.RESET or known.faults:
            return ""
        return f"{self.where(joint)}: went to mode reset: its canTimeout ran out, the torque is off"

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        self._intruder = ""
        for known in self._known:
            known.damping = known.was_on = False

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._joint_of.get(can_id & 0xFF)
        if joint is None or not can_id & EXTENDED or len(data) != 8:
            return None
        kind = frames.kind_of(can_id)
        if kind == Type.MOTION:
            return joint, order_of(frames.unpack_motion(can_id, data, self._known[joint].ranges))
        powers: dict[int, Power] = {Type.ENABLE: Power.ON, Type.STOP: Power.OFF}
        power = powers.get(kind)
        return None if power is None else (joint, no_order()._replace(power=power))


def _power(known: _RobStrideState) -> Power:
    if known.faults:
        return Power.FAULT
    if known.mode == frames.RunMode.RUN:
        return Power.STOPPED if known.damping else Power.ON
    return Power.OFF if known.mode == frames.RunMode.RESET else Power.READY


def _fault_text(bits: int) -> str:
    return f"{fault_names(bits)} (fault bits {bits:02X}h)" if bits else ""


FAMILY = Family(
    "robstride",
    TRAITS,
    RobStrideSettings,
    RobStrideDrives,
    summary="RobStride RS00 to RS06 (reBot B601-RS), private protocol",
)
