"""One cycle of the link: wait for its time, gate, frames, readings, faults; the ways into and out of power."""

import contextlib
import math
from collections.abc import Sequence

import numpy as np

from armlink.clock import Clock
from armlink.drives.canopen.cia402 import Control, Mode, State, next_control, set_point_control, state_of, supports
from armlink.drives.canopen.pdo import STATUS_DECIMATION
from armlink.errors import BusFault, HostLate, Refused, Silence
from armlink.link.cyclic_exchange import Loop
from armlink.link.faults import Known, bus_fault, find_fault, node_fault, refusal, stopped_itself, stuck
from armlink.link.gate import JointLimits, Passed, Seen, pass_gate, start_from
from armlink.link.types import Command, Sample

ENABLE_SECONDS = 3.0
"""The joints must reach a commanded CiA 402 state within this time."""
STOP_CYCLES = 25
"""Cycles in which a quick stop is repeated until every joint reports it."""
MEMORY = 1.0
"""So long after the host was late, joints that stop by themselves are put down to it [s]: their watches run on the
heartbeat too, which they may miss for twice `link.deadline`."""
BLAME_SHARE = 0.5
"""A host that was late by this share of `link.deadline` explains a watchdog that acts at the whole of it."""
OFF, PROFILE_POSITION, PROFILE_TORQUE = int(Mode.OFF), int(Mode.PROFILE_POSITION), int(Mode.PROFILE_TORQUE)
ENABLE, QUICK_STOP = int(Control.ENABLE), int(Control.QUICK_STOP)
DISABLE_VOLTAGE = int(Control.DISABLE_VOLTAGE)


