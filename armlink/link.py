"""The link: an arm's joint controllers on a CAN bus; samples in SI units out, limited commands in."""

import contextlib
from collections.abc import Callable
from functools import cached_property
from types import TracebackType
from typing import Any, Self

import numpy as np

from armlink import calibration, device, emcy, objects
from armlink.armfile import ArmFile
from armlink.cia402 import Control, Mode, State, next_control, state_of
from armlink.clock import Clock, MonotonicClock
from armlink.device import Protection
from armlink.errors import ArmlinkError, BusFault, Refused
from armlink.faults import find_fault, refusal
from armlink.gate import Passed, pass_gate, start_from
from armlink.limits import gate_limits, joint_ranges, milliseconds, target_window
from armlink.loop import Loop
from armlink.port import open_port
from armlink.sample import Array, Calibration, Command, Identity, Sample, Stats
from armlink.services import NodeServices, PumpedNetwork, load_dictionary

ENABLE_SECONDS = 3.0
"""The joints must reach a commanded CiA 402 state within this time."""
STOP_CYCLES = 25
"""Cycles in which a quick stop is repeated until every joint reports it."""


class Link:
    """Context manager: `with Link.open(arm) as link: link.start(); link.enable(); link.cycle(command)`.

    Leaving it, however, leaves the joints in quick stop, where they hold, unless `disable` was called.
    """

    def __init__(self, arm: ArmFile, bus: Any, clock: Clock | None = None) -> None:
        """Take `bus` (python-can's, closed on leaving) and a clock: by default the bus's own or the machine's."""
        self.arm, self.bus = arm, bus
        self.section = section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.nodes = tuple(joint.node for joint in section.joints)
        self.n, self.rate, self.period = len(self.names), section.rate, 1.0 / section.rate
        own_clock: Clock | None = getattr(bus, "clock", None)
        self._lock_step = own_clock is not None
        self.clock: Clock = clock or own_clock or MonotonicClock()
        self._windows = np.array([target_window(*limits) for limits in joint_ranges(arm)])
        host = next(node for node in range(127, 0, -1) if node not in self.nodes)
        self._protection = Protection(
            host,
            milliseconds(section.deadline),
            milliseconds(2 * section.deadline),
            milliseconds(section.deadline / 2),
        )
        self._port = open_port(bus)
        self._loop = Loop(self._port, self.clock, self.nodes, host, self.period, self._lock_step)
        self._loop.heartbeat_cycles = max(1, int(section.deadline / 2 * self.rate))
        self._modes = [int(Mode.OFF)] * self.n
        self._cycling = self._enabled = False
        self._due = self._since = 0.0
        self._last: Command | None = None
        self._passed: Passed

    @classmethod
    def open(cls, arm: ArmFile, bus: str | None = None) -> "Link":
        """Open the bus `INTERFACE:CHANNEL[@BITRATE]`, by default the arm file's; raises BadInput or BusFault."""
        from armlink.bus import open_bus

        return cls(arm, open_bus(bus, arm.require_link().bus))

    def __enter__(self) -> Self:
        """The link itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Quick stop where joints are enabled, and close the bus."""
        try:
            self.stop()
        finally:
            self.bus.shutdown()

    @property
    def stats(self) -> Stats:
        """Counters since the first cycle, rate and load brought up to date."""
        if self._cycling:
            self._loop.measure(self.clock.now() - self._since, self.section.bus.bitrate)
        return self._loop.stats

    @property
    def torque_sent(self) -> Array:
        """Target torque of the last frames [N·m], (n,)."""
        sent: Array = self._passed.torque_wire * self._limits.torque_unit
        return sent

    @property
    def position_sent(self) -> Array:
        """Target position of the last frames [rad], (n,)."""
        sent: Array = self._passed.position_wire * self._limits.position_unit
        return sent

    def scan(self) -> list[Identity]:
        """Identity and state of each joint's controller; one that does not answer is there with `present` false."""
        return [
            device.identify(services) if services.present() else Identity(services.joint, services.node, present=False)
            for services in self._services
        ]

    def start(self) -> None:
        """Check the nodes, map PDOs, set the device's own limits, start them (NMT); raises BusFault, BadInput."""
        missing = [f"{each.joint} (node {each.node})" for each in self._services if not each.present()]
        if missing:
            channel = self.bus.channel_info
            raise BusFault(f"no answer from {', '.join(missing)} on {channel}: is it powered, and its node id right?")
        self._loop.send(objects.NMT_ID, bytes([objects.NMT_PRE_OPERATIONAL, 0]))
        units = []
        for services, joint, window in zip(self._services, self.section.joints, self._windows, strict=True):
            unit = device.read_units(services, joint)
            device.check_modes(services)
            device.configure_pdos(services, self._protection.deadline_ms)
            device.protect(services, joint, unit, tuple(window), self.period, self._protection)
            units.append(unit)
        self._limits = gate_limits(self.section, self._windows, tuple(units))
        self._loop.set_units(tuple(units))
        position = np.array([float(services.read(objects.POSITION)) for services in self._services])
        torque = np.array([float(services.read(objects.MOTOR_TORQUE)) for services in self._services])
        limits = self._limits
        self._passed = start_from(limits, torque * limits.torque_unit, position * limits.position_unit)
        for node in self.nodes:
            self._loop.send(objects.NMT_ID, bytes([objects.NMT_START, node]))
        self._loop.node_states.clear()
        self._loop.reset_counters()
        self._since = self._due = self.clock.now()
        self._cycling = True

    def enable(self) -> Sample:
        """Walk every joint to operation enabled under position control where it stands, and return the last sample.

        Faults are reset on the way. Raises BusFault naming the joint and the state it stays in.
        """
        self._loop.emergencies.clear()
        sample = self._walk(State.ENABLED)
        self._loop.emergencies.clear()
        self._enabled = True
        self._last = Command.hold(self._loop.latest_position)
        return sample

    def disable(self) -> None:
        """Take the power from every joint: a joint without a brake falls. Raises BusFault."""
        self._enabled = False
        self._walk(State.SWITCH_ON_DISABLED)

    def cycle(self, command: Command) -> Sample:
        """One cycle: wait for its time, gate, RPDOs, SYNC, TPDOs.

        Raises Refused where the gate refuses the command, BusFault for a fault of bus or joint; the joints have been
        sent to quick stop before either is raised.
        """
        self._last = command
        try:
            return self._cycle(command)
        except ArmlinkError:
            self.stop()
            raise

    def stop(self) -> None:
        """Quick stop of every joint, as far as the bus still carries it; the joints stay in it, holding."""
        if not self._enabled:
            return
        self._enabled = False
        control = [int(Control.QUICK_STOP)] * self.n
        with contextlib.suppress(BusFault):
            for _ in range(STOP_CYCLES):
                sample = self._exchange(control)
                if not any(state_of(int(status)) is State.ENABLED for status in sample.status):
                    break

    def read_calibration(self, joint: int) -> Calibration:
        """The torque sensor record (2100h) that joint 0 … n−1 works with; raises BusFault."""
        return calibration.read_record(self._services[joint])

    def write_calibration(
        self, joint: int, gain: float, offset: float, record_id: int, date: int = 0, store: bool = False
    ) -> Calibration:
        """Make gain and offset [N·m] active in joint 0 … n−1 (`store`: to flash too); raises BadInput, BusFault.

        While the joints are enabled the cycle goes on with the last command.
        """
        return calibration.write_record(self._services[joint], gain, offset, record_id, date, store)

    def _cycle(self, command: Command) -> Sample:
        if not self._enabled:
            raise BusFault("the joints are not enabled: start() and enable() come before cycle()")
        self._await_turn()
        now = self.clock.now()
        loop = self._loop
        passed = pass_gate(
            self._limits,
            self.period,
            command.mode,
            command.torque,
            command.position,
            self._passed,
            loop.latest_motor_torque,
            loop.latest_position,
            loop.age(now),
            0.0 if command.t is None else now - command.t,
        )
        self._passed = passed
        control = [int(Control.ENABLE)] * self.n
        for joint in range(self.n):
            mode = int(command.mode[joint])
            if passed.refused[joint]:
                control[joint] = int(Control.QUICK_STOP)
            elif mode == Mode.OFF:
                control[joint] = int(Control.DISABLE_VOLTAGE)
            elif mode != self._modes[joint]:
                loop.send_mode(joint, mode)
                self._modes[joint] = mode
        sample = loop.exchange(control, passed.torque_wire.tolist(), passed.position_wire.tolist())
        fault = find_fault(
            self.names, sample, command.mode.tolist(), loop.emergencies, loop.node_states, self.section.deadline
        )
        if fault:
            raise BusFault(fault)
        if passed.refused.any():
            age = 0.0 if command.t is None else now - command.t
            raise Refused(f"gate: {refusal(self.names, passed, command, self._limits, age)}")
        return sample

    def _await_turn(self) -> None:
        if not self._lock_step:
            self.clock.sleep_until(self._due)
            now = self.clock.now()
            self._loop.stats.late += now - self._due > 0.1 * self.period
            self._due = max(self._due, now - self.period) + self.period
        self._loop.drain()

    def _exchange(self, control: list[int]) -> Sample:
        """A cycle that commands no motion: control words only, targets as they are."""
        self._await_turn()
        loop = self._loop
        hold = start_from(self._limits, loop.latest_motor_torque, self._standing())
        self._passed = hold
        return loop.exchange(control, hold.torque_wire.tolist(), hold.position_wire.tolist())

    def _standing(self) -> Array:
        """Newest measured position of each joint; what was sent last for one that has sent none."""
        measured = self._loop.latest_position
        return np.where(np.isfinite(measured), measured, self._passed.position)

    def _walk(self, target: State) -> Sample:
        """Cycle until every joint is in `target`, each by the next control word of the table."""
        if not self._cycling:
            raise BusFault("the nodes are not started: start() comes first")
        for joint in range(self.n):
            self._loop.send_mode(joint, Mode.POSITION)
            self._modes[joint] = int(Mode.POSITION)
        states = [State.UNKNOWN] * self.n
        control = [int(Control.DISABLE_VOLTAGE)] * self.n
        for _ in range(int(ENABLE_SECONDS * self.rate)):
            sample = self._exchange(control)
            states = [state_of(int(status)) for status in sample.status]
            if all(state is target for state in states) and np.isfinite(sample.position).all():
                return sample
            for joint, state in enumerate(states):
                reset_again = state is State.FAULT and control[joint] == Control.FAULT_RESET
                control[joint] = int(Control.DISABLE_VOLTAGE) if reset_again else next_control(state, target)
        raise BusFault(self._stuck(states, target))

    def _stuck(self, states: list[State], target: State) -> str:
        for joint, code, _ in self._loop.emergencies:
            if code and states[joint] is not target:
                return f"{self.names[joint]}: {states[joint].value} after emergency {code:04X}h, {emcy.name_of(code)}"
        joint = next((joint for joint, state in enumerate(states) if state is not target), 0)
        if states[joint] is target:
            return f"no complete set of readings within {ENABLE_SECONDS} s of cycles: frames are lost"
        return f"{self.names[joint]}: stays in {states[joint].value}, expected {target.value} within {ENABLE_SECONDS} s"

    @cached_property
    def _services(self) -> tuple[NodeServices, ...]:
        network = PumpedNetwork(self._loop.send)
        self._loop.on_other = lambda can_id, data: network.notify(can_id, bytearray(data), 0.0)
        dictionary = load_dictionary()
        return tuple(
            NodeServices(network, name, node, dictionary, self._pump)
            for name, node in zip(self.names, self.nodes, strict=True)
        )

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """Run the loop until `done` or the time is over; enabled joints get their last command in every cycle."""
        end = self.clock.now() + timeout
        while not done():
            if self._loop.receive(0.0):
                continue
            remaining = end - self.clock.now()
            if remaining <= 0:
                return False
            if self._enabled and self._last is not None:
                self.cycle(self._last)
            elif not self._loop.receive(remaining):
                return False
        return True
