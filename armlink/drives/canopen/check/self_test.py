"""The self-test of an arm's controllers: what they are, what they hold, and what they do when their host falls silent.

Without power it reads, configures and reads back. With power every joint is enabled and holds where it stands; then
each in turn is quick-stopped, and left without commands; then all are left without the host's heartbeat. What each
device does, and how long it takes, is measured, not believed.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from armlink.arm_file import LinkJoint
from armlink.drives.canopen import controller_setup as device
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen import torque_sensor_record as calibration
from armlink.drives.canopen.check.power_test import PowerTest
from armlink.drives.canopen.cia402 import MODE_NAMES, supports
from armlink.drives.canopen.cyclic.wire import check_fits
from armlink.drives.canopen.drives import CanopenDrives
from armlink.drives.canopen.eds_file import OPTIONAL, expected_identity, used_objects
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.profile import OURS, Profile
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.units import read_units
from armlink.drives.findings import Checks, Result
from armlink.drives.orders import Limits, Mode
from armlink.errors import ArmlinkError

NEEDED = (objects.CONTROL_WORD, objects.STATUS_WORD, objects.MODE, objects.POSITION)
"""Objects without which nothing goes."""


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
        if failed or not power:
            reason = (
                f"not run: {failed[0].joint} failed the check of its {failed[0].check}"
                if failed
                else "not run: the checks with power were not requested"
            )
            for name, check in self.checks.missing(PowerTest.CHECKS, self.link.names):
                self.checks.add(name, check, "not run", reason)
            return
        PowerTest(self.link, self.drives, self.checks, self.progress).run()

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


def _written(services: NodeServices, entry: Entry, value: int) -> str:
    services.write_checked(entry, value)
    return f"{value}, read back"


def self_test(
    link: Any, drives: CanopenDrives, limits: Sequence[Limits], power: bool, progress: Callable[[str], None]
) -> list[Result]:
    return CanopenSelfTest(link, drives, limits, progress).run(power)
