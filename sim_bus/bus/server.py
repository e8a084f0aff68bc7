"""Runs a simulated arm on a bus, in real time or in lock-step with SYNC."""

import math
import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType

from armlink.bus.bus_group import BusGroup, GroupPort
from armlink.bus.can_bus import CanBus
from armlink.bus.port import BUS_SHIFT, InterfaceDown
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.errors import BusFault
from armlink.link.bus_watchdog import MOST_FRAMES
from sim_bus.bus.control_pipe import ControlPipe
from sim_bus.bus.effect_options import SensorDrift
from sim_bus.bus.fault_injector import Injector
from sim_bus.bus.fault_kinds import Fault
from sim_bus.bus.wire_timing import TimedArm
from sim_bus.simulated_arm import SimulatedArm

LARGEST_LAG = 0.25
"""Maximum lag of the physics behind the clock; the rest is dropped, as after a stopped process [s]."""
TICK = 0.01
"""Maximum lag of the physics between frames that need it, unless a timer is due earlier [s]."""
LATE = 2 * TICK
"""A lag beyond this means that this process was late, not that the host was silent [s]."""
LOCKSTEP_PATIENCE = 1.0
"""In lock-step, time runs again this long after the last SYNC, so that nodes notice a dead host [s]."""
INTERRUPTED, TERMINATED = 130, 0


class ArmServer:
    def __init__(
        self,
        arm: SimulatedArm,
        bus: CanBus,
        drifts: Sequence[SensorDrift] = (),
        lockstep: bool = False,
        now: Callable[[], float] = time.monotonic,
        faults: Sequence[Fault] = (),
        control: ControlPipe | None = None,
    ) -> None:
        """`now` is the clock of the physics unless `lockstep`; `control` takes commands while it runs."""
        self._arm, self._lockstep, self._now = arm, lockstep, now
        self._port = bus.open_port(as_node=True)
        ports = self._port.members if isinstance(self._port, GroupPort) else (self._port,)
        self._numbered = [(place << BUS_SHIFT, port) for place, port in enumerate(ports)]
        """Ports of the buses with the tags of their frames; the leading one last."""
        if isinstance(bus, BusGroup):
            arm.stand_on(list(bus.tags))
            joints = arm.arm.require_link().joints
            synced = [bus.tags[joint.bus] for joint in joints if joint.settings.family == "canopen"]
            self._numbered.sort(key=lambda each: each[0] == max(synced, default=bus.tags[joints[-1].bus]))
        *self._others, (self._leading_tag, self._leading) = self._numbered
        """The last of several buses with CANopen nodes provides SYNC: a host sends to them in order."""
        self._line: TimedArm = arm
        self._control, self._injector = control, None if control is None and not faults else Injector(arm)
        if self._injector is not None:
            self._line = self._injector
            for fault in faults:
                self._injector.inject(fault)
        self.on_command: Callable[[str], None] = lambda answer: None
        """Called with the answer to each command of the control pipe."""
        self.on_late: Callable[[float, float], None] = lambda lag, at: None
        """Called with how late [s] this process was, and when by the arm's time [s]; once a second at most."""
        self._late_said = -math.inf
        self._synced = now()
        self._drifts = sorted(drifts, key=lambda drift: drift.time)
        self._offset = now() - arm.time
        self._ended: int | None = None
        self.lost = 0
        """Upper bound of the frames that the bus did not accept."""

    def run(self) -> int:
        """Serve until SIGINT (130) or SIGTERM (0). Raises BusFault if the bus fails."""
        before = {number: signal.signal(number, self._end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while self._ended is None:
                self.turn()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        return self._ended

    def turn(self) -> None:
        """Wait up to a tick, then process all frames."""
        receive = self._leading.receive
        try:
            frame = receive(TICK if self._lockstep else max(self._until_tick(), 0.0))
            for _ in range(MOST_FRAMES):  # a flood must not block physics and timers
                if frame is None:
                    break
                self._take_from_others()
                self._frame(frame[0] | self._leading_tag, frame[1])
                frame = receive(0.0)
            self._take_from_others()
        except InterfaceDown:  # may come up again; until then nodes receive nothing
            pass
        if self._lockstep or self._until_tick() <= 0.0:
            self._let_time_pass()
        if self._control is not None and self._injector is not None:
            for answer in self._control.poll(self._injector):
                self.on_command(answer)
        self._flush()

    def _until_tick(self) -> float:
        """Time until physics and timers must advance without a frame [s]."""
        due = min(self._arm.due, self._arm.time + TICK)
        return due + self._offset - self._now()

    def _take_from_others(self) -> None:
        """Frames of the other buses; SYNC, which comes on all of them, counts on the leading one alone."""
        for tag, port in self._others:
            while (frame := port.receive(0.0)) is not None:
                if frame[0] != SYNC_ID:
                    self._frame(frame[0] | tag, frame[1])

    def _frame(self, can_id: int, data: bytes) -> None:
        if not (self._lockstep or self._arm.waits_for_sync(can_id)):
            self._let_time_pass()
        self._line.on_frame(can_id, data)
        if self._lockstep and can_id == SYNC_ID | self._leading_tag:
            self._synced = self._now()
            self._line.advance(self._arm.period)
        self._flush()

    def _let_time_pass(self) -> None:
        """Advance the physics to the clock; in lock-step time rests while operational nodes get SYNC."""
        if self._lockstep and self._arm.operational and self._now() - self._synced < LOCKSTEP_PATIENCE:
            self._offset = self._now() - self._arm.time
        lag = self._now() - self._offset - self._arm.time
        if lag > LATE and self._now() - self._late_said > 1.0:
            self._late_said = self._now()
            self.on_late(lag, self._arm.time)
        if lag > LARGEST_LAG:
            self._offset += lag - LARGEST_LAG
            lag = LARGEST_LAG
        if lag > LATE:
            self._arm.postpone(lag - LATE)
        if lag > 0:
            self._line.advance(lag)
        while self._drifts and self._drifts[0].time <= self._arm.time:
            drift = self._drifts.pop(0)
            self._arm.drift(drift.joint, drift.gain, drift.offset)

    def _flush(self) -> None:
        outbox = self._line.outbox
        if outbox:
            frames = list(outbox)
            outbox.clear()
            try:
                for can_id, data in frames:
                    self._port.send(can_id, data)
            except BusFault:  # lost, as on a dead bus
                self.lost += len(frames)

    def _end(self, number: int, _frame: FrameType | None) -> None:
        self._ended = INTERRUPTED if number == signal.SIGINT else TERMINATED
