"""Orders become frames: RPDO1 of every joint, RPDO2 where a mode changes, heartbeat and SYNC; and back, for a check."""

import math
import struct
from collections.abc import Callable, Sequence

from armlink.bus.port import Frame
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import (
    Control,
    DriveState,
    loop_gain,
    next_control,
    set_point_control,
    state_of,
    velocity_towards,
)
from armlink.drives.canopen.cyclic.wire import INT32_MAX, Wire
from armlink.drives.canopen.faults import JointStates
from armlink.drives.canopen.pdo import RPDO1, RPDO2
from armlink.drives.orders import Mode, Order, Power

OFF, PROFILE_POSITION = int(Mode.OFF), int(Mode.PROFILE_POSITION)
ENABLE, DISABLE_VOLTAGE = int(Control.ENABLE), int(Control.DISABLE_VOLTAGE)
FAULT_RESET, QUICK_STOP = int(Control.FAULT_RESET), int(Control.QUICK_STOP)
TARGETS = {Power.ON: DriveState.ENABLED, Power.OFF: DriveState.SWITCH_ON_DISABLED, Power.STOPPED: DriveState.QUICK_STOP}
SYNC: Frame = (objects.SYNC_ID, b"")
_OPERATIONAL = bytes([objects.OPERATIONAL])


