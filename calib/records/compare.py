"""Differences between two records of one arm, per joint, in units and in standard deviations."""

from dataclasses import dataclass

import numpy as np

from armlink.errors import BadInput, Refused
from calib.records.records import PARAMETERS, CalibrationRecord, GravityRecord
from gcomp.arrays import Array

UNITS = {"gain": "1", "offset": "N·m", "position_gain": "1", "position_offset": "rad", "x": "kg·m", "y": "kg·m"}


@dataclass(frozen=True)
class ParameterChange:
    """One parameter of one joint in two records; None for a missing value."""

    joint: str
    parameter: str
    """gain, offset, position_gain, position_offset; of a gravity record x and y of the mass moment."""
    unit: str
    before: float | None
    after: float | None
    std: float | None
    """Standard deviation of the change, both records taken as independent; None if neither was estimated."""

    @property
    def change(self) -> float | None:
        """After minus before; None if either is missing."""
        return None if self.before is None or self.after is None else self.after - self.before

    @property
    def deviations(self) -> float | None:
        """The change in standard deviations; None if that is not known."""
        change = self.change
        return None if change is None or not self.std else change / self.std

    @property
    def texts(self) -> tuple[str, ...]:
        """Before, after, change, and the change in standard deviations, for people."""
        values = ((self.before, ".5f"), (self.after, ".5f"), (self.change, "+.5f"), (self.deviations, "+.1f"))
        return tuple("–" if value is None else format(value, form) for value, form in values)


def differences(
    before: CalibrationRecord | GravityRecord, after: CalibrationRecord | GravityRecord
) -> list[ParameterChange]:
    """Every parameter of both records, joints base to tip; raises Refused, BadInput if they are not comparable."""
    for what in ("arm", "serial", "description_hash"):
        ours, theirs = getattr(before, what), getattr(after, what)
        if ours != theirs:
            name = what.partition("_")[0]
            raise Refused(
                f"records {before.id} and {after.id}: {name} {ours[:12]} and {theirs[:12]} have nothing in common"
            )
    if isinstance(before, CalibrationRecord) and isinstance(after, CalibrationRecord):
        return _of_calibration(before, after)
    if isinstance(before, GravityRecord) and isinstance(after, GravityRecord):
        return _of_gravity(before, after)
    raise BadInput(
        f"{before.id} is a {before.kind} record and {after.id} a {after.kind} record: give two records of one kind"
    )


def _of_calibration(before: CalibrationRecord, after: CalibrationRecord) -> list[ParameterChange]:
    stds = {name: (before.std(name), after.std(name)) for name in PARAMETERS}
    values = {name: (before.values(name), after.values(name)) for name in PARAMETERS}
    return [
        _change(joint.name, name, *(side[j] for side in values[name]), *(side[j] for side in stds[name]))
        for j, joint in enumerate(before.joints)
        for name in PARAMETERS
    ]


def _of_gravity(before: GravityRecord, after: GravityRecord) -> list[ParameterChange]:
    (old, old_std), (new, new_std) = (_moments(record) for record in (before, after))
    return [
        _change(name, axis, old[2 * j + k], new[2 * j + k], old_std[2 * j + k], new_std[2 * j + k])
        for j, name in enumerate(before.names)
        for k, axis in enumerate(("x", "y"))
    ]


def _moments(record: GravityRecord) -> tuple[Array, Array]:
    known = np.array(record.identifiable)
    spread = np.sqrt(np.maximum(np.diag(np.array(record.covariance)), 0.0))
    return np.where(known, np.array(record.beta), np.nan), np.where(known, spread, np.nan)


def _change(joint: str, name: str, before: float, after: float, std_before: float, std_after: float) -> ParameterChange:
    spread = float(np.sqrt(np.nansum([std_before**2, std_after**2])))
    return ParameterChange(joint, name, UNITS[name], _number(before), _number(after), spread or None)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
