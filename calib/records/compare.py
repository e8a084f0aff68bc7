"""Differences between two records of one arm, per joint, in units and in standard deviations."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from armlink.errors import BadInput, Refused
from calib.records.records import PARAMETERS, CalibrationRecord, GravityRecord

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
    if before.kind != after.kind:
        raise BadInput(
            f"{before.id} is a {before.kind} record and {after.id} a {after.kind} record: give two records of one kind"
        )
    pairs = zip(_parameters(before), _parameters(after), strict=True)
    return [_change(joint, name, old, new) for (joint, name, *old), (_, _, *new) in pairs]


def _parameters(record: CalibrationRecord | GravityRecord) -> Iterator[tuple[str, str, float, float]]:
    """Joint, parameter, value and standard deviation; NaN for what was not estimated."""
    if isinstance(record, CalibrationRecord):
        for j, joint in enumerate(record.joints):
            for name in PARAMETERS:
                yield joint.name, name, float(record.values(name)[j]), float(record.std(name)[j])
        return
    spread = np.sqrt(np.maximum(np.diag(np.array(record.covariance)), 0.0))
    known = np.array(record.identifiable)
    values, stds = np.where(known, record.beta, np.nan).tolist(), np.where(known, spread, np.nan).tolist()
    for (joint_name, axis), value, std in zip(product(record.names, "xy"), values, stds, strict=True):
        yield joint_name, axis, value, std


def _change(joint: str, name: str, old: list[float], new: list[float]) -> ParameterChange:
    """From value and standard deviation, old and new."""
    (before, std_before), (after, std_after) = old, new
    spread = float(np.sqrt(np.nansum([std_before**2, std_after**2])))
    return ParameterChange(joint, name, UNITS[name], _number(before), _number(after), spread or None)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value
