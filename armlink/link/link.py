"""The link: an arm's joint controllers on a CAN bus; samples in SI units out, limited commands in."""

from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Concatenate, ParamSpec, Self, TypeVar

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.adapters import as_bus
from armlink.bus.arm_hold import ArmHold
from armlink.bus.can_bus import CanBus
from armlink.clock import Clock, MonotonicClock
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import State
from armlink.errors import BusFault, Silence
from armlink.link import controller_setup as device
from armlink.link.cycle import Commander
from armlink.link.cyclic_exchange import Loop
from armlink.link.faults import bus_fault
from armlink.link.gate import start_from
from armlink.link.gate_limits import gate_limits, joint_ranges, target_window
from armlink.link.guard import Crossed
from armlink.link.torque_sensor_record import TorqueSensorRecords
from armlink.link.types import Command, Controller, Identity, Sample, Samples, Setpoints, Stats, Tell

if TYPE_CHECKING:
    import can

PATIENCE = 2.5
"""Readings may be this many periods old while a motion goes on; a reply that comes a period late is within it."""
LISTEN_PERIODS, LISTEN_SECONDS = 2, 0.1
"""Another host is listened for before anything is sent to the nodes: this many periods, and at least this long [s],
since a host on a busy computer may pause for some 0.05 s."""


ANSWER_SECONDS = 5.0
"""After a stall a controller may take so long to answer [s]."""
R = TypeVar("R")
P = ParamSpec("P")


