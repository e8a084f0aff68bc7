"""ODrive axes on one bus (CANSimple): inputs go out each cycle, estimates and torques come by the drive's own clock.

The drive's cyclic messages, its watchdog and its limits are set over USB: CANSimple cannot read them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from armlink.arm_file import LinkJoint, LinkSection
from armlink.bus.port import REMOTE, Frame
from armlink.drives.family import Ask, Drives
from armlink.drives.odrive import frames
from armlink.drives.odrive.frames import (
    INPUT_FEED_FORWARD,
    PASSTHROUGH,
    POSITION_CONTROL,
    TORQUE_CONTROL,
    AxisError,
    AxisState,
    Message,
    error_names,
    identifier,
    pack,
    unpack,
)
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.traits import Traits
from armlink.errors import BusFault, Stall

TURN = 2 * math.pi
TRAITS = Traits(torque="current", calibration="host", silence="falls", bounds=(), cadence="cyclic", frame="11")
FROM_DRIVE = (
    Message.VERSION, Message.HEARTBEAT, Message.ERROR, Message.ESTIMATES, Message.CURRENT, Message.TEMPERATURE,
    Message.BUS, Message.TORQUES,
)  # fmt: skip
FROM_HOST = (
    Message.ESTOP, Message.AXIS_STATE, Message.CONTROLLER_MODE, Message.INPUT_POSITION, Message.INPUT_VELOCITY,
    Message.INPUT_TORQUE, Message.LIMITS, Message.CLEAR_ERRORS, Message.POSITION_GAIN, Message.VELOCITY_GAINS,
)  # fmt: skip
ASK_AGAIN = 0.25
"""A request that shows in no heartbeat is sent again after this time [s]."""
PATIENCE = 0.5
"""Longest wait for heartbeat, estimates and torques at the start [s]."""
LARGEST_POSITION = 1e5
"""No motor's position is larger [rev]; a larger one is no reading."""
NOTHING = Order(Power.UNKNOWN, False, Mode.OFF, *[math.nan] * 5)


@dataclass
class _Known:
    """What is known of one axis."""

    limits: Limits | None = None
    heartbeat: frames.Heartbeat | None = None
    position: float = math.nan
    """[rad]."""
    velocity: float = math.nan
    torque: float = math.nan
    came: set[int] = field(default_factory=set)
    """Messages that have come."""
    mode: int = 0
    """Control mode that it was last told; 0: none."""
    asked: float = -math.inf
    """When a state was last asked for [s]."""
    was_on: bool = False
    sent: Order = NOTHING