class CommandFrames:
    """Frames of each cycle for m joints; what each joint was sent last can be decoded again."""

    def __init__(self, known: JointStates, host: int, beat_every: float, period: float) -> None:
        """`known` is what the joints show; `host` is our own node id, whose heartbeat is due every `beat_every` [s]."""
        self._known, self._period, self._beat_every = known, period, beat_every
        self.beating = True
        """Whether the host's heartbeat is sent; not, so that the joints' watching it is put to the test."""
        self.heartbeat: Frame = (objects.HEARTBEAT_ID + host, _OPERATIONAL)
        self._wires: Sequence[Wire] = ()
        self._own: list[dict[int, int]] = []
        """Modes of orders that a device stands in for by another of its own."""
        self._any_own = False
        self._rows: list[tuple[bool, int, Callable[..., bytes], float, int, float, float, float, int, int]] = []
        self._readers: list[tuple[int, Callable[[bytes], tuple[int, ...]], float, float]] = []
        """Size of RPDO1, what unpacks it, and the units of its torque (NaN: it has none) and position."""
        m = len(known.names)
        self._sent: list[bytes | None] = [None] * m
        self._aimed = [math.nan] * m
        """Last target of a joint that is led by velocity [rad]."""
        self.restart()

    def restart(self) -> None:
        """Drives that were set up anew: in no mode, nothing sent yet."""
        m = len(self._known.names)
        self._beat = -math.inf
        self.modes, self._words, self._walking = [OFF] * m, [FAULT_RESET] * m, [False] * m

    def forget_walk(self) -> None:
        """The next step towards a power state is a first one."""
        self._walking = [False] * len(self._walking)

    def use(self, wires: Sequence[Wire]) -> None:
        """From now on these layouts, scales and windows."""
        self._wires, self._rows, self._readers = wires, [], []
        pairs = [{int(Mode.POSITION): w.profile.position_mode, int(Mode.TORQUE): w.profile.torque_mode} for w in wires]
        self._own = [{mode: own for mode, own in each.items() if mode != own} for each in pairs]
        self._any_own = any(self._own)
        for joint, wire in enumerate(wires):
            limits, unit = wire.limits, wire.unit
            low, high = math.ceil(limits.lower / unit.position), math.floor(limits.upper / unit.position)
            self._aimed[joint] = math.nan
            layout, torque = wire.layouts[RPDO1.name], unit.torque if wire.with_torque else 0.0
            most = int(limits.max_torque / torque) if torque else 0
            window = (limits.lower, limits.upper, low, high)
            row = (wire.by_velocity, RPDO1.cob_base + wire.node, layout.pack, torque, most, unit.position, *window)
            self._rows.append(row)
            self._readers.append((layout.size, layout.unpack, torque or math.nan, unit.position))

    def frames(self, orders: Sequence[Order | None], now: float) -> list[Frame]:
        """RPDO2 where a mode changes, RPDO1 of every joint with an order, heartbeat when due, SYNC."""
        modes: list[Frame] = []
        commands: list[Frame] = []
        rows, modes_now, any_own = self._rows, self.modes, self._any_own
        for joint, order in enumerate(orders):
            if order is None:
                self._sent[joint], self._walking[joint] = None, False
                continue
            power, walk, mode, position, _, torque, _, _, _ = order
            if walk:
                word = self._step(joint, order, modes, now)
            else:
                self._walking[joint] = False
                if power is Power.ON:
                    word = ENABLE
                    if mode and (self.own_mode(joint, mode) if any_own else mode) != modes_now[joint]:
                        self._select(joint, mode, modes, now)
                    if modes_now[joint] == PROFILE_POSITION:
                        word = set_point_control(self._known.statuses[joint])
                else:
                    word = QUICK_STOP if power is Power.STOPPED else DISABLE_VOLTAGE
            by_velocity, can_id, pack, torque_unit, most, position_unit, lower, upper, low, high = rows[joint]
            if by_velocity:
                data = self._velocity_frame(joint, word, order)
            else:
                if not lower <= position <= upper:
                    low, high = -INT32_MAX - 1, INT32_MAX
                target = round(position / position_unit)
                target = low if target < low else high if target > high else target
                if torque_unit:
                    amount = int(torque / torque_unit)
                    data = pack(word, most if amount > most else -most if amount < -most else amount, target)
                else:
                    data = pack(word, target)
            self._words[joint], self._sent[joint] = word, data
            commands.append((can_id, data))
        if modes:
            commands = modes + commands
        if self.beating and now - self._beat > self._beat_every - 0.5 * self._period:
            commands.append(self.heartbeat)
            self._beat = now
        commands.append(SYNC)
        return commands

    def beaten(self, now: float) -> None:
        """The host's heartbeat was sent apart from a cycle."""
        self._beat = now

    def _velocity_frame(self, joint: int, word: int, order: Order) -> bytes:
        """RPDO1 of a joint that is led by velocity; none where it is not enabled."""
        wire, velocity, before = self._wires[joint], 0.0, self._aimed[joint]
        if word == ENABLE:
            before = order.position if math.isnan(before) else before
            velocity = velocity_towards(order.position, before, self._known.positions[joint], wire.limits)
        self._aimed[joint] = order.position if word == ENABLE else math.nan
        counts = int(velocity / wire.unit.velocity)
        return wire.layouts[RPDO1.name].pack(word, max(-INT32_MAX, min(INT32_MAX, counts)))

    def own_modes(self, modes: Sequence[int]) -> Sequence[int]:
        return [self.own_mode(joint, mode) for joint, mode in enumerate(modes)] if self._any_own else modes

    def own_mode(self, joint: int, mode: int) -> int:
        return self._own[joint].get(mode, mode)

    def _select(self, joint: int, mode: int, frames: list[Frame], now: float) -> None:
        mode, wire = self.own_mode(joint, mode), self._wires[joint]
        self.modes[joint], self._known.mode_since[joint] = mode, now
        if RPDO2.name in wire.layouts:
            frames.append((RPDO2.cob_base + wire.node, struct.pack("<b", mode)))

    def _step(self, joint: int, order: Order, frames: list[Frame], now: float) -> int:
        """Control word of the next step towards the power of an order; the first of a walk changes nothing yet, so that
        the next one is an edge; a joint with power keeps it."""
        target, state = TARGETS[order.power], state_of(self._known.statuses[joint])
        if not self._walking[joint]:
            self._walking[joint] = True
            self._select(joint, order.mode, frames, now)
            if state is DriveState.QUICK_STOP:
                return QUICK_STOP
            return next_control(state, target) if state is DriveState.ENABLED else DISABLE_VOLTAGE
        reset_again = state is DriveState.FAULT and self._words[joint] == FAULT_RESET
        return DISABLE_VOLTAGE if reset_again else next_control(state, target)

    def sent(self, joint: int) -> Order | None:
        """A joint's order by its last frame, decoded from its bytes; None where none was sent."""
        data = self._sent[joint]
        return None if data is None else self.decoded(joint, data)

    def decoded(self, joint: int, data: bytes) -> Order | None:
        """A joint's order by RPDO1 with these bytes; None where they are too few or too many."""
        size, unpack, torque_unit, position_unit = self._readers[joint]
        if len(data) != size:
            return None
        values = unpack(data)
        torque = values[1] * torque_unit
        word = values[0] & 0x8F
        power = Power.ON if word == ENABLE else Power.STOPPED if word & 0x86 == QUICK_STOP else Power.OFF
        if self._wires[joint].by_velocity:
            velocity, gain = values[-1] * self._wires[joint].unit.velocity, loop_gain(self._period)
            mode = Mode.POSITION if self.modes[joint] else OFF
            return Order(power, False, mode, self._aim(joint, velocity / gain), velocity, math.nan, 0.0, 0.0)
        return Order(power, False, self.modes[joint], values[-1] * position_unit, 0.0, torque, 0.0, 0.0)

    def _aim(self, joint: int, way: float) -> float:
        """Where a velocity leads that would be so much way by the position loop [rad].

        A joint outside its window that is led back, or rests, counts as being at the window's end.
        """
        seen, limits = self._known.positions[joint], self._wires[joint].limits
        if (seen < limits.lower and way >= 0) or (seen > limits.upper and way <= 0):
            return limits.lower if seen < limits.lower else limits.upper
        return seen + way
