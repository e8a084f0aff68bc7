"""Temperatures, and the calibrations in force: in the drives that keep one, in the host for the others.

A calibration in the host is in force by record: what the entry-point group `armlink.calibrations` tells of an arm
(`calib.records.store`) is taken when its drives are opened, and said to be missing where there is none.
"""

import logging
from collections.abc import Callable, Sequence

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.contributed import contributions
from armlink.link.joints.ask import LinkAsk
from armlink.link.joints.groups import Group, by_joint, traits_of
from armlink.link.joints.values import JointValues
from armlink.link.types import DriveSerial
from armlink.torque_calibration import Calibration, per_joint

BLANK_CALIBRATION = Calibration(1.0, 0.0)
"""Of a drive that was never calibrated."""
Provider = Callable[[ArmFile], Sequence[Calibration | None]]
log = logging.getLogger("armlink")


def calibrations_by_record(arm: ArmFile) -> list[Calibration | None]:
    """Calibrations by an arm's records, joint by joint; None where no record is in force."""
    for point in contributions("armlink.calibrations"):
        provide: Provider = point.load()
        return list(provide(arm))
    return [None] * len(arm.require_link().joints)


class Calibrations:
    """A part of whatever has drives and can ask them."""

    arm: ArmFile
    names: tuple[str, ...]
    n: int
    groups: tuple[Group, ...]
    values: JointValues
    ask: LinkAsk
    _in_host: dict[int, Calibration]
    _simulated: bool

    def calibrate_host(self, simulated: bool) -> None:
        """Put the host's calibrations into force; of an arm that is simulated in this process, and new, there are none.

        Raises Refused where the record in force is of another arm.
        """
        self._simulated = simulated
        traits = traits_of(self.groups)
        hosted = [joint for joint in range(self.n) if traits[joint].calibration == "host"]
        found = calibrations_by_record(self.arm) if hosted and not simulated else [None] * self.n
        self._in_host = {joint: found[joint] or BLANK_CALIBRATION for joint in hosted}
        missing = [self.names[joint] for joint in hosted if found[joint] is None]
        if missing and not simulated:
            log.warning(
                "%s: there is no current calibration record for %s: their torques are used as the drives report them",
                self.arm.name,
                ", ".join(missing),
            )
        if len(missing) < len(hosted) and not self.arm.has_serial:
            log.warning(
                "%s: its serial is %s, so the calibration may belong to another arm of this name: give "
                "each arm a serial of its own (`serial: …`), then calibrate again from the sweeps of each arm",
                self.arm.name,
                self.arm.serial,
            )
        self._apply_host()

    @property
    def uncalibrated(self) -> tuple[str, ...]:
        """Joints that the host is to calibrate, and has no calibration for."""
        return tuple(self.names[joint] for joint, held in self._in_host.items() if held.is_blank)

    def _apply_host(self) -> None:
        self.values.calibrate(per_joint([self._in_host.get(joint, BLANK_CALIBRATION) for joint in range(self.n)]))

    def _ask(self, group: Group) -> LinkAsk:
        return self.ask.on(group.tag)

    @property
    def temperatures(self) -> Array:
        """Temperatures (n,) [°C] that the drives tell with their readings; NaN for one that must be asked."""
        told = np.full(self.n, np.nan)
        for group in self.groups:
            told[list(group.places)] = group.drives.temperatures
        return told

    def read_temperatures(self) -> Array:
        """Temperatures of the drives (n,) [°C]; NaN for a drive that does not report one. Raises BusFault."""
        found = np.full(self.n, np.nan)
        for joint, (group, number) in enumerate(by_joint(self.groups)):
            found[joint] = group.drives.temperature(number, self._ask(group))
        return found

    def read_calibration(self, joint: int) -> Calibration:
        """The calibration that is in force for joint 0 … n−1, in its drive or in the host; raises BusFault."""
        if joint in self._in_host:
            return self._in_host[joint]
        group, number = by_joint(self.groups)[joint]
        return group.drives.read_calibration(number, self._ask(group))

    def drive_serial(self, joint: int) -> DriveSerial:
        """Serial number of the drive of joint 0 … n−1, if it keeps its calibration itself; raises BusFault."""
        if joint in self._in_host:
            return DriveSerial(simulated=self._simulated)
        group, number = by_joint(self.groups)[joint]
        return DriveSerial(group.drives.serial_number(number, self._ask(group)), self._simulated)

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Put a calibration into force for joint 0 … n−1 (`store`: in a drive's flash too); raises BadInput, BusFault.

        While the joints are enabled, the cycle goes on with the last command. In the host it is in force until this is
        closed; the record that is current then is taken at the next opening. Only `calib.install.journaled_write`
        calls this.
        """
        if joint in self._in_host:
            calibration.require_usable(self.names[joint])
            self._in_host[joint] = calibration
            self._apply_host()
            self.calibration_changed(joint)
            return calibration
        group, number = by_joint(self.groups)[joint]
        return group.drives.write_calibration(number, self._ask(group), calibration, store)

    def calibration_changed(self, joint: int) -> None: ...
