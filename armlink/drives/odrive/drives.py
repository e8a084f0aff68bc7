"""ODrive axes on one bus (CANSimple): inputs go out each cycle, estimates and torques come by the drive's own clock.

The drive's cyclic messages, its watchdog and its limits are set over USB: CANSimple cannot read them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import REMOTE, Frame
from armlink.drives.base import Ask, BasicDrives, DriveMemory, no_order
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.odrive import frames
from armlink.drives.odrive.frames import (
    INPUT_FEED_FORWARD,
    PASSTHROUGH,
    POSITION_CONTROL,
    TORQUE_CONTROL,
    VELOCITY_CONTROL,
    AxisError,
    AxisState,
    Message,
    error_names,
    identifier,
    pack,
    unpack,
)
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup, real32_step, real32_within
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BusFault


class ODriveSettings(DriveSettings):
    """One ODrive axis (Pro, S1, Micro; firmware 0.6) in CANSimple; positions and torques are the motor's."""

    family: Literal["odrive"] = "odrive"
    node: Annotated[int, Field(ge=0, le=0x3E)]
    """Node id (axis0.config.can.node_id)."""
    torque_constant: Positive | None = None
    """Torque constant of the motor, 8.27 / KV [N·m/A], by which the scale check compares torque
    with current; None: not compared."""

    @property
    def address(self) -> str:
        return f"node {self.node}"


TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="cyclic", frame="11")
FROM_DRIVE = (
    Message.VERSION, Message.HEARTBEAT, Message.ERROR, Message.ESTIMATES, Message.CURRENT, Message.TEMPERATURE,
    Message.BUS, Message.TORQUES,
)  # fmt: skip
FROM_HOST = (
    Message.ESTOP, Message.AXIS_STATE, Message.CONTROLLER_MODE, Message.INPUT_POSITION, Message.INPUT_VELOCITY,
    Message.INPUT_TORQUE, Message.LIMITS, Message.CLEAR_ERRORS, Message.POSITION_GAIN, Message.VELOCITY_GAINS,
)  # fmt: skip
REPEAT_SECONDS = 0.25
"""A request that shows in no heartbeat is sent again after this time [s]."""
START_SECONDS = 0.5
"""Longest wait for heartbeat, estimates and torques at the start [s]."""
MODE_FRAMES = 5
"""Cycles in which a change of the control mode is told. Nothing that the drive sends shows its mode: one frame that is
lost, or that an interruption keeps from leaving, would leave it under torque control while it is sent positions."""
LARGEST_POSITION = 1e5
"""No motor's position is larger [rev]; a larger one is no reading."""


@dataclass
class ODriveMemory(DriveMemory):
    heartbeat: frames.Heartbeat | None = None
    requested: int = 0
    """Torques that were asked for, and come besides the cyclic ones."""
    came: set[int] = field(default_factory=set)
    mode: int = 0
    """Control mode that it was last told; 0: none."""
    mode_frames: int = 0
    """How often it is still to be told."""
    asked: tuple[int, float] = (0, -math.inf)
    """Message or state that was last asked for, and when [s]."""
    stopping: bool = False
    """The newest input holds it where it stood, whatever was ordered."""


