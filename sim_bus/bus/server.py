"""A simulated arm on a bus of python-can's, in a process of its own: real time, or in lock-step with SYNC."""

import errno
import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType

import can

from armlink.bus.open import BusGroup
from armlink.canopen.object_dictionary import NMT_ID
from armlink.errors import BusFault
from sim_bus.bus.control_pipe import ControlPipe
from sim_bus.bus.effect_options import Drift
from sim_bus.bus.fault_injector import ERROR_FLAG, Injector
from sim_bus.bus.fault_kinds import Fault
from sim_bus.bus.wire_timing import Line
from sim_bus.simulated_arm import SYNC_ID, SimulatedArm

LARGEST_LAG = 0.25
"""What the physics lags behind the clock by more than this is dropped, as after a stopped process [s]."""
TICK = 0.002
"""Longest wait for a frame: timers and physics go on meanwhile [s]."""
LOCKSTEP_PATIENCE = 1.0
"""In lock-step, so long without a SYNC and time goes on by itself, so that nodes notice a host that died [s]."""
SEND_PATIENCE = 0.1
"""How long a full transmit queue is waited for [s]; a frame that still does not go is lost, as on a dead bus."""
INTERRUPTED, TERMINATED = 130, 0


class Server:
    """Frames from the bus into the arm, and back."""

    def __init__(
        self,
        arm: SimulatedArm,
        bus: can.BusABC | BusGroup,
        drifts: Sequence[Drift] = (),
        lockstep: bool = False,
        now: Callable[[], float] = time.monotonic,
        faults: Sequence[Fault] = (),
        control: ControlPipe | None = None,
    ) -> None:
        """`now` is the clock that the physics follows unless `lockstep`; `control` gives orders while it runs."""
        self._arm, self._bus, self._lockstep, self._now = arm, bus, lockstep, now
        members: tuple[can.BusABC, ...] = getattr(bus, "members", (bus,))
        self._others, self._leading = members[:-1], members[-1]
        """Of several buses the last gives SYNC: a host fills them in their order."""
        self._of_bus: dict[can.BusABC, set[int]] = {}
        """Nodes on each of several buses."""
        if isinstance(bus, BusGroup):
            for node, place in bus.route.items():
                self._of_bus.setdefault(members[place], set()).add(node)
        self._line: Line = arm
        self._control, self._injector = control, None if control is None and not faults else Injector(arm)
        if self._injector is not None:
            self._line = self._injector
            for fault in faults:
                self._injector.inject(fault)
        self._fd = False
        """Nodes answer as they are spoken to: in classical frames or in CAN FD's."""
        self.on_wrong: Callable[[str], None] = lambda wrong: None
        """Takes what was wrong with an order."""
        self._synced = now()
        self._drifts = sorted(drifts, key=lambda drift: drift.time)
        self._offset = now() - arm.time
        self._ended: int | None = None
        self.lost = 0
        """Frames that the bus did not take."""

    def run(self) -> int:
        """Serve until SIGINT (130) or SIGTERM (0). Raises BusFault where the bus goes away."""
        before = {number: signal.signal(number, self._end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while self._ended is None:
                self.turn()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        return self._ended

    def turn(self) -> None:
        """Wait for at most a tick, then deal with everything that is there."""
        try:
            message = self._leading.recv(TICK)
            while message is not None:
                self._take_from_others()
                self._heard(message, self._leading)
                message = self._leading.recv(0)
            self._take_from_others()
        except can.CanError as error:
            if error.error_code != errno.ENETDOWN:  # else it may come up again, and until then nodes hear nothing
                raise BusFault(f"bus {self._bus.channel_info}: {error}") from None
        except OSError as error:
            raise BusFault(f"bus {self._bus.channel_info}: {error.strerror or error}") from None
        self._let_time_pass()
        if self._control is not None and self._injector is not None:
            for wrong in self._control.poll(self._injector):
                self.on_wrong(wrong)
        self._flush()

    def _take_from_others(self) -> None:
        for bus in self._others:
            while (message := bus.recv(0)) is not None:
                self._heard(message, bus)

    def _heard(self, message: can.Message, bus: can.BusABC) -> None:
        """What a host sends on every bus counts once: SYNC on the leading one, NMT commands on each node's own."""
        if self._others and message.arbitration_id == NMT_ID and len(message.data) == 2:
            command, addressed = message.data
            for node in self._of_bus[bus] if addressed == 0 else self._of_bus[bus] & {addressed}:
                self._line.on_frame(NMT_ID, bytes([command, node]))
        elif bus is self._leading or message.arbitration_id != SYNC_ID:
            self._frame(message)

    def _frame(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
            return
        self._fd = message.is_fd
        if not self._lockstep:
            self._let_time_pass()
        self._line.on_frame(message.arbitration_id, bytes(message.data))
        if self._lockstep and message.arbitration_id == SYNC_ID:
            self._synced = self._now()
            self._line.advance(self._arm.period)
        self._flush()

    def _let_time_pass(self) -> None:
        """Bring the physics up to the clock; in lock-step time rests while SYNCs come to operational nodes."""
        if self._lockstep and self._arm.operational and self._now() - self._synced < LOCKSTEP_PATIENCE:
            self._offset = self._now() - self._arm.time
        lag = self._now() - self._offset - self._arm.time
        if lag > LARGEST_LAG:
            self._offset += lag - LARGEST_LAG
            lag = LARGEST_LAG
        if lag > 0:
            self._line.advance(lag)
        while self._drifts and self._drifts[0].time <= self._arm.time:
            drift = self._drifts.pop(0)
            self._arm.drift(drift.joint, drift.gain, drift.offset)

    def _flush(self) -> None:
        outbox = self._line.outbox
        while outbox:
            can_id, data = outbox.popleft()
            is_error = bool(can_id & ERROR_FLAG)
            message = can.Message(
                arbitration_id=can_id & ~ERROR_FLAG,
                data=data,
                is_extended_id=False,
                is_error_frame=is_error,
                is_fd=self._fd and not is_error,
                bitrate_switch=self._fd and not is_error,
                check=False,
            )
            try:
                self._bus.send(message, timeout=SEND_PATIENCE)
            except can.CanOperationError:
                self.lost += 1

    def _end(self, number: int, _frame: FrameType | None) -> None:
        self._ended = INTERRUPTED if number == signal.SIGINT else TERMINATED
