"""The self-test of an arm's controllers: what they are, what they hold, and what they do when their host falls silent.

Without power it reads, configures and reads back. With power every joint is enabled and holds where it stands; then
each in turn is quick-stopped, and left without commands; then all are left without the host's heartbeat. What each
device does, and how long it takes, is measured, not believed.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from armlink.arm_file import LinkJoint
from armlink.drives.canopen import controller_setup as device
from armlink.drives.canopen import emcy, pdo
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import torque_sensor_record as calibration
from armlink.drives.canopen.cia402 import MODE_NAMES, DriveState, state_of, supports
from armlink.drives.canopen.cyclic.wire import check_fits
from armlink.drives.canopen.drives import CanopenDrives
from armlink.drives.canopen.eds_file import OPTIONAL, expected_identity, used_objects
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.profile import LOST, OURS, Profile
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.units import read_units
from armlink.drives.findings import ANSWER_CYCLES, HOLD_TOLERANCE, SILENCE_DEADLINES, Checks, Result, count_answers
from armlink.drives.orders import Limits, Mode, Power
from armlink.errors import ArmlinkError, BusFault, Refused

NEEDED = (objects.CONTROL_WORD, objects.STATUS_WORD, objects.MODE, objects.POSITION)
"""Objects without which nothing goes."""
POWER_CHECKS = (
    "answers SYNC",
    "heartbeat of the device",
    "mode display",
    "enables and holds",
    "quick stop",
    "RPDO deadline",
    "heartbeat of the host",
)
HOLD_SECONDS = 0.3
"""A stopped joint is watched for this long: does it stay in quick stop, holding?"""
LATE_SHARE, LATE_SECONDS = 0.5, 0.03
"""A device may take half its deadline and 30 ms longer than it was told, and two cycles."""


class CanopenSelfTest:
    """Runs the checks on an arm's controllers; the link must not be started."""

    def __init__(
        self, link: Any, drives: CanopenDrives, limits: Sequence[Limits], progress: Callable[[str], None]
    ) -> None:
        """`link` is the Link of an arm whose joints these drives are; `progress` is told what is being done."""
        self.link, self.drives, self.limits, self.progress = link, drives, limits, progress
        self.services = drives.services(link.ask)
        self.profiles = [OURS] * drives.m
        self.checks = Checks()
        self.commander, self.loop = link.commander, link.commander.loop
        self._harmed = ""
        self._refused = False
        """Whether the joints are not driven because of a drive that is told already."""
        self._standing = np.full(link.n, np.nan)
        self._last = 0.0
        """Time of the last SYNC [s]."""

    def run(self, power: bool) -> list[Result]:
        """All checks; those with power only where `power`, and where all before them passed.

        Raises BusFault where another host is on the bus.
        """
        link = self.link
        missing = [each.joint for each in self.services if not each.present()]
        link.require_alone()
        for services, row in zip(self.services, self.drives.rows, strict=True):
            self.progress(f"{services.joint}: identity, objects, settings")
            if services.joint in missing:
                self.checks.add(services.joint, "answers", "failed", f"no answer from node {services.node}")
                continue
            if self.checks.attempt(services.joint, "identity", partial(self._identity, services, row)):
                self._look_at(services, row)
        if not missing:
            self.checks.results += link.turns.results(link.read_positions())
        if not self.checks.failed:
            for node in self.drives.nmt_targets():
                self.drives.send_nmt(link.ask, objects.NMT_PRE_OPERATIONAL, node)
            for joint, services in enumerate(self.services):
                self._settings(services, joint)
        self._with_power(power)
        return self.checks.results

    def _look_at(self, services: NodeServices, row: LinkJoint) -> None:
        """Objects, modes and calibration of a device; of a stock one what it lacks, and what is lost by that."""
        if row.settings.torque == "record":
            self._objects(services)
            self._modes(services)
            self._calibration(services)
            return
        self.drives.send_nmt(self.link.ask, objects.NMT_PRE_OPERATIONAL, services.node)
        profile = device.examine_device(services, row.settings)
        self.profiles[self.drives.rows.index(row)] = profile
        for lost in profile.lost:
            self.checks.add(services.joint, f"objects: {lost.partition(' ')[0]}", "absent", lost)
        needed = [entry for entry in NEEDED if not services.has(entry)]
        found = ", ".join(f"{entry}: the device lacks it" for entry in needed)
        self.checks.judge(
            services.joint, "objects", not needed, found or "the device has every object that the link needs"
        )
        self._modes(services)
        if row.name in self.link.uncalibrated:
            found = "the host has no calibration record: the torque is used as the device reports it"
            self.checks.add(services.joint, "calibration", "absent", found)

    def _with_power(self, power: bool) -> None:
        failed = self.checks.failed
        if power and not failed:
            self._check_with_power()
            return
        reason = "not run: the checks with power were not requested"
        if failed:
            reason = f"not run: {failed[0].joint} failed the check of its {failed[0].check}"
        for name, check in self.checks.missing(POWER_CHECKS, self.link.names):
            self.checks.add(name, check, "not run", reason)

    def _identity(self, services: NodeServices, row: LinkJoint) -> str:
        device.check_identity(services, row)
        stated = expected_identity(row, services.remote.object_dictionary)
        told = [f"{int(services.read(entry)):#x}" for entry in device.IDENTITY_OBJECTS.values()]
        known = "as stated" if stated.model_dump(exclude_none=True) else "not stated in the arm file"
        return f"{':'.join(told)}, {known}"

    def _objects(self, services: NodeServices) -> None:
        """Every object that the link uses is there, with the length that the data sheet has."""
        wrong, count = [], 0
        for entry in used_objects():
            if services.has(entry):
                count += 1
                try:
                    services.read(entry)
                except ArmlinkError as error:
                    wrong.append(str(error))
            elif entry in OPTIONAL:
                lost = OPTIONAL[entry] or "the device lacks it"
                self.checks.add(services.joint, f"data sheet: {entry}", "absent", lost)
            else:
                wrong.append(f"{entry}: the device lacks it")
        found = "; ".join(wrong) or f"{count} objects as the data sheet has them"
        self.checks.judge(services.joint, "data sheet", not wrong, found)

    def _modes(self, services: NodeServices) -> None:
        def work() -> str:
            supported = self.drives.offered(services, self.drives.names.index(services.joint))
            for mode in (Mode.PROFILE_POSITION, Mode.PROFILE_TORQUE):
                if not supports(supported, mode):
                    self.checks.add(services.joint, f"modes: {int(mode)}", "absent", f"no {MODE_NAMES[mode]} mode")
            return ", ".join(str(int(mode)) for mode in MODE_NAMES if mode and supports(supported, mode))

        self.checks.attempt(services.joint, "modes", work)

    def _calibration(self, services: NodeServices) -> None:
        def work() -> str:
            held = calibration.read_record(services)
            crc = calibration.calibration_crc(held.gain, held.offset, held.record_id, held.date)
            new = (held.gain, held.offset, held.record_id, held.crc) == (1.0, 0.0, 0, 0)
            if held.crc != crc and not new:
                raise services.fault(
                    objects.RECORD_CRC, f"is {held.crc:#x}, but the calibration in the device gives {crc:#x}"
                )
            return f"gain {held.gain:.6g}, offset {held.offset:.4g} N·m, record {held.record_id}"

        self.checks.attempt(services.joint, "calibration", work)

    def _settings(self, services: NodeServices, joint: int) -> None:
        """Configure as start() does, but go on where something is refused."""
        row, profile, limits = self.drives.rows[joint], self.profiles[joint], self.limits[joint]
        attempt = self.checks.attempt

        def others_off() -> str:
            pdo.disable_others(services)
            return "all are off, so no other program can command the joint through them"

        attempt(services.joint, "settings: other RPDOs", others_off)
        for each in profile.pdos:
            attempt(services.joint, f"PDO mapping: {each.name}", partial(self._mapping, services, each, profile))
        try:
            unit = read_units(services, row)
            check_fits(row, limits, unit)
            supported = self.drives.offered(services, joint)
            settings = device.settings(unit, limits, self.drives.protection, supported, profile)
        except ArmlinkError as error:
            self.checks.add(services.joint, "units", "failed", str(error))
            return
        self.checks.add(services.joint, "units", "passed", f"rated torque {unit.torque * 1e3:.6g} N·m")
        if services.has(objects.TORQUE_OFFSET):
            settings = [(objects.TORQUE_OFFSET, 0), *settings]
        for entry, value in settings:
            attempt(services.joint, f"settings: {entry}", partial(_written, services, entry, value))

    def _mapping(self, services: NodeServices, each: pdo.Pdo, profile: Profile) -> str:
        milliseconds = self.drives.protection.deadline_ms
        device.configure_pdo(services, each, milliseconds, profile)
        is_command = each.name == pdo.RPDO1.name and profile.has(objects.RPDO_DEADLINE)
        deadline = f", deadline {milliseconds} ms" if is_command else ""
        return f"{len(each.entries)} objects, read back{deadline}"

    def _check_with_power(self) -> None:
        """The checks with power on configured nodes, as far as they go; what was not reached is reported as not run.

        Every way out is a quick stop of all joints.
        """
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
        for name, check in self.checks.missing(POWER_CHECKS, self.link.names):
            self.checks.add(name, check, "not run" if told or not reason else "failed", reason or self._harmed)
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
            self.checks.add(name, "heartbeat of the host", "failed", found)
        if keeping:
            self._refused = True
            raise Refused(
                f"{keeping[0]} is not driven: if its host died, its drive would keep on with the last command"
            )

    def _has(self, joint: int, entry: Entry, check: str) -> bool:
        """Whether a device has the object that a check is about; if not, the check is told to be absent."""
        if self.drives.wires[joint].profile.has(entry):
            return True
        self.checks.add(self.link.names[joint], check, "absent", f"{entry}: {LOST[entry]}")
        return False

    def _tell(self, joint: int, check: str, passed: bool, found: str, seconds: float | None = None) -> None:
        self.checks.judge(self.link.names[joint], check, passed, found, seconds)

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
        self.progress("readings, heartbeats and modes, without power")
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
            self.loop.send(pdo.RPDO2.cob_base + node, bytes([own]))
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
        self.progress("enabling the joints, which should hold")
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
        self.progress(f"{self.link.names[joint]}: quick stop")
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
        self.progress(f"{link.names[joint]}: sending no commands for {limit * 1e3:.0f} ms")
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
        self.progress(f"all joints: sending no heartbeat for {limit * 1e3:.0f} ms")
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
        return state_of(int(self.services[joint].read(objects.STATUS_WORD)))

    def _cycles(self, seconds: float) -> int:
        return max(1, round(seconds / float(self.link.period)))


def _written(services: NodeServices, entry: Entry, value: int) -> str:
    services.write_checked(entry, value)
    return f"{value}, read back"


def self_test(
    link: Any, drives: CanopenDrives, limits: Sequence[Limits], power: bool, progress: Callable[[str], None]
) -> list[Result]:
    return CanopenSelfTest(link, drives, limits, progress).run(power)
