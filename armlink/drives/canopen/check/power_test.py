"""The part of the self-test that needs power: quick stop, and what the joints do when their host falls silent."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from armlink.drives.canopen import emcy
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import DriveState, state_of
from armlink.drives.canopen.drives import CanopenDrives
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import RPDO2
from armlink.drives.canopen.profile import LOST
from armlink.drives.findings import ANSWER_CYCLES, HOLD_TOLERANCE, SILENCE_DEADLINES, Checks, count_answers
from armlink.drives.orders import Mode, Power
from armlink.errors import ArmlinkError, BusFault, Refused

HOLD_SECONDS = 0.3
"""A stopped joint is watched for this long: does it stay in quick stop, holding?"""
LATE_SHARE, LATE_SECONDS = 0.5, 0.03
"""A device may take half its deadline and 30 ms longer than it was told, and two cycles."""


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

    def __init__(self, link: Any, drives: CanopenDrives, checks: Checks, progress: Callable[[str], None]) -> None:
        """`link`: the Link of an arm with these joints; results are added to `checks`."""
        self.link, self.drives, self.commander, self.loop = link, drives, link.commander, link.commander.loop
        self._checks, self._progress = checks, progress
        self._harmed = ""
        self._refused = False
        """Whether the joints are not driven because of a drive that is told already."""
        self._standing = np.full(link.n, np.nan)
        self._last = 0.0
        """Time of the last SYNC [s]."""

    def run(self) -> None:
        """All checks, as far as they go; what was not reached is reported as not run."""
        reason = ""
        try:
            self.link.start()
            self._without_torque()
            self._require_watch()
            self._enable()
            for joint in range(self.link.n):
                self._quick_stop(joint)
            for joint in range(self.link.n):
                if self._has(joint, objects.RPDO_DEADLINE, "RPDO deadline"):
                    self._silence(joint)
            self._no_heartbeat()
        except ArmlinkError as error:
            reason = str(error)
        finally:
            self.loop.withheld, self.drives.cycle.beating = frozenset(), True
            if self.commander.passed:
                self.commander.stop()
        told = self._refused
        for name, check in self._checks.missing(self.CHECKS, self.link.names):
            self._checks.add(name, check, "not run" if told or not reason else "failed", reason or self._harmed)
            told = True

    def _require_watch(self) -> None:
        """Raise Refused for a device that does not watch its host at all: its joint is not driven."""
        keeping = [
            name for joint, name in enumerate(self.link.names) if self.drives.traits(joint).silence == "keeps on"
        ]
        for name in keeping:
            found = (
                "the device watches neither the commands (1400h:05) nor the heartbeat (1016h) of its host: do "
                "not drive this joint"
            )
            self._checks.add(name, "heartbeat of the host", "failed", found)
        if keeping:
            self._refused = True
            raise Refused(
                f"{keeping[0]} is not driven: if its host died, its drive would keep on with the last command"
            )

    def _has(self, joint: int, entry: Entry, check: str) -> bool:
        """Whether a device has the object that a check is about; if not, the check is told to be absent."""
        if self.drives.wires[joint].profile.has(entry):
            return True
        self._checks.add(self.link.names[joint], check, "absent", f"{entry}: {LOST[entry]}")
        return False

    def _tell(self, joint: int, check: str, passed: bool, found: str, seconds: float | None = None) -> None:
        self._checks.judge(self.link.names[joint], check, passed, found, seconds)

    def _cycle(self, power: list[Power], tested: int | None = None) -> Any:
        """One cycle; raises BusFault where a joint that is not being tested has a fault, or one moves."""
        sample = self.commander.stand(power)
        self._last = sample.t
        names, watch = self.link.names, self.loop.watch
        if watch.intruder or self.drives.known.restarted:
            where = self.drives.known.restarted and names[min(self.drives.known.restarted)]
            raise BusFault(watch.intrusion if watch.intruder else f"{where}: its drive has restarted")
        moved = np.abs(sample.position - self._standing)
        if (moved > HOLD_TOLERANCE).any():
            joint = int(np.nanargmax(moved))
            text = f"moved by {moved[joint]:.3f} rad while it should hold (limit {HOLD_TOLERANCE:g} rad)"
            remedy = "check its load, its brake and its position loop"
            raise BusFault(f"{names[joint]}: {text}, so the test was ended: {remedy}")
        if tested is not None:
            for joint, code, _ in self.drives.known.emergencies:
                if joint != tested:
                    raise BusFault(f"{names[joint]}: emergency {code:04X}h, {emcy.name_of(code)}, while it held still")
        return sample

    def _without_torque(self) -> None:
        """Cycles without power: readings in every one, the device's own heartbeat, the mode that is displayed."""
        link = self.link
        self._progress("readings, heartbeats and modes, without power")
        off = [Power.OFF] * link.n
        self.drives.known.node_states.clear()
        beat = 2 * self.drives.protection.producer_ms * 1e-3
        cycles = max(ANSWER_CYCLES, int(np.ceil(beat / link.period)) + 1)
        cycle, late = lambda: self._cycle(off).position, lambda: self.loop.listen(cycles * link.period)
        answers = count_answers(self.loop.board, cycle, cycles, late)
        for joint, (answered, told) in enumerate(answers):
            self._tell(joint, "answers SYNC", answered, told)
            heard = joint in self.drives.known.node_states
            found = (
                f"heard, period {self.drives.protection.producer_ms} ms"
                if heard
                else f"not heard within {beat * 1e3:.0f} ms"
            )
            self._tell(joint, "heartbeat of the device", heard, found)
        since = {mode: self._time_modes(mode, off) for mode in (Mode.TORQUE, Mode.POSITION)}
        for joint in range(link.n):
            slow = [
                f"{int(mode)} (displays {self.drives.known.displays[joint]})"
                for mode in since
                if since[mode][joint] is None and mode in link.setups[joint].modes
            ]
            times = [seconds for mode in since if (seconds := since[mode][joint]) is not None]
            found = f"does not enter mode {', '.join(slow)}" if slow else "follows 6060h"
            self._tell(joint, "mode display", not slow, found, max(times) if times else None)

    def _time_modes(self, mode: Mode, off: list[Power]) -> list[float | None]:
        """Time until each joint displays a mode, None where it does not within the deadline."""
        link, start = self.link, self.link.clock.now()
        times: list[float | None] = [None] * link.n
        asked = [self.drives.cycle.own_mode(joint, mode) for joint in range(link.n)]
        for node, own in zip(self.drives.nodes, asked, strict=True):
            self.loop.send(RPDO2.cob_base + node, bytes([own]))
        while None in times and link.clock.now() - start <= link.section.deadline:
            self._cycle(off)
            now = link.clock.now() - start
            times = [
                now if time is None and shown == own else time
                for time, shown, own in zip(times, self.drives.known.displays, asked, strict=True)
            ]
        return times

    def _enable(self) -> None:
        link = self.link
        self._progress("enabling the joints, which should hold")
        start = link.clock.now()
        sample = self.commander.walk(Power.ON)
        self._standing, self._last = sample.position.copy(), sample.t
        self.drives.known.emergencies.clear()
        seconds = link.clock.now() - start
        for _ in range(self._cycles(HOLD_SECONDS)):
            sample = self._cycle([Power.ON] * link.n, tested=-1)
        moved = np.abs(sample.position - self._standing)
        for joint in range(link.n):
            found = f"moved by {moved[joint]:.4f} rad in {HOLD_SECONDS} s"
            self._tell(joint, "enables and holds", True, found, seconds)

    def _again(self) -> None:
        drives = self.drives
        self.loop.withheld, drives.cycle.beating = frozenset(), True
        for joint, state in drives.known.node_states.items():
            if state != objects.OPERATIONAL:
                drives.send_nmt(self.link.ask, objects.NMT_START, drives.nodes[joint])
        drives.known.node_states.clear()
        self._last = self.commander.walk(Power.ON).t
        drives.known.emergencies.clear()

    def _quick_stop(self, joint: int) -> None:
        self._progress(f"{self.link.names[joint]}: quick stop")
        control = [Power.ON] * self.link.n
        control[joint] = Power.STOPPED
        state, seconds = self._reaction(joint, control, self.link.section.deadline)
        kept = state is DriveState.QUICK_STOP and self._stays(joint, control)
        found = "stops and holds" if kept else f"{state.value}, then {self._state(joint).value}"
        self._tell(joint, "quick stop", kept, found, seconds)
        self._again()

    def _silence(self, joint: int) -> None:
        """No RPDO1 for one joint, all others commanded as before."""
        link, limit = self.link, self.drives.protection.deadline_ms * 1e-3
        self._progress(f"{link.names[joint]}: sending no commands for {limit * 1e3:.0f} ms")
        self.loop.withheld = frozenset([joint])
        state, seconds = self._reaction(joint, [Power.ON] * link.n, SILENCE_DEADLINES * limit)
        self._judge(joint, "RPDO deadline", state, seconds, limit)
        self._again()

    def _no_heartbeat(self) -> None:
        """No heartbeat of the host for all joints, which are commanded as before."""
        link, limit = self.link, self.drives.protection.heartbeat_ms * 1e-3
        if self._harmed:
            return
        watching = [self._has(joint, objects.HEARTBEAT_CONSUMER, "heartbeat of the host") for joint in range(link.n)]
        if not any(watching):
            return
        self._progress(f"all joints: sending no heartbeat for {limit * 1e3:.0f} ms")
        self.drives.beat(self.link.ask)
        self.drives.cycle.beating = False
        start, seconds = self._last, 0.0
        after: list[tuple[DriveState, float] | None] = [None] * link.n
        pairs = list(enumerate(watching))
        while any(watches and after[joint] is None for joint, watches in pairs) and seconds < SILENCE_DEADLINES * limit:
            seconds = self._cycle([Power.ON] * link.n).t - start + link.period
            for joint, each in enumerate(after):
                left = self.drives.known.node_states.get(joint, objects.OPERATIONAL) != objects.OPERATIONAL
                state = self._read(joint) if left and each is None else self._state(joint)  # it sends no status then
                if each is None and state is not DriveState.ENABLED:
                    after[joint] = (state, seconds)
        for joint, each in enumerate(after):
            if not watching[joint]:
                continue
            self._judge(joint, "heartbeat of the host", *(each or (self._read(joint), seconds)), limit)
        self._again()

    def _reaction(self, joint: int, control: list[Power], patience: float) -> tuple[DriveState, float]:
        """State that a joint goes to, and by the end of which cycle it shows it; its state after `patience` seconds."""
        start, seconds = self._last, 0.0
        while seconds < patience:
            seconds = self._cycle(control, tested=joint).t - start + self.link.period
            if self._state(joint) is not DriveState.ENABLED:
                return self._state(joint), seconds
        return self._read(joint), seconds

    def _stays(self, joint: int, control: list[Power]) -> bool:
        for _ in range(self._cycles(HOLD_SECONDS)):
            self._cycle(control, tested=joint)
        return self._state(joint) is DriveState.QUICK_STOP

    def _judge(self, joint: int, check: str, state: DriveState, seconds: float, limit: float) -> None:
        """Quick stop in time passes; anything else is told as what the device does."""
        allowed = limit * (1 + LATE_SHARE) + LATE_SECONDS + 2 * self.link.period
        codes = [code for place, code, _ in self.drives.known.emergencies if place == joint]
        why = f", emergency {codes[0]:04X}h" if codes else ", no emergency"
        nmt = self.drives.known.node_states.get(joint, objects.OPERATIONAL)
        left = "" if nmt == objects.OPERATIONAL else f", NMT {objects.NMT_STATES.get(nmt, nmt)} (1029h:01)"
        timing = f"after {seconds * 1e3:.0f} ms (set to {limit * 1e3:.0f} ms){why}{left}"
        if state is DriveState.ENABLED:
            self._tell(joint, check, False, f"does nothing within {seconds * 1e3:.0f} ms (set to {limit * 1e3:.0f} ms)")
        elif state is DriveState.QUICK_STOP:
            in_time = seconds <= allowed
            self._tell(joint, check, in_time, f"quick stop {'' if in_time else 'too late, '}{timing}", seconds)
        else:
            hint = (
                "; does this device swap the values 2 and 3 of 6007h?" if state is DriveState.SWITCH_ON_DISABLED else ""
            )
            self._tell(
                joint, check, False, f'goes to "{state.value}" instead of "quick stop active" {timing}{hint}', seconds
            )
            self._harmed = f"not run: {self.link.names[joint]} lost its power in the check of its {check}"

    def _state(self, joint: int) -> DriveState:
        return state_of(self.drives.known.statuses[joint])

    def _read(self, joint: int) -> DriveState:
        status: Any = self.drives.services(self.link.ask)[joint].read(objects.STATUS_WORD)
        return state_of(int(status))

    def _cycles(self, seconds: float) -> int:
        return max(1, round(seconds / float(self.link.period)))