class ODriveDrives(BasicDrives[ODriveMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS, ODriveMemory)
        self._joint_of = {settings.node: joint for joint, settings in enumerate(self.settings)}

    def routes(self) -> Mapping[int, int]:
        return {identifier(node, message): joint for node, joint in self._joint_of.items() for message in FROM_DRIVE}

    def commands(self) -> Mapping[int, str]:
        return {
            identifier(node, message): f"{message.name.lower().replace('_', ' ')} to {self.names[joint]}"
            for node, joint in self._joint_of.items()
            for message in FROM_HOST
        }

    def cycle_bits(self) -> float:
        """The input, and estimates and torques as often."""
        return 3 * self.m * longest_frame_bits(8)

    def reading_ids(self) -> Mapping[int, int]:
        return {identifier(node, Message.ESTIMATES): joint for node, joint in self._joint_of.items()}

    # ---- set-up

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        """By a remote frame for the version, else by the cyclic heartbeat."""
        version = self._request(ask, joint, Message.VERSION)
        if version is None:
            came = self.memory[joint].came
            came.discard(Message.HEARTBEAT)
            there = ask.wait(lambda: Message.HEARTBEAT in came, START_SECONDS)
            return DriveIdentity(joint, self.settings[joint].address, there, "ODrive" if there else "")
        _, product, major, minor, *firmware, _ = (int(value) for value in version)
        text = ".".join(str(part) for part in firmware)
        wrong = "" if firmware[:2] >= [0, 6] else f"firmware {text}, expected 0.6 or newer"
        return self.present(joint, f"ODrive {product}.{major}.{minor}", "", text, wrong)

    def _request(self, ask: Ask, joint: int, message: Message) -> tuple[float, ...] | None:
        """Values of a message that is asked for by a remote frame; None where nothing answers."""
        can_id = identifier(self.settings[joint].node, message)

        def answer(came: int, data: bytes) -> tuple[float, ...] | None:
            return unpack(message, data) if came == can_id else None

        return ask((can_id | REMOTE, bytes(8)), answer)

    def positions(self, ask: Ask) -> list[float]:
        """By the estimates that come by themselves."""
        for known in self.memory:
            known.came.discard(Message.ESTIMATES)
        ask.wait(lambda: all(Message.ESTIMATES in known.came for known in self.memory), START_SECONDS)
        return [known.position if Message.ESTIMATES in known.came else math.nan for known in self.memory]

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        for joint in range(self.m):
            ask.send(*self._message(joint, Message.AXIS_STATE, AxisState.IDLE))
        wanted = {Message.HEARTBEAT, Message.ESTIMATES, Message.TORQUES}
        for known in self.memory:
            known.came.clear()
        ask.wait(lambda: all(wanted <= known.came for known in self.memory), START_SECONDS)
        return super().set_up(ask, limits)

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        known, name, address = self.memory[joint], self.names[joint], self.settings[joint].address
        if Message.HEARTBEAT not in known.came:
            raise BusFault(
                f"{name}: no heartbeat from {address}: check that the drive is powered and its node id and bit "
                "rate are right"
            )
        if Message.ESTIMATES not in known.came or not math.isfinite(known.position):
            raise BusFault(
                f"{name}: {address} sends no encoder estimates: set axis0.config.can.encoder_msg_rate_ms to "
                "the period of the cycle"
            )
        lost: tuple[str, ...] = ()
        modes = {int(Mode.POSITION), int(Mode.TORQUE)}
        if Message.TORQUES not in known.came:
            lost = ("no torque readings (1Ch) are received: to get them, set axis0.config.can.torques_msg_rate_ms",)
            modes.discard(int(Mode.TORQUE))
        known.limits, known.mode = limits, 0
        return Setup(
            position=known.position,
            torque=0.0,
            position_step=real32_step(known.position / math.tau) * math.tau,
            modes=frozenset(modes),
            lost=lost,
            notes=("watchdog, current limit and torque constant are set over USB and cannot be read over CAN",),
        )

    # ---- cycle

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known = self.memory[joint]
        state = known.heartbeat.state if known.heartbeat else AxisState.UNDEFINED
        on = state == AxisState.CLOSED_LOOP
        known.sent, known.stopping = None, False
        if order.power is Power.ON and on:
            return self._input(joint, order)
        if order.power is Power.ON and order.walk and known.heartbeat is not None:
            return self._towards_on(joint, order, now)
        if order.power is Power.STOPPED and on:
            # no state in which it holds without its host: no speed by input, whatever its position reads
            known.stopping = True
            known.sent = Order(Power.STOPPED, False, Mode.POSITION, known.position, 0.0, 0.0, 0.0, 0.0)
            return self._controlled(joint, VELOCITY_CONTROL, Message.INPUT_VELOCITY, pack(Message.INPUT_VELOCITY, 0, 0))
        if (
            order.power is not Power.ON
            and (on or state == AxisState.UNDEFINED)
            and _may_ask(known, AxisState.IDLE, now)
        ):
            return [self._message(joint, Message.AXIS_STATE, AxisState.IDLE)]
        return []

    def _towards_on(self, joint: int, order: Order, now: float) -> list[Frame]:
        known = self.memory[joint]
        if known.heartbeat is not None and known.heartbeat.error:
            may_clear = _may_ask(known, -Message.CLEAR_ERRORS, now)
            return [self._message(joint, Message.CLEAR_ERRORS, 0)] if may_clear else []
        known.mode = 0
        fed = self._input(joint, order)
        known.sent = None
        if _may_ask(known, AxisState.CLOSED_LOOP, now):
            return [*fed, self._message(joint, Message.AXIS_STATE, AxisState.CLOSED_LOOP)]
        return fed

    def _input(self, joint: int, order: Order) -> list[Frame]:
        limits = self.limits_of(joint)
        if order.mode == Mode.TORQUE:
            control, message = TORQUE_CONTROL, Message.INPUT_TORQUE
            data = pack(message, real32_within(_checked(order.torque), limits.max_torque))
        else:
            control, message = POSITION_CONTROL, Message.INPUT_POSITION
            data = frames.input_position(_checked(order.position) / math.tau, _checked(order.velocity) / math.tau, 0.0)
        told = _order_of(message, data)
        assert told is not None
        self.memory[joint].sent = told._replace(power=order.power)
        return self._controlled(joint, control, message, data)

    def _controlled(self, joint: int, control: int, message: Message, data: bytes) -> list[Frame]:
        """An input, after its control mode where that changes."""
        known, frame = self.memory[joint], (identifier(self.settings[joint].node, message), data)
        if known.mode != control:
            known.mode, known.mode_frames = control, MODE_FRAMES
        if not known.mode_frames:
            return [frame]
        known.mode_frames -= 1
        return [self._message(joint, Message.CONTROLLER_MODE, control, PASSTHROUGH), frame]

    def _message(self, joint: int, message: Message, *values: int) -> Frame:
        return identifier(self.settings[joint].node, message), pack(message, *values)

    def torque_by_current(self, joint: int, ask: Ask) -> tuple[float, float] | None:
        constant = self.settings[joint].torque_constant
        if constant is None:
            return None
        self.memory[joint].requested += 1
        torques, currents = self._request(ask, joint, Message.TORQUES), self._request(ask, joint, Message.CURRENT)
        return None if torques is None or currents is None else (torques[1], constant * currents[1])

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._joint_of.get(can_id >> 5)
        message = can_id & 0x1F
        values = unpack(message, data)
        if joint is None or values is None or message not in FROM_DRIVE:
            return None
        known = self.memory[joint]
        known.came.add(message)
        if message == Message.HEARTBEAT:
            known.heartbeat = frames.heartbeat(data)
            return self.note(Reading(joint, power=_power(known), fault=_fault_text(known)))
        if message == Message.ESTIMATES:
            position, velocity = values
            if not abs(position) < LARGEST_POSITION or not math.isfinite(velocity):
                return None
            known.position = position * math.tau
            return Reading(joint, known.position, velocity * math.tau)
        if message == Message.TORQUES and known.requested:
            known.requested -= 1
        elif message == Message.TORQUES and math.isfinite(values[1]):
            return Reading(joint, motor_torque=values[1])
        if message == Message.TEMPERATURE and all(math.isfinite(value) for value in values):
            return self.note(Reading(joint, temperature=max(values)))
        return None

    def lets_go(self, joint: int) -> bool:
        beat = self.memory[joint].heartbeat
        return beat is not None and beat.state != AxisState.CLOSED_LOOP

    def own_stop(self, joint: int) -> str:
        beat = self.memory[joint].heartbeat
        if beat is None or beat.state == AxisState.CLOSED_LOOP or not beat.error & AxisError.WATCHDOG:
            return ""
        return f"{self.where(joint)}: its watchdog ran out: it is idle, and the torque is off"

    def forget(self, restarts: bool = False) -> None:
        """The next request goes out at once."""
        super().forget(restarts)
        for known in self.memory:
            known.asked = (0, -math.inf)

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint, order = self._joint_of.get(can_id >> 5), _order_of(can_id & 0x1F, data)
        return None if joint is None or order is None else (joint, order)


def _may_ask(known: ODriveMemory, what: int, now: float) -> bool:
    """Whether something may be asked for: not again before the last request for it has had time to show."""
    if known.asked[0] == what and now - known.asked[1] < REPEAT_SECONDS:
        return False
    known.asked = (what, now)
    return True


def _power(known: ODriveMemory) -> Power:
    """The state counts, not the error: that can be 0 after a disarm."""
    beat = known.heartbeat
    if beat is None:
        return Power.UNKNOWN
    if beat.state == AxisState.CLOSED_LOOP:
        return Power.STOPPED if known.stopping else Power.ON
    if beat.error & AxisError.WATCHDOG:
        return Power.STOPPED
    if beat.error:
        return Power.FAULT
    return Power.OFF if beat.state == AxisState.IDLE else Power.READY


def _fault_text(known: ODriveMemory) -> str:
    error = known.heartbeat.error & ~AxisError.WATCHDOG if known.heartbeat else 0
    return f"{error_names(error)} (axis error {error:#x})" if error else ""


def _order_of(message: int, data: bytes) -> Order | None:
    values = unpack(message, data)
    if message == Message.ESTOP:
        return no_order()._replace(power=Power.OFF)
    if values is None:
        return None
    if message == Message.AXIS_STATE:
        power: dict[float, Power] = {AxisState.IDLE: Power.OFF, AxisState.CLOSED_LOOP: Power.ON}
        return no_order()._replace(power=power[values[0]]) if values[0] in power else None
    if message == Message.INPUT_TORQUE:
        return Order(Power.ON, False, Mode.TORQUE, math.nan, math.nan, values[0], 0.0, 0.0)
    if message == Message.INPUT_POSITION:
        position, velocity, torque = values
        return Order(
            Power.ON, False, Mode.POSITION, position * math.tau, velocity * INPUT_FEED_FORWARD * math.tau,
            torque * INPUT_FEED_FORWARD, 0.0, 0.0,
        )  # fmt: skip
    return None


def _checked(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"the order is {value}: expected a finite number")
    return value


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By the heartbeats heard; another device hardly sends nothing but CANSimple on its identifiers."""
    known, messages, beats, others = sum(AxisError), set(map(int, Message)), dict[int, list[bool]](), set[int]()
    for can_id, data in bus.heard:
        node, message = can_id >> 5, can_id & 0x1F
        if can_id > 0x7FF:
            continue
        if message not in messages:
            others.add(node)
        if message == Message.HEARTBEAT:
            beat = frames.heartbeat(data)
            real = beat is not None and not beat.error & ~known and beat.state <= max(AxisState) and beat.done <= 1
            beats.setdefault(node, []).append(real)
    return [
        FoundDrive("odrive", node, f"node {node}", {"node": node}, note="gear 1 assumed: torques are the motor's")
        if node < 0x3F
        else FoundDrive("odrive", node, f"node {node}", wrong="the axis has no node id: set axis0.config.can.node_id")
        for node, real in sorted(beats.items())
        if len(real) > 1 and all(real) and node not in others
    ]


SEARCH = Discovery(find_drives)
SUMMARY = "ODrive Pro, S1, Micro with firmware 0.6, CANSimple"
FAMILY = Family("odrive", TRAITS, ODriveSettings, ODriveDrives, discovery=SEARCH, summary=SUMMARY)
