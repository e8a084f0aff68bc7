"""Temperatures, and the calibrations in force: in the drives that keep one, in the host for the others."""

import numpy as np

from armlink.arrays import Array
from armlink.drives.family import KeepsCalibration
from armlink.errors import BadInput
from armlink.link.joints.ask import LinkAsk
from armlink.link.joints.groups import Group
from armlink.torque_calibration import Calibration


class Calibrations:
    """A part of whatever has drives and can ask them."""

    names: tuple[str, ...]
    n: int
    groups: tuple[Group, ...]
    ask: LinkAsk

    def _ask(self, group: Group) -> LinkAsk:
        return self.ask.on(group.tag)

    def read_temperatures(self) -> Array:
        """Temperatures of the drives (n,) [°C]; NaN for a drive that does not report one. Raises BusFault."""
        found = np.full(self.n, np.nan)
        for group in self.groups:
            for drive, place in enumerate(group.places):
                found[place] = group.drives.temperature(drive, self._ask(group))
        return found

    def read_calibration(self, joint: int) -> Calibration:
        """The calibration that is in force for joint 0 … n−1; raises BusFault."""
        group, drive = self._drive(joint)
        if isinstance(group.drives, KeepsCalibration) and group.drives.traits(drive).calibration == "controller":
            return group.drives.read_calibration(drive, self._ask(group))
        raise BadInput(f"{self.names[joint]}: its drive keeps no calibration")

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Make a calibration active in joint 0 … n−1 (`store`: in flash too); raises BadInput, BusFault.

        While the joints are enabled, the cycle goes on with the last command. Only
        `calib.install.journaled_write` calls this.
        """
        group, drive = self._drive(joint)
        if isinstance(group.drives, KeepsCalibration) and group.drives.traits(drive).calibration == "controller":
            return group.drives.write_calibration(drive, self._ask(group), calibration, store)
        raise BadInput(f"{self.names[joint]}: its drive keeps no calibration")

    def _drive(self, joint: int) -> tuple[Group, int]:
        return next((group, group.places.index(joint)) for group in self.groups if joint in group.places)
