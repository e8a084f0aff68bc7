"""Calibration record from a field fit: identified values are new, the others are carried over from the last record."""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from calib.field.field_fit import FieldFit
from calib.records.records import CalibrationRecord, JointCalibration, Parameter, matrix, provenance
from gcomp.arrays import Array

PAIR: tuple[Parameter, Parameter] = ("gain", "offset")


def field_record(
    arm: ArmFile, fit: FieldFit, before: CalibrationRecord | None, sources: dict[str, str]
) -> CalibrationRecord:
    """The record of a fit; `before` is the current one. Raises Refused if no value was identified."""
    if np.isnan(fit.gain).all() and np.isnan(fit.offset).all():
        first = next(iter(fit.reasons.items()))
        raise Refused(f"no gain and no offset can be determined; for example {first[0][0]} {first[0][1]}: {first[1]}")
    joints = tuple(_joint(name, j, fit, before) for j, name in enumerate(fit.names))
    names, covariance = _covariance(fit, before)
    carried = [f"{name} {parameter}" for name, parameter in fit.reasons]
    note = "field calibration without a mass"
    if carried and before is not None:
        note += f"; carried over from {before.id}: {', '.join(carried)}"
    return CalibrationRecord(
        **provenance(arm, sources),
        joints=joints,
        drives=() if before is None else before.drives,
        covariance_of=names,
        covariance=matrix(covariance) if names else (),
        parent=None if before is None else before.id,
        note=note,
    )


def _joint(name: str, j: int, fit: FieldFit, before: CalibrationRecord | None) -> JointCalibration:
    old = None if before is None else before.joints[j]
    values: dict[str, float | None] = {}
    reasons: dict[Parameter, str] = {}
    for parameter in PAIR:
        found = float(getattr(fit, parameter)[j])
        values[parameter] = found if np.isfinite(found) else (None if old is None else getattr(old, parameter))
        if values[parameter] is None:
            known = None if old is None else old.not_identifiable.get(parameter)
            reasons[parameter] = known or fit.reasons[name, parameter]
    for parameter, default in (("position_gain", 1.0), ("position_offset", 0.0)):
        values[parameter] = default if old is None else getattr(old, parameter)
    if old is not None:
        reasons |= {key: why for key, why in old.not_identifiable.items() if values[key] is None}
    residual = fit.residual[:, j][np.isfinite(fit.residual[:, j])]
    return JointCalibration(
        name=name,
        gain=values["gain"],
        offset=values["offset"],
        position_gain=values["position_gain"],
        position_offset=values["position_offset"],
        not_identifiable=reasons,
        residual_std=float(np.sqrt(np.mean(residual**2))) if len(residual) else None,
        discrepancy=None if old is None else old.discrepancy,
    )


def _covariance(fit: FieldFit, before: CalibrationRecord | None) -> tuple[tuple[str, ...], Array]:
    """Names and covariance: of the fit's values, and, independent of them, of those carried over."""
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
