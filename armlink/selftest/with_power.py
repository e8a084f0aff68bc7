"""The part of the self-test that needs power: quick stop, and what the joints do when their host falls silent."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from armlink.drives.canopen import emcy
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import Control, Mode, State, state_of
from armlink.errors import ArmlinkError, BusFault
from armlink.link.faults import bus_fault
from armlink.link.link import Link
from armlink.link.types import Sample

CYCLES = 50
"""SYNCs that are sent to see whether each is answered."""
ANSWERED = 0.9
"""Share of them whose answer must come in its cycle; a busy host misses some."""
HOLD_SECONDS = 0.3
"""A stopped joint is watched for this long: does it stay in quick stop, holding?"""
MOVED = 0.05
"""A joint that moves further than this while it should hold ends the test [rad]."""
LATE_SHARE, LATE_SECONDS = 0.5, 0.03
"""A device may take half its deadline and 30 ms longer than it was told, and two cycles."""
PATIENCE = 3.0
"""So many deadlines are waited for a reaction."""


class PowerTest:
    """Runs on configured nodes of a link; every way out of it is a quick stop of all joints."""

    CHECKS: ClassVar[tuple[str, ...]] = (
        "answers SYNC",
        "heartbeat of the device",
        "mode display",
        "enables and holds",
        "quick stop",
        "RPDO deadline",
        "heartbeat of the host",
    )

    def __init__(self, link: Link, add: Callable[..., None], progress: Callable[[str], None]) -> None:
        """`add(joint, check, outcome, found, seconds)` takes results."""
        self.link, self.commander, self.loop = link, link.commander, link.commander.loop
        self._add, self._progress = add, progress
        self._harmed = ""
        self._reached: dict[str, set[str]] = {check: set() for check in self.CHECKS}
        self._standing = np.full(link.n, np.nan)
        self._last = 0.0
        """Time of the last SYNC [s]."""

    def run(self) -> None:
        """All checks, as far as they go; what was not reached is reported as not run."""
        reason = ""
        try:
            self.link.start()
            self._without_torque()
            self._enable()
            for joint in range(self.link.n):
                self._quick_stop(joint)
            for joint in range(self.link.n):
                self._silence(joint)
            self._no_heartbeat()
        except ArmlinkError as error:
            reason = str(error)
        finally:
            self.loop.withheld, self.loop.beating = frozenset(), True
            if self.commander.passed:
                self.commander.quick_stop()
        told = False
        for check, joints in self._reached.items():
            for name in self.link.names:
                if name not in joints:
                    self._add(name, check, "not run" if told or not reason else "failed", reason or self._harmed)
                    told = True

    def _tell(self, joint: int, check: str, passed: bool, found: str, seconds: float | None = None) -> None:
        name = self.link.names[joint]
        self._reached[check].add(name)
        self._add(name, check, "passed" if passed else "failed", found, seconds)

    def _cycle(self, control: list[int], tested: int | None = None) -> Sample:
        """One cycle; raises BusFault where a joint that is not being tested has a fault, or one moves."""
        sample = self.commander.stand(control)
        self._last = sample.t
        names, watch = self.link.names, self.loop.watch
        fault = bus_fault(names, watch, 0)
        if fault or watch.restarted:
            raise BusFault(fault or f"{names[min(watch.restarted)]}: its controller has restarted")
        moved = np.abs(sample.position - self._standing)
        if (moved > MOVED).any():
            joint = int(np.nanargmax(moved))
            raise BusFault(f"{names[joint]}: moved by {moved[joint]:.3f} rad while it should hold: test ended")
        if tested is not None:
            for joint, code, _ in self.loop.emergencies:
                if joint != tested:
                    raise BusFault(f"{names[joint]}: emergency {code:04X}h, {emcy.name_of(code)}, while it only held")
        return sample

    def _without_torque(self) -> None:
        """Cycles without power: readings in every one, the device's own heartbeat, the mode that is displayed."""
        link, loop = self.link, self.loop
        self._progress("readings, heartbeats and modes, without power")
        off, came = [int(Control.DISABLE_VOLTAGE)] * link.n, np.zeros(link.n, int)
        loop.node_states.clear()
        beat = 2 * link.protection.producer_ms * 1e-3
        cycles = max(CYCLES, int(np.ceil(beat / link.period)) + 1)
        for _ in range(cycles):
            came += np.isfinite(self._cycle(off).position)
        for joint in range(link.n):
            self._tell(
                joint,
                "answers SYNC",
                bool(came[joint] >= ANSWERED * cycles),
                f"{came[joint]} of {cycles} SYNCs answered",
            )
            heard = joint in loop.node_states
            found = (
                f"heard, period {link.protection.producer_ms} ms" if heard else f"not heard within {beat * 1e3:.0f} ms"
            )
            self._tell(joint, "heartbeat of the device", heard, found)
        since = {mode: self._time_modes(mode, off) for mode in (Mode.TORQUE, Mode.POSITION)}
        for joint in range(link.n):
            slow = [f"{int(mode)} (displays {loop.displays[joint]})" for mode in since if since[mode][joint] is None]
            times = [seconds for mode in since if (seconds := since[mode][joint]) is not None]
            found = f"does not enter mode {', '.join(slow)}" if slow else "follows 6060h"
            self._tell(joint, "mode display", not slow, found, max(times) if times else None)

    def _time_modes(self, mode: Mode, off: list[int]) -> list[float | None]:
        """Time until each joint displays a mode, None where it does not within the deadline."""
        link, start = self.link, self.link.clock.now()
        times: list[float | None] = [None] * link.n
        for joint in range(link.n):
            self.loop.send_mode(joint, mode)
        while None in times and link.clock.now() - start <= link.section.deadline:
            self._cycle(off)
            now = link.clock.now() - start
            times = [
                now if time is None and shown == mode else time
                for time, shown in zip(times, self.loop.displays, strict=True)
            ]
        return times

    def _enable(self) -> None:
        link = self.link
        self._progress("enable, and hold")
        start = link.clock.now()
        sample = self.commander.walk(State.ENABLED)
        self._standing, self._last = sample.position.copy(), sample.t
        self.loop.emergencies.clear()
        seconds = link.clock.now() - start
        for _ in range(self._cycles(HOLD_SECONDS)):
            sample = self._cycle([int(Control.ENABLE)] * link.n, tested=-1)
        moved = np.abs(sample.position - self._standing)
        for joint in range(link.n):
            self._tell(
                joint, "enables and holds", True, f"moved by {moved[joint]:.4f} rad in {HOLD_SECONDS} s", seconds
            )

    def _again(self) -> None:
        """Everything back to enabled."""
        loop = self.loop
        loop.withheld, loop.beating = frozenset(), True
        for joint, state in loop.node_states.items():
            if state != objects.OPERATIONAL:
                self.link.send_nmt(objects.NMT_START, self.link.nodes[joint])
        loop.node_states.clear()
        self._last = self.commander.walk(State.ENABLED).t
        loop.emergencies.clear()

    def _quick_stop(self, joint: int) -> None:
        """The command quick stop: reached, kept, and the joint holds."""
        self._progress(f"{self.link.names[joint]}: quick stop")
        control = [int(Control.ENABLE)] * self.link.n
        control[joint] = int(Control.QUICK_STOP)
        state, seconds = self._reaction(joint, control, self.link.section.deadline)
        kept = state is State.QUICK_STOP and self._stays(joint, control)
        found = "stops and holds" if kept else f"{state.value}, then {self._state(joint).value}"
        self._tell(joint, "quick stop", kept, found, seconds)
        self._again()

    def _silence(self, joint: int) -> None:
        """No RPDO1 for one joint, all others commanded as before."""
        link, limit = self.link, self.link.protection.deadline_ms * 1e-3
        self._progress(f"{link.names[joint]}: no commands for {limit * 1e3:.0f} ms")
        self.loop.withheld = frozenset([joint])
        state, seconds = self._reaction(joint, [int(Control.ENABLE)] * link.n, PATIENCE * limit)
        self._judge(joint, "RPDO deadline", state, seconds, limit)
        self._again()

    def _no_heartbeat(self) -> None:
        """No heartbeat of the host for all joints, which are commanded as before."""
        link, limit = self.link, self.link.protection.heartbeat_ms * 1e-3
        if self._harmed:
            return
        self._progress(f"all joints: no heartbeat of the host for {limit * 1e3:.0f} ms")
        self.loop.beat()
        self.loop.beating = False
        start, seconds = self._last, 0.0
        after: list[tuple[State, float] | None] = [None] * link.n
        while None in after and seconds < PATIENCE * limit:
            seconds = self._cycle([int(Control.ENABLE)] * link.n).t - start + link.period
            for joint, each in enumerate(after):
                left = self.loop.node_states.get(joint, objects.OPERATIONAL) != objects.OPERATIONAL
                state = self._read(joint) if left and each is None else self._state(joint)  # it sends no status then
                if each is None and state is not State.ENABLED:
                    after[joint] = (state, seconds)
        for joint, each in enumerate(after):
            self._judge(joint, "heartbeat of the host", *(each or (self._read(joint), seconds)), limit)
        self._again()

    def _reaction(self, joint: int, control: list[int], patience: float) -> tuple[State, float]:
        """State that a joint goes to, and by the end of which cycle it shows it; its state after `patience` seconds."""
        start, seconds = self._last, 0.0
        while seconds < patience:
            seconds = self._cycle(control, tested=joint).t - start + self.link.period
            if self._state(joint) is not State.ENABLED:
                return self._state(joint), seconds
        return self._read(joint), seconds

    def _stays(self, joint: int, control: list[int]) -> bool:
        for _ in range(self._cycles(HOLD_SECONDS)):
            self._cycle(control, tested=joint)
        return self._state(joint) is State.QUICK_STOP

    def _judge(self, joint: int, check: str, state: State, seconds: float, limit: float) -> None:
        """Quick stop in time passes; anything else is told as what the device does."""
        allowed = limit * (1 + LATE_SHARE) + LATE_SECONDS + 2 * self.link.period
        codes = [code for place, code, _ in self.loop.emergencies if place == joint]
        why = f", emergency {codes[0]:04X}h" if codes else ", no emergency"
        nmt = self.loop.node_states.get(joint, objects.OPERATIONAL)
        left = "" if nmt == objects.OPERATIONAL else f", NMT {objects.NMT_STATES.get(nmt, nmt)} (1029h:01)"
        timing = f"after {seconds * 1e3:.0f} ms (told {limit * 1e3:.0f} ms){why}{left}"
        if state is State.ENABLED:
            self._tell(joint, check, False, f"does nothing within {seconds * 1e3:.0f} ms (told {limit * 1e3:.0f} ms)")
        elif state is State.QUICK_STOP:
            in_time = seconds <= allowed
            self._tell(joint, check, in_time, f"quick stop {'' if in_time else 'too late, '}{timing}", seconds)
        else:
            hint = ": 6007h has values 2 and 3 the other way round?" if state is State.SWITCH_ON_DISABLED else ""
            self._tell(joint, check, False, f"goes to {state.value}, expected quick stop, {timing}{hint}", seconds)
            self._harmed = f"not run: {self.link.names[joint]} lost its power in the check of its {check}"

    def _state(self, joint: int) -> State:
        return state_of(self.loop.statuses[joint])

    def _read(self, joint: int) -> State:
        status: Any = self.link.services[joint].read(objects.STATUS_WORD)
        return state_of(int(status))

    def _cycles(self, seconds: float) -> int:
        return max(1, round(seconds / self.link.period))
