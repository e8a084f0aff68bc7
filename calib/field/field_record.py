"""A calibration record out of a field fit: what the rows show is new, the rest is carried over from before."""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from calib.field.field_fit import FieldFit
from calib.install.plausibility import FEWEST, worse_by
from calib.records.records import Array, CalibrationRecord, JointCalibration, Parameter, matrix, provenance
from gcomp.identify.readings import StaticReadings

PAIR: tuple[Parameter, Parameter] = ("gain", "offset")
BLOCK = 24
"""Neighbouring rows that are held out together: they are alike."""


def field_record(
    arm: ArmFile, fit: FieldFit, before: CalibrationRecord | None, sources: dict[str, str]
) -> CalibrationRecord:
    """The record of a fit; `before` is the one in force. Raises Refused where nothing at all was separated."""
    if np.isnan(fit.gain).all() and np.isnan(fit.offset).all():
        first = next(iter(fit.reasons.items()))
        raise Refused(f"no gain and no offset is determined; {first[0][0]} {first[0][1]}: {first[1]}")
    joints = tuple(_joint(name, j, fit, before) for j, name in enumerate(fit.names))
    names, covariance = _covariance(fit, before)
    carried = [f"{name} {parameter}" for name, parameter in fit.reasons]
    note = "field calibration without a mass"
    if carried and before is not None:
        note += f"; carried over from {before.id}: {', '.join(carried)}"
    return CalibrationRecord(
        **provenance(arm, sources),
        joints=joints,
        covariance_of=names,
        covariance=matrix(covariance) if names else (),
        parent=None if before is None else before.id,
        note=note,
    )


def check_field_heldout(rows: StaticReadings, fit: FieldFit, before: CalibrationRecord) -> None:
    """Raise Refused where rows left out of it are predicted worse than with the pairs in force.

    Every joint's line through the model torque is drawn on every second block of rows and tried on the others.
    """
    block = np.arange(len(rows.torque)) // min(BLOCK, max(len(rows.torque) // 6, 1)) % 2
    gain, offset = before.values("gain"), before.values("offset")
    for j, name in enumerate(fit.names):
        if np.isnan(fit.gain[j]) or np.isnan(gain[j]) or np.isnan(offset[j]):
            continue
        counted = np.isfinite(rows.torque[:, j]) & np.isfinite(fit.torque[:, j])
        new, old = [], []
        for held in (0, 1):
            train, test = counted & (block != held), counted & (block == held)
            if train.sum() < FEWEST or not test.any():
                continue
            line = np.polyfit(fit.torque[train, j], rows.torque[train, j], 1)
            new.append(rows.torque[test, j] - np.polyval(line, fit.torque[test, j]))
            old.append(rows.torque[test, j] - gain[j] * fit.torque[test, j] - offset[j])
        ratio = worse_by(np.concatenate(new), np.concatenate(old)) if new else None
        if ratio is not None:
            raise Refused(
                f"{name}: rows left out of the fit are {ratio:.2f} times as far off with the new pair as with record"
                f" {before.id}: they do not agree with one another; nothing was written"
            )


def _joint(name: str, j: int, fit: FieldFit, before: CalibrationRecord | None) -> JointCalibration:
    old = None if before is None else before.joints[j]
    values: dict[str, float | None] = {}
    reasons: dict[Parameter, str] = {}
    for parameter in PAIR:
        found = float(getattr(fit, parameter)[j])
        values[parameter] = found if np.isfinite(found) else (None if old is None else getattr(old, parameter))
        if values[parameter] is None:
            told = None if old is None else old.not_identifiable.get(parameter)
            reasons[parameter] = told or fit.reasons[name, parameter]
    for parameter, default in (("position_gain", 1.0), ("position_offset", 0.0)):
        values[parameter] = default if old is None else getattr(old, parameter)
    if old is not None:
        reasons |= {key: why for key, why in old.not_identifiable.items() if values[key] is None}
    residual = fit.residual[:, j][np.isfinite(fit.residual[:, j])]
    return JointCalibration(
        name=name, **values, not_identifiable=reasons, residual_std=_rms(residual) if len(residual) else None
    )


def _covariance(fit: FieldFit, before: CalibrationRecord | None) -> tuple[tuple[str, ...], Array]:
    """Names and covariance: the fit's pairs, and of the record before what was carried over, independent of them."""
    new = {f"{name}.{p}": (j, k) for j, name in enumerate(fit.names) for k, p in enumerate(PAIR)}
    new = {name: at for name, at in new.items() if np.isfinite(fit.covariance[at[0], at[1], at[1]])}
    old = () if before is None else tuple(name for name in before.covariance_of if name not in new)
    names = (*new, *old)
    covariance = np.zeros((len(names), len(names)))
    for a, (j, k) in enumerate(new.values()):
        for b, (i, m) in enumerate(new.values()):
            if i == j:
                covariance[a, b] = fit.covariance[j, k, m]
    if before is not None and old:
        at = [before.covariance_of.index(name) for name in old]
        covariance[len(new) :, len(new) :] = np.array(before.covariance)[np.ix_(at, at)]
    return names, covariance


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
