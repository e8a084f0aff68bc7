"""The link: an arm's joint controllers on a CAN bus; samples in SI units out, limited commands in."""

import contextlib
import math
from collections.abc import Callable
from functools import cached_property
from types import TracebackType
from typing import Any, Self

import numpy as np

from armlink import calibration, device, objects
from armlink.armfile import ArmFile
from armlink.cia402 import Control, Mode, State, next_control, state_of
from armlink.clock import Clock, MonotonicClock
from armlink.errors import ArmlinkError, BusFault, Refused
from armlink.faults import find_fault, refusal, stuck
from armlink.gate import JointLimits, Passed, is_fresh, pass_gate, start_from
from armlink.limits import gate_limits, joint_ranges, target_window
from armlink.loop import Loop
from armlink.port import open_port
from armlink.sample import Array, Calibration, Command, Identity, Sample, Stats
from armlink.services import NodeServices, PumpedNetwork, load_dictionary

ENABLE_SECONDS = 3.0
"""The joints must reach a commanded CiA 402 state within this time."""
OFF = int(Mode.OFF)
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
        self._windows = [target_window(*limits) for limits in joint_ranges(arm)]
        self._protection = device.protection_of(section)
        self._loop = Loop(open_port(bus), self.clock, self.nodes, self._protection.host, self.period, self._lock_step)
        self._loop.heartbeat_cycles = max(1, int(section.deadline / 2 * self.rate))
        self._enabled_control = [int(Control.ENABLE)] * self.n
        self._modes = [OFF] * self.n
        self._cycling = self._enabled = False
        self._due = self._since = 0.0
        self._last: Command | None = None
        self._limits: list[JointLimits] = []
        self._passed: list[Passed] = []

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
        pairs = zip(self._passed, self._limits, strict=True)
        return np.array([passed.torque_wire * limits.torque_unit for passed, limits in pairs])

    @property
    def position_sent(self) -> Array:
        """Target position of the last frames [rad], (n,)."""
        pairs = zip(self._passed, self._limits, strict=True)
        return np.array([passed.position_wire * limits.position_unit for passed, limits in pairs])

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
        self._limits, self._passed, units = [], [], []
        for services, joint, window in zip(self._services, self.section.joints, self._windows, strict=True):
            unit = device.read_units(services, joint)
            limits = gate_limits(joint, window, unit, self.period)
            device.configure(services, joint, unit, limits, self.period, self._protection)
            torque = services.read(objects.MOTOR_TORQUE) * unit.torque
            self._passed.append(start_from(limits, torque, services.read(objects.POSITION) * unit.position))
            self._limits.append(limits)
            units.append(unit)
        self._loop.set_units(tuple(units))
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
        self._last = Command.hold(np.array(self._loop.latest_position))
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
        loop, max_age = self._loop, self.section.deadline
        now = self.clock.now()
        command_age = 0.0 if command.t is None else now - command.t
        timely = is_fresh(command_age, max_age)
        modes, torques, positions = command.mode.tolist(), command.torque.tolist(), command.position.tolist()
        if not len(modes) == len(torques) == len(positions) == self.n:
            raise Refused(
                f"gate: a command for {len(modes)} joints, expected {self.n} of each: {', '.join(self.names)}"
            )
        control = self._enabled_control.copy()
        passed = self._passed
        for joint in range(self.n):
            mode = modes[joint]
            passed[joint] = pass_gate(
                self._limits[joint],
                mode,
                torques[joint],
                positions[joint],
                passed[joint],
                loop.latest_motor_torque[joint],
                loop.latest_position[joint],
                timely and is_fresh(now - loop.seen[joint], max_age),
            )
            if passed[joint].refused:
                control[joint] = int(Control.QUICK_STOP)
            elif mode == OFF:
                control[joint] = int(Control.DISABLE_VOLTAGE)
            elif mode != self._modes[joint]:
                loop.send_mode(joint, mode)
                self._modes[joint] = mode
        sample = loop.exchange(control, [each.torque_wire for each in passed], [each.position_wire for each in passed])
        if any(each.refused for each in passed) and (why := refusal(self.names, command, command_age, max_age)):
            raise Refused(f"gate: {why}")
        fault = find_fault(self.names, sample, modes, loop.emergencies, loop.node_states, max_age)
        if fault:
            raise BusFault(fault)
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
        for joint, (limits, passed) in enumerate(zip(self._limits, self._passed, strict=True)):
            position = loop.latest_position[joint]
            standing = position if math.isfinite(position) else passed.position
            self._passed[joint] = start_from(limits, loop.latest_motor_torque[joint], standing)
        return loop.exchange(
            control, [each.torque_wire for each in self._passed], [each.position_wire for each in self._passed]
        )

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
        raise BusFault(stuck(self.names, states, target, self._loop.emergencies, ENABLE_SECONDS))

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