class ODriveDrives(Drives):
    """The axes of one bus; see `Drives`."""

    def __init__(self, joints: Sequence[LinkJoint], section: LinkSection) -> None:
        """Nothing is sent."""
        self._names = [joint.name for joint in joints]
        self._settings = [joint.settings for joint in joints]
        self._known = [_Known() for _ in joints]
        self._joint_of = {settings.node: joint for joint, settings in enumerate(self._settings)}

    def traits(self, joint: int) -> Traits:
        """See Drives."""
        return TRAITS

    def routes(self) -> Mapping[int, int]:
        """See Drives."""
        return {identifier(node, message): joint for node, joint in self._joint_of.items() for message in FROM_DRIVE}

    def commands(self) -> Mapping[int, int]:
        """See Drives."""
        return {identifier(node, message): joint for node, joint in self._joint_of.items() for message in FROM_HOST}

    # ---- set-up

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        """See Drives: by a remote frame for the version, else by the cyclic heartbeat."""
        found = []
        for joint, settings in enumerate(self._settings):
            version = self._request(ask, joint, Message.VERSION)
            if version is None:
                known = self._known[joint]
                ask.wait(lambda known=known: known.heartbeat is not None, PATIENCE)  # type: ignore[misc]
                there = known.heartbeat is not None
                found.append(DriveIdentity(joint, settings.address, there, "ODrive" if there else ""))
                continue
            _, product, major, minor, *firmware, _ = (int(value) for value in version)
            name = f"ODrive {product}.{major}.{minor}"
            text = ".".join(str(part) for part in firmware)
            wrong = "" if firmware[:2] >= [0, 6] else f"firmware {text}, expected 0.6 or newer"
            found.append(DriveIdentity(joint, settings.address, True, name, "", text, self.power(joint), wrong))
        return found

    def _request(self, ask: Ask, joint: int, message: Message) -> tuple[float, ...] | None:
        """Values of a message that is asked for by a remote frame; None where nothing answers."""
        can_id = identifier(self._settings[joint].node, message)

        def answer(came: int, data: bytes) -> tuple[float, ...] | None:
            return unpack(message, data) if came == can_id else None

        return ask((can_id | REMOTE, bytes(8)), answer)

    def set_up(self, ask: Ask, limits: Sequence[Limits]) -> list[Setup]:
        """See Drives: idle, and its cyclic messages come."""
        for settings in self._settings:
            ask.send(identifier(settings.node, Message.AXIS_STATE), pack(Message.AXIS_STATE, AxisState.IDLE))
        wanted = {Message.HEARTBEAT, Message.ESTIMATES, Message.TORQUES}
        for known in self._known:
            known.came.clear()
        ask.wait(lambda: all(wanted <= known.came for known in self._known), PATIENCE)
        return [self._result(joint, limit) for joint, limit in enumerate(limits)]

    def _result(self, joint: int, limit: Limits) -> Setup:
        known, name, address = self._known[joint], self._names[joint], self._settings[joint].address
        if Message.HEARTBEAT not in known.came:
            raise BusFault(f"{name}: no heartbeat from {address}: is it powered, its node id and bit rate right?")
        if Message.ESTIMATES not in known.came or not math.isfinite(known.position):
            raise BusFault(
                f"{name}: {address} sends no encoder estimates: set axis0.config.can.encoder_msg_rate_ms to the cycle"
            )
        lost: tuple[str, ...] = ()
        modes = {int(Mode.POSITION), int(Mode.TORQUE)}
        if Message.TORQUES not in known.came:
            lost = ("torques (1Ch) do not come: no torque reading; set axis0.config.can.torques_msg_rate_ms",)
            modes.discard(int(Mode.TORQUE))
        known.limits, known.mode, known.was_on = limit, 0, False
        return Setup(
            position=known.position,
            torque=0.0,
            position_step=TURN * 2.0**-23 * max(1.0, abs(known.position) / TURN),
            modes=frozenset(modes),
            lost=lost,
            notes=("watchdog, current limit and torque constant are set over USB and cannot be read over CAN",),
        )

    # ---- cycle

    def frames(self, orders: Sequence[Order], now: float) -> list[Frame]:
        """See Drives."""
        return [frame for joint, order in enumerate(orders) for frame in self._frames(joint, order, now)]

    def _frames(self, joint: int, order: Order, now: float) -> list[Frame]:
        known = self._known[joint]
        state = known.heartbeat.state if known.heartbeat else AxisState.UNDEFINED
        on = state == AxisState.CLOSED_LOOP
        known.sent = NOTHING._replace(power=Power.OFF)
        if order.power is Power.ON and on:
            known.was_on = True
            return self._input(joint, order)
        if order.power is Power.ON and order.walk and known.heartbeat is not None:
            return self._towards_on(joint, order, now)
        if order.power is Power.STOPPED and on:
            # no state in which it holds without its host: hold by input, where it stands now
            return self._input(joint, self._standing(joint))
        if order.power is not Power.ON and (on or state == AxisState.UNDEFINED) and self._may_ask(known, now):
            return [self._message(joint, Message.AXIS_STATE, AxisState.IDLE)]
        return []

    def _towards_on(self, joint: int, order: Order, now: float) -> list[Frame]:
        known = self._known[joint]
        known.sent = NOTHING._replace(power=Power.READY)
        found: list[Frame] = []
        if known.heartbeat is not None and known.heartbeat.error:
            if self._may_ask(known, now):
                found = [self._message(joint, Message.CLEAR_ERRORS, 0)]
            return found
        known.mode = 0
        fed = self._input(joint, order)
        known.sent = NOTHING._replace(power=Power.READY)
        if self._may_ask(known, now):
            return [*fed, self._message(joint, Message.AXIS_STATE, AxisState.CLOSED_LOOP)]
        return fed

    def _may_ask(self, known: _Known, now: float) -> bool:
        """Whether a state may be asked for: not before the last request has had time to show."""
        if now - known.asked < ASK_AGAIN:
            return False
        known.asked = now
        return True

    def _standing(self, joint: int) -> Order:
        known = self._known[joint]
        held = known.sent.position if known.sent.power is Power.STOPPED else known.position
        return Order(Power.STOPPED, False, Mode.POSITION, held, 0.0, 0.0, 0.0, 0.0)

    def _input(self, joint: int, order: Order) -> list[Frame]:
        """Control mode where it changes, and the input."""
        known = self._known[joint]
        if known.limits is None:
            raise BusFault(f"{self._names[joint]}: a command before the set-up")
        control = TORQUE_CONTROL if order.mode == Mode.TORQUE else POSITION_CONTROL
        if control == TORQUE_CONTROL:
            most = known.limits.max_torque * (1 - 2.0**-23)
            data = pack(Message.INPUT_TORQUE, max(-most, min(most, _checked(order.torque))))
            frame = identifier(self._settings[joint].node, Message.INPUT_TORQUE), data
        else:
            data = frames.input_position(_checked(order.position) / TURN, _checked(order.velocity) / TURN, 0.0)
            frame = identifier(self._settings[joint].node, Message.INPUT_POSITION), data
        told = _order_of(*frame)
        assert told is not None
        known.sent = told._replace(power=order.power)
        if known.mode == control:
            return [frame]
        known.mode = control
        return [self._message(joint, Message.CONTROLLER_MODE, control, PASSTHROUGH), frame]

    def _message(self, joint: int, message: Message, *values: int) -> Frame:
        return identifier(self._settings[joint].node, message), pack(message, *values)

    def sent(self, joint: int) -> Order:
        """See Drives."""
        return self._known[joint].sent

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        """See Drives."""
        joint = self._joint_of.get(can_id >> 5)
        message = can_id & 0x1F
        values = unpack(message, data)
        if joint is None or values is None or message not in FROM_DRIVE:
            return None
        known = self._known[joint]
        known.came.add(message)
        if message == Message.HEARTBEAT:
            known.heartbeat = frames.heartbeat(data)
            return Reading(joint, power=self.power(joint), fault=self._fault_text(known))
        if message == Message.ESTIMATES:
            position, velocity = values
            if not abs(position) < LARGEST_POSITION or not math.isfinite(velocity):
                return None
            known.position, known.velocity = position * TURN, velocity * TURN
            return Reading(joint, known.position, known.velocity)
        if message == Message.TORQUES and math.isfinite(values[1]):
            known.torque = values[1]
            return Reading(joint, motor_torque=values[1])
        if message == Message.TEMPERATURE and all(math.isfinite(value) for value in values):
            return Reading(joint, temperature=max(values))
        return None

    def power(self, joint: int) -> Power:
        """See Drives. The state counts, not the error: that can be 0 after a disarm."""
        known = self._known[joint]
        if known.heartbeat is None:
            return Power.UNKNOWN
        if known.heartbeat.state == AxisState.CLOSED_LOOP:
            return Power.STOPPED if known.sent.power is Power.STOPPED else Power.ON
        if known.heartbeat.error:
            return Power.FAULT
        return Power.OFF if known.heartbeat.state == AxisState.IDLE else Power.READY

    def fault(self, joint: int, wanted_on: bool, now: float) -> BusFault | None:
        """See Drives."""
        known, name = self._known[joint], self._names[joint]
        if known.heartbeat is None or known.heartbeat.state == AxisState.CLOSED_LOOP:
            return None
        text = self._fault_text(known)
        if text:
            watchdog = known.heartbeat.error & AxisError.WATCHDOG
            return (Stall if watchdog else BusFault)(f"{name}: {text}")
        if wanted_on:
            state = known.heartbeat.state
            return BusFault(f"{name}: the axis is in state {state} without telling an error, expected 8 (closed loop)")
        return None

    @staticmethod
    def _fault_text(known: _Known) -> str:
        error = known.heartbeat.error if known.heartbeat else 0
        return f"{error_names(error)} (axis error {error:#x})" if error else ""

    def forget(self, joint: int) -> None:
        """See Drives; the next request goes out at once."""
        self._known[joint].asked = -math.inf
        self._known[joint].was_on = False

    # ---- listening

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        """See Drives."""
        joint = self._joint_of.get(can_id >> 5)
        if joint is None:
            return None
        order = _order_of(can_id, data)
        return None if order is None else (joint, order)


def _order_of(can_id: int, data: bytes) -> Order | None:
    """The order that a host's message gives, or None."""
    message = can_id & 0x1F
    values = unpack(message, data)
    if message == Message.ESTOP:
        return NOTHING._replace(power=Power.OFF)
    if values is None:
        return None
    if message == Message.AXIS_STATE:
        power: dict[float, Power] = {AxisState.IDLE: Power.OFF, AxisState.CLOSED_LOOP: Power.ON}
        return NOTHING._replace(power=power[values[0]]) if values[0] in power else None
    if message == Message.INPUT_TORQUE:
        return Order(Power.ON, False, Mode.TORQUE, math.nan, math.nan, values[0], 0.0, 0.0)
    if message == Message.INPUT_POSITION:
        position, velocity, torque = values
        return Order(
            Power.ON, False, Mode.POSITION, position * TURN, velocity * INPUT_FEED_FORWARD * TURN,
            torque * INPUT_FEED_FORWARD, 0.0, 0.0,
        )  # fmt: skip
    return None


def _checked(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"an order of {value}: expected a finite number")
    return value