class Commander:
    """Turns commands into frames for n joints, through the gate and nothing else, and readings into faults."""

    def __init__(
        self, loop: Loop, clock: Clock, names: tuple[str, ...], period: float, max_age: float, lock_step: bool
    ) -> None:
        """`max_age` is the oldest command and reading that count [s]; in lock-step a SYNC is the period itself."""
        self.names, self.n, self.clock, self.period, self.max_age = names, len(names), clock, period, max_age
        self.limits: list[JointLimits] = []
        self.passed: list[Passed] = []
        """Contents of the last frames."""
        self.loop, self._lock_step = loop, lock_step
        self._slow_age = max_age + STATUS_DECIMATION * period
        self._supported: list[int] = []
        self._modes = [OFF] * self.n
        self._commanded = [OFF] * self.n
        self._mode_since = [-math.inf] * self.n
        self._known = Known(
            names,
            loop.statuses,
            loop.displays,
            loop.seen,
            self._mode_since,
            loop.emergencies,
            loop.node_states,
            loop.watch.restarted,
        )
        self._due = 0.0
        self.late = 0.0
        """How late the present cycle began [s]."""
        self._gap, self._gap_at = 0.0, -math.inf
        """Longest time without a SYNC of late, less a period, and when it ended [s]."""

    def begin(self, limits: list[JointLimits], passed: list[Passed], supported: list[int]) -> None:
        """Take over configured nodes: limits, what the first cycle starts from, supported modes (6502h)."""
        self.limits, self.passed, self._supported = limits, passed, supported
        self._due = self.clock.now()

    def command(self, command: Command) -> Sample:
        """One cycle of a command; raises Refused where the gate refuses it, BusFault for a fault."""
        modes, torques, positions = self._numbers(command)
        self._await_turn()
        loop, passed, now = self.loop, self.passed, self.clock.now()
        age = 0.0 if command.t is None else now - command.t
        fault = self._fault(now, self._commanded)
        seen = self._seen(now, fault is None)
        control, stopped = [ENABLE] * self.n, False
        for joint, mode in enumerate(modes):
            limits, held = self.limits[joint], passed[joint]
            passed[joint] = pass_gate(limits, mode, torques[joint], positions[joint], age, held, seen[joint])
            if passed[joint].refused:
                control[joint], stopped = QUICK_STOP, True
            elif mode == OFF:
                control[joint] = DISABLE_VOLTAGE
            else:
                if mode != self._modes[joint]:
                    self._select(joint, mode, now)
                if mode == PROFILE_POSITION:
                    control[joint] = set_point_control(loop.statuses[joint])
        self._commanded, synced = modes, loop.synced
        torque_wire, position_wire = [each.torque_wire for each in passed], [each.position_wire for each in passed]
        decided = math.inf if stopped else now - age
        sample = loop.exchange(control, torque_wire, position_wire, decided, self.max_age)
        sample.late = self.late
        if not self._lock_step:  # this process may have stood still at any line
            self._note_gap(loop.synced - synced, loop.synced)
            self._note_gap(self.clock.now() - loop.synced, now)
        why = stopped and refusal(self.names, command, age, passed, seen, self.limits)
        if why:
            raise Refused(f"gate: {why}")
        fault = fault or self._fault(now, modes)
        if fault:
            raise fault
        return sample

    def stand(self, control: list[int]) -> Sample:
        """A cycle that commands no motion: control words; targets as the joints stand and pull now.

        A joint that is enabled keeps the target position that it has: one that followed the reading would sag.
        """
        self._await_turn()
        loop = self.loop
        for joint, (limits, passed) in enumerate(zip(self.limits, self.passed, strict=True)):
            position, mode = loop.latest_position[joint], OFF
            if state_of(loop.statuses[joint]) is State.ENABLED or not math.isfinite(position):
                position, mode = passed.position, int(Mode.POSITION)
            self.passed[joint] = start_from(limits, loop.latest_motor_torque[joint], position)._replace(mode=mode)
        return loop.exchange(
            control, [each.torque_wire for each in self.passed], [each.position_wire for each in self.passed]
        )

    def walk(self, target: State) -> Sample:
        """Cycle until every joint is in `target`, each by the next control word of the table; returns the last sample.

        To be enabled also takes that the joint displays position control and has told the torque that it now produces.
        Raises BusFault naming the joint that does not get there.
        """
        loop, start = self.loop, self.clock.now()
        for joint in range(self.n):
            loop.send_mode(joint, Mode.POSITION)
            self._modes[joint] = int(Mode.POSITION)
            self._mode_since[joint] = start
        self._commanded = modes = self._modes.copy() if target is State.ENABLED else [OFF] * self.n
        states, since = [State.UNKNOWN] * self.n, [math.inf] * self.n
        control = [self._first_word(status, target) for status in loop.statuses]
        for _ in range(max(int(ENABLE_SECONDS / self.period), STOP_CYCLES)):
            sample = self.stand(control)
            now = self.clock.now()
            states = [state_of(int(status)) for status in sample.status]
            since = [min(s, now) if state is target else math.inf for s, state in zip(since, states, strict=True)]
            if all(state is target for state in states) and np.isfinite(sample.position).all():
                told = all(slow >= s for slow, s in zip(loop.slow_seen, since, strict=True))
                if target is not State.ENABLED or (told and loop.displays == modes):
                    return sample
            if loop.watch.restarted or loop.watch.intruder:
                break
            for joint, state in enumerate(states):
                reset_again = state is State.FAULT and control[joint] == Control.FAULT_RESET
                control[joint] = DISABLE_VOLTAGE if reset_again else next_control(state, target)
        known = self._known
        restarted = node_fault(known) if known.restarted and not known.emergencies else None
        raise BusFault(
            bus_fault(self.names, loop.watch, 0) or restarted or stuck(known, states, target, modes, ENABLE_SECONDS)
        )

    @staticmethod
    def _first_word(status: int, target: State) -> int:
        """A word that changes nothing yet, so that the next one is an edge; a joint with power keeps it."""
        state = state_of(status)
        if state is State.QUICK_STOP:
            return QUICK_STOP
        return next_control(state, target) if state is State.ENABLED else DISABLE_VOLTAGE

    def quick_stop(self) -> None:
        """Quick stop of every joint, repeated until all report it, as far as the bus still carries it."""
        control = [QUICK_STOP] * self.n
        with contextlib.suppress(BusFault):
            for _ in range(STOP_CYCLES):
                sample = self.stand(control)
                if not any(state_of(int(status)) is State.ENABLED for status in sample.status):
                    break

    def _numbers(self, command: Command) -> tuple[list[int], list[float], list[float]]:
        """A command's fields as lists; raises Refused where they are not n numbers each, or a mode is not supported."""
        for field, kinds in (("mode", "iu"), ("torque", "iuf"), ("position", "iuf")):
            values = getattr(command, field)
            shape, kind = getattr(values, "shape", None), getattr(getattr(values, "dtype", None), "kind", "?")
            if shape != (self.n,) or kind not in kinds:
                raise Refused(
                    f"gate: {field} of a command is an array {shape} of kind {kind!r}, expected ({self.n},) "
                    f"{'whole ' if kinds == 'iu' else ''}numbers, one each of {', '.join(self.names)}"
                )
        modes: list[int] = command.mode.tolist()
        for joint, mode in enumerate(modes):
            if mode in (PROFILE_POSITION, PROFILE_TORQUE) and not supports(self._supported[joint], mode):
                held = self._supported[joint]
                raise Refused(f"gate: {self.names[joint]}: mode {mode} is not supported: 6502h is {held:#x}")
        return modes, command.torque.tolist(), command.position.tolist()

    def _seen(self, now: float, healthy: bool) -> list[Seen]:
        loop, seen = self.loop, []
        for joint in range(self.n):
            known = now - loop.slow_seen[joint] <= self._slow_age
            torque = loop.latest_motor_torque[joint] if known else math.nan
            velocity = loop.latest_velocity[joint] if known else math.nan
            seen.append(Seen(torque, loop.latest_position[joint], velocity, now - loop.seen[joint], healthy))
        return seen

    def _select(self, joint: int, mode: int, now: float) -> None:
        self.loop.send_mode(joint, mode)
        self._modes[joint], self._mode_since[joint] = mode, now

    def _fault(self, now: float, modes: Sequence[int]) -> BusFault | None:
        """The fault at time `now`; what the host's own lateness explains is put down to that and to nothing else."""
        fault = find_fault(self._known, now, modes, self.max_age)
        shown = bus_fault(self.names, self.loop.watch, self.loop.dropped)
        if self._gap_at + MEMORY >= now and self._gap > self.max_age:
            return HostLate(self._gap, self.max_age, stopped_itself(self._known))
        if fault is None:
            return None if shown is None else BusFault(shown)
        if self._gap_at + MEMORY >= now and self._gap > BLAME_SHARE * self.max_age:
            stopped = stopped_itself(self._known)
            if stopped or isinstance(fault, Silence):
                return HostLate(self._gap, self.max_age, stopped)
        return fault

    def _note_gap(self, seconds: float, now: float) -> None:
        """No SYNC was sent for so long before `now` [s]; the longest of late is kept."""
        gap = seconds - self.period
        if gap > self.period and math.isfinite(gap) and (gap >= self._gap or now > self._gap_at + MEMORY):
            self._gap, self._gap_at = gap, now

    def settle(self) -> None:
        """Restart after an interruption: what came meanwhile, and how late the host was, is forgotten."""
        self.loop.settle()
        self._gap, self._gap_at = 0.0, -math.inf
        self._due = self.clock.now()

    def _await_turn(self) -> None:
        if not self._lock_step:
            self.clock.sleep_until(self._due)
            now, stats = self.clock.now(), self.loop.stats
            self.late = now - self._due
            stats.late += self.late > 0.1 * self.period
            stats.lateness.add(self.late)
            self._note_gap(now - self.loop.synced, now)
            self._due = max(self._due, now - self.period) + self.period
        self.loop.drain()
