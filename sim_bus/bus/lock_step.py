"""In-process CAN bus with the simulated arm: a cycle advances the physics by one period; nothing sleeps.

A cycle is a SYNC, or for an arm without CANopen drives what its host says it is (`pass_time`).
"""

from threading import RLock
from typing import Any

import can

from armlink.arm_file import load_arm
from armlink.bus.in_process import InProcessBus
from armlink.bus.message_port import as_frame, as_message
from armlink.bus.port import CLASSICAL, ERROR, Frame
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.errors import BusFault
from sim_bus.bus.fault_injector import BUS_OFF, HOST_REFUSES, Injector
from sim_bus.bus.fault_kinds import Fault, parse_fault
from sim_bus.bus.wire_timing import TimedArm, TimedWire
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

CLASSICAL_BYTES = 8
"""A longer frame can only be CAN FD."""


class SimulatedClock:
    """The simulated arm's time as a clock; sleeping advances the arm."""

    def __init__(self, bus: "LockStepBus", lock: RLock) -> None:
        """Clock of the arm on `bus`, protected by `lock`."""
        self._arm, self._bus, self._lock = bus.arm, bus, lock

    def now(self) -> float:
        return self._arm.time

    def sleep_until(self, instant: float) -> None:
        with self._lock:
            if instant > self._arm.time + 1e-9:
                self._bus.line.advance(instant - self._arm.time)


class LockStepBus(can.BusABC, InProcessBus):  # type: ignore[misc]
    """Host's end of a CAN bus with the simulated arm; as an interface of python-can: `armlink_sim:ARM`.

    `recv` pops what the nodes sent; where there is nothing and `timeout` is positive, simulated time passes instead,
    up to the first frame, and None is returned if none comes. A timeout of None is a second.

    With `timing` frames take their time on a wire of `bitrate` [bit/s] (`sim_bus.bus.wire_timing`), else none.
    """

    def __init__(
        self, channel: Any = None, *, arm: SimulatedArm | None = None, seed: int = 0, load: float = 0.0, **options: Any
    ) -> None:
        """Bus of `arm`, or of a new arm from arm file or bundled arm `channel`, with `load` [kg] at its tip.

        Raises BadInput.
        """
        if arm is None:
            described = load_arm(str(channel))
            arm = SimulatedArm(described, Truth.of(described), seed)
            if load:
                arm.attach_mass(load)
        self.arm = arm
        self.line: TimedArm = arm
        """The arm, or the fault injector or wire in front of it."""
        self.wire: TimedWire | None = None
        self.errors = 0
        self._injector: Injector | None = None
        self._lock = RLock()
        self.clock: SimulatedClock = SimulatedClock(self, self._lock)
        self.channel_info = f"simulated arm {arm.arm.name}"
        bitrate = options.pop("bitrate", arm.arm.require_link().bus.bitrate)
        if options.pop("timing", False):
            self.line = self.wire = TimedWire(arm, bitrate)
        self._outbox = self.line.outbox
        super().__init__(channel=channel, **options)

    @property
    def dropped(self) -> int:
        return self._injector.dropped if self._injector else 0

    def inject(self, fault: Fault | str) -> None:
        """Inject a fault, also as text of `armlink sim --fault`. Raises BadInput."""
        with self._lock:
            self._faults().inject(parse_fault(fault, self.arm.names) if isinstance(fault, str) else fault)

    def clear_faults(self) -> None:
        with self._lock:
            self._faults().clear()

    def _faults(self) -> Injector:
        if self._injector is None:
            self._injector = Injector(self.arm)
            if self.wire is None:
                self.line = self._injector
            else:
                self.wire.line = self._injector
        return self._injector

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Deliver a frame to all nodes; a SYNC also advances the arm by one period."""
        try:
            self.put(*as_frame(msg))
        except BusFault as error:
            raise can.CanOperationError(str(error)) from None

    def put(self, can_id: int, data: bytes) -> None:
        """As send, without a message object. Raises BusFault if the interface rejects the frame."""
        line = self.line
        with self._lock:
            if self._injector and (why := self._injector.refusal):
                raise BusFault(f"bus {self.channel_info}: {why}")
            line.on_frame(can_id, data)
            if can_id == SYNC_ID:
                line.advance(self.arm.period)

    def take(self, timeout: float = 0.0) -> Frame | None:
        """As recv, without a message object; counts error frames. Raises BusFault for bus-off."""
        while True:
            frame = self._next(timeout)
            if frame is None or not frame[0] & ERROR:
                return frame
            self.errors += 1
            if frame[0] & BUS_OFF:
                raise BusFault(f"bus {self.channel_info}: {HOST_REFUSES['bus.off']}")

    def _next(self, timeout: float) -> tuple[int, bytes] | None:
        if not self._outbox and timeout > 0:
            self._wait(timeout)
        if not self._outbox:
            return None
        can_id, data = self._outbox.popleft()
        return can_id & ~CLASSICAL, data

    def _wait(self, timeout: float) -> None:
        """Advance time until a frame arrives; another thread may send meanwhile (python-can's Notifier)."""
        deadline = self.arm.time + timeout
        while not self._outbox and self.arm.time < deadline - 1e-9:
            with self._lock:
                self.line.advance(min(self.arm.period, deadline - self.arm.time))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        frame = self._next(1.0 if timeout is None else timeout)
        if frame is None:
            return None
        message = as_message(*frame, fd=len(frame[1]) > CLASSICAL_BYTES)
        message.timestamp = self.arm.time
        return message

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True
