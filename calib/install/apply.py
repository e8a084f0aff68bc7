"""`--apply` of `armlink calibrate` and `recalibrate`: gates, check motion, write, check motion again."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.link.link import Link
from calib.field.field_fit import FieldFit
from calib.field.field_record import check_field_heldout
from calib.fit.sensor_fit import SensorFit
from calib.install.check_motion import CheckMotion
from calib.install.journaled_write import install, mend
from calib.install.plausibility import check_bounds, check_change, check_gates, check_holds, past_changes
from calib.records.records import Array, CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData
from gcomp.identify.readings import StaticReadings


@dataclass(frozen=True)
class Apply:
    """How a record from sweeps goes to the controllers."""

    by: str
    """Who ordered it."""
    bus: str | None = None
    """INTERFACE:CHANNEL[@BITRATE]; None is the arm file's."""
    replaced: Sequence[str] = ()
    """Joints whose sensor was exchanged: their change is not judged by their history."""
    accepted: Sequence[str] = ()
    """Joints that are written although the model does not hold there."""
    check: bool = True
    """Make the check motion before and after."""
    flash: bool = False
    """Also store to flash."""


def apply_calibration(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    data: Sequence[SweepData],
    fit: SensorFit,
    how: Apply,
) -> tuple[str, ...]:
    """Write a record that was fitted to sweeps to the controllers and make it current; returns the joints written.

    `data` are those sweeps, `fit` their fit, whose gravity model the check motion is judged by. The record is kept in
    any case. Raises Refused where a gate or the check says no, BusFault; the controllers then hold what they held.
    """
    _require(record, arm, store, how)
    check_holds(fit.goodness.findings, how.accepted)
    check_gates(record, arm, store, data, how.replaced)
    beta = None if np.isnan(fit.value("gain")).all() else fit.fit.complete.beta
    return _write(record, arm, store, beta, how, "sweeps")


def apply_field(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    rows: StaticReadings,
    fit: FieldFit,
    beta: Array,
    how: Apply,
) -> tuple[str, ...]:
    """The same for a record of `armlink recalibrate`, from slow rows."""
    _require(record, arm, store, how)
    check_bounds(record, arm)
    old = store.current(CalibrationRecord, arm)
    if old is not None:
        check_change(record, old, past_changes(store, arm), arm, how.replaced)
        check_field_heldout(rows, fit, old)
    return _write(record, arm, store, beta, how, "slow motion")


def _require(record: CalibrationRecord, arm: ArmFile, store: RecordStore, how: Apply) -> None:
    """Keep the record; raise Refused where there is nothing to write, BadInput on an unknown joint."""
    for option, joints in (("--replaced", how.replaced), ("--accept", how.accepted)):
        for unknown in sorted(set(joints) - set(arm.joint_names)):
            raise BadInput(f"{option} {unknown}: no such joint; the arm has {', '.join(arm.joint_names)}")
    store.add(record.require(arm))
    if all(joint.offset is None for joint in record.joints):
        raise Refused("--apply: no joint has a gain or an offset, so nothing is written")


def _write(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, beta: Array | None, how: Apply, source: str
) -> tuple[str, ...]:
    exchanged = f"; sensor exchanged: {', '.join(how.replaced)}" if how.replaced else ""
    with Link.open(arm, how.bus) as link:
        link.start()
        mend(arm, store, link)
        motion = CheckMotion(link, arm, record, beta) if how.check else None
        if motion is not None:
            link.enable()
            motion.before()
        after = None if motion is None else motion.after
        return install(record, arm, store, link, by=how.by, reason=source + exchanged, check=after, flash=how.flash)