class Link(TorqueSensorRecords):
    """Context manager: `with Link.open(arm) as link: link.start(); link.enable(); link.cycle(command)`.

    Leaving it, however, leaves the joints in quick stop, where they hold, unless `disable` was called.
    """

    def __init__(self, arm: ArmFile, bus: "CanBus | can.BusABC", clock: Clock | None = None) -> None:
        """Take `bus` (python-can's too, closed on leaving) and a clock: by default the bus's own or the machine's."""
        self.arm, self.bus = arm, as_bus(bus)
        self.section = section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.nodes = tuple(joint.settings.node for joint in section.joints)
        self.n, self.rate, self.period = len(self.names), section.rate, 1.0 / section.rate
        self._lock_step = self.bus.clock is not None
        self.clock: Clock = clock or self.bus.clock or MonotonicClock()
        self.windows = [target_window(*limits) for limits in joint_ranges(arm)]
        self.protection = device.protection_of(section)
        port, host = self.bus.open_port(), self.protection.host
        self._loop = Loop(port, self.clock, self.nodes, host, self.period, self._lock_step)
        self._loop.beat_every = section.deadline / 2
        self.commander = Commander(self._loop, self.clock, self.names, self.period, section.deadline, self._lock_step)
        self._cycling = self._enabled = False
        self._since = 0.0
        self.position_step = np.full(self.n, np.inf)
        """Smallest change that each position reading can show (n,) [rad]; inf before start()."""
        self._last: Command | None = None
        self._hold: ArmHold | None = None

    @classmethod
    def open(cls, arm: ArmFile, bus: str | None = None) -> "Link":
        """Open the bus `INTERFACE:CHANNEL[@BITRATE]`, by default the arm file's; raises BadInput or BusFault."""
        from armlink.bus.open import open_link_bus

        return cls(arm, open_link_bus(bus, arm.require_link()))

    def __enter__(self) -> Self:
        """The link itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Quick stop where joints are enabled, and close the bus."""
        try:
            self.stop()
        finally:
            self.bus.shutdown()
            if self._hold is not None:
                self._hold.release()

    @property
    def enabled(self) -> bool:
        """Whether the joints are enabled and cycles must go on."""
        return self._enabled

    @property
    def last(self) -> Command | None:
        """The newest command."""
        return self._last

    @property
    def latest_position(self) -> Array:
        """Newest position readings, whenever they came (n,) [rad]."""
        return np.array(self._loop.latest_position)

    @property
    def stats(self) -> Stats:
        """Counters since the first cycle, rate and load brought up to date."""
        if self._cycling:
            self._loop.measure(self.clock.now() - self._since, self.section.bus.bitrate)
        return self._loop.stats

    @property
    def torque_sent(self) -> Array:
        """Target torque of the last frames [N·m], (n,)."""
        pairs = zip(self.commander.passed, self.commander.limits, strict=True)
        return np.array([passed.torque_wire * limits.torque_unit for passed, limits in pairs])

    @property
    def position_sent(self) -> Array:
        """Target position of the last frames [rad], (n,)."""
        pairs = zip(self.commander.passed, self.commander.limits, strict=True)
        return np.array([passed.position_wire * limits.position_unit for passed, limits in pairs])

    def scan(self) -> list[Identity]:
        """Identity and state of each joint's controller; one that does not answer is there with `present` false."""
        return [
            device.identify(services) if services.present() else Identity(services.joint, services.node, present=False)
            for services in self.services
        ]

    def start(self) -> None:
        """Check the nodes, map PDOs, set the device's own limits, start them (NMT).

        Raises Refused for another controller than the arm file states, BusFault, BadInput.
        """
        self._hold = self._hold or ArmHold(self.bus, self.nodes)
        silent = [each for each in self.services if not each.present()]
        missing = [f"{each.joint} (node {each.node})" for each in silent if not each.present()]  # a busy one gets two
        if missing:
            channel = self.bus.channel_info
            raise BusFault(f"no answer from {', '.join(missing)} on {channel}: is it powered, and its node id right?")
        self.require_alone()
        loop = self._loop
        for services, joint in zip(self.services, self.section.joints, strict=True):
            device.check_identity(services, joint)
        self.send_nmt(objects.NMT_PRE_OPERATIONAL)
        self._configure()
        loop.drain()
        self._alone()
        loop.node_states.clear()
        loop.emergencies.clear()
        loop.reset_counters()
        self._since = self.clock.now()
        for node in self.nodes:
            self.send_nmt(objects.NMT_START, node)
        self._cycling = True

    def require_alone(self) -> None:
        """Listen before anything is set; raises BusFault where another host is on the bus."""
        self._loop.drain()
        self._loop.watch.clear()
        if not self._lock_step:
            self._loop.listen(max(LISTEN_PERIODS * self.period, LISTEN_SECONDS))
        self._alone()

    def _alone(self) -> None:
        """Raise BusFault where another host was heard or a controller has restarted."""
        watch = self._loop.watch
        restarts = [self.names[joint] for joint in sorted(watch.restarted)]
        if restarts:
            raise BusFault(f"{restarts[0]}: its controller has just restarted (boot-up message): start again")
        fault = bus_fault(self.names, watch, 0)
        if fault:
            raise BusFault(fault)

    def _configure(self) -> None:
        """Set every controller up and read it back; what the first cycle starts from."""
        limits, passed, units, supported = [], [], [], []
        for joint, services in enumerate(self.services):
            row, window = self.section.joints[joint], self.windows[joint]
            unit = device.read_units(services, row)
            limit = gate_limits(row, window, unit, self.period, self.section.deadline)
            supported.append(device.check_modes(services))
            device.configure(services, row, unit, limit, self.period, self.protection, supported[-1])
            torque = services.read(objects.MOTOR_TORQUE) * unit.torque
            passed.append(start_from(limit, torque, services.read(objects.POSITION) * unit.position))
            self._loop.displays[joint] = services.read(objects.MODE_DISPLAY)
            self._loop.statuses[joint] = services.read(objects.STATUS_WORD)
            limits.append(limit)
            units.append(unit)
        self._loop.set_units(tuple(units))
        self.position_step = np.array([max(unit.position, unit.encoder_step) for unit in units])
        self.commander.begin(limits, passed, supported)

    def send_nmt(self, command: int, node: int = 0) -> None:
        """An NMT command (CiA 301) to one node, or to all."""
        self._loop.send(objects.NMT_ID, bytes([command, node]))

    def enable(self) -> Sample:
        """Walk every joint to operation enabled under position control where it stands, and return the last sample.

        Faults are reset on the way. Raises BusFault naming the joint and the state it stays in.
        """
        self._require_start()
        self._loop.emergencies.clear()
        self.commander.settle()
        sample = self.commander.walk(State.ENABLED)
        self._loop.emergencies.clear()
        self._loop.node_states.clear()
        self._enabled = True
        self._last = Command.hold(np.array(self._loop.latest_position))
        return sample

    def recover(self) -> Sample:
        """After a Stall: start the nodes that left operation, and enable every joint where it stands."""
        self._require_start()
        self._await_answers()
        self._loop.beat()  # their watches have run on
        for node in self.nodes:
            self.send_nmt(objects.NMT_START, node)
        return self.enable()

    def _await_answers(self) -> None:
        """Wait until every controller has answered what it was sent before; raises Silence.

        One that stood still works off what has piled up, and its replies show it as it was before it was stopped.
        """
        end = self.clock.now() + ANSWER_SECONDS
        for services in self.services:
            while not services.present():
                if self.clock.now() > end:
                    raise Silence(f"{services.joint}: no answer for {ANSWER_SECONDS:g} s")

    def disable(self) -> None:
        """Take the power from every joint: a joint without a brake falls. Raises BusFault."""
        self._require_start()
        self._enabled = False
        self.commander.walk(State.SWITCH_ON_DISABLED)

    def _require_start(self) -> None:
        if not self._cycling:
            raise BusFault("the nodes are not started: start() comes first")

    def cycle(self, command: Command) -> Sample:
        """One cycle: wait for its time, gate, RPDOs, SYNC, TPDOs.

        Raises Refused where the gate refuses the command, BusFault for a fault of bus or joint; the joints have been
        sent to quick stop before either is raised. Raises Crossed if a joint crossed a bound of the command's guard:
        the joints then keep the command until the next.
        """
        if not self._enabled:
            raise BusFault("the joints are not enabled: start() and enable() come before cycle()")
        self._last = command
        try:
            sample = self.commander.command(command)
        except BaseException:
            self.stop()
            raise
        if command.guard is not None:
            try:
                command.guard.check(self.names, self.latest_position, command.position)
            except Crossed as crossed:
                crossed.sample = sample
                raise
        return sample

    def play(self, setpoints: Setpoints) -> Samples:
        """One row a cycle, and the sample of each; raises as cycle. To stop early, close the iterator.

        While readings are late the row is repeated, so that the motion waits for the arm.
        """
        patience = PATIENCE * self.period
        for row in range(len(setpoints)):
            command = setpoints.command(row)
            sample = self.cycle(command)
            yield sample
            while not self._lock_step and sample.age.max() > patience:
                sample = self.cycle(command)

    def run(self, controller: Controller) -> Samples:
        """A controller in the loop, cycle by cycle, until the iterator is closed; raises as cycle."""
        sample = self.cycle(self._last or Command.hold(self.position_sent))
        while True:
            sample = self.cycle(controller.command(sample))
            yield sample

    def catch_up(self) -> None:
        """Forget samples of the past: in process there are none."""

    def stop(self) -> None:
        """Quick stop of every joint, as far as the bus still carries it; the joints stay in it, holding."""
        if not self._enabled:
            return
        self._enabled = False
        self.commander.quick_stop()

    def inside(
        self, function: "Callable[Concatenate[Link, Tell, P], R]", tell: Tell, *args: P.args, **kw: P.kwargs
    ) -> R:
        """Call `function(link, tell, ...)` in the process that makes the cycles, which is this one."""
        return function(self, tell, *args, **kw)

    def read_temperatures(self) -> Array:
        """Temperatures of the drives (n,) [°C]; NaN for a drive that does not report one. Raises BusFault."""
        return np.array([device.read_temperature(services) for services in self.services])

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """Run the loop until `done` or the time is over; enabled joints get their last command in every cycle."""
        end = self.clock.now() + timeout
        while not done():
            remaining = end - self.clock.now()
            if remaining <= 0:
                return False
            if self._loop.receive(0.0):
                continue
            if self._enabled and self._last is not None:
                self.cycle(replace(self._last, t=None))
            elif not self._loop.receive(remaining):
                return False
        return True
