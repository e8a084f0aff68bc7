"""Gates, check motion, write, check motion; for records from sweeps, creeps, slow motion and from earlier."""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.loop.driver import ArmDriver
from armlink.loop.open import open_arm
from calib.arm.kinematics import DriveLimits
from calib.dataset import SweepData
from calib.fit.creep_fit import CreepFit
from calib.fit.field_fit import FieldFit, heldout_errors
from calib.fit.findings import FitFinding
from calib.fit.heldout import heldout_scores, worse_joint
from calib.fit.sensor_fit import SensorFit
from calib.fit.sweep_readings import sweep_readings
from calib.install.check_motion import CheckMotion, check_poses
from calib.install.journaled_write import install, recover
from calib.install.plausibility import Admitted, GateRefused, Refusal, admit, admit_rollback
from calib.records.records import ArmRecord, CalibrationRecord, GravityRecord
from calib.records.store import RecordStore
from calib.sweep.verify import run_verify
from gcomp.arrays import Array
from gcomp.identify.readings import StaticReadings


@dataclass(frozen=True)
class Apply:
    """How a record is written to the controllers."""

    by: str
    """Who ordered it."""
    bus: str | None = None
    """INTERFACE:CHANNEL[@BITRATE]; None is the arm file's."""
    replaced: Sequence[str] = ()
    """Joints whose sensor was exchanged: their change is not judged by their history."""
    accepted: Sequence[str] = ()
    """Joints that are written although the sensor model does not hold there."""
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

    `data` are those sweeps, `fit` their fit, whose gravity model judges the check motion. The record is kept in any
    case. Raises Refused if a gate or the check refuses, BusFault; the controllers then hold what they held before.
    """
    _keep(record, arm, store, how)
    admitted = admit_sweeps(record, arm, store, data, fit.goodness.findings, how)
    beta = None if np.isnan(fit.value("gain")).all() else fit.fit.complete.beta
    return _write(lambda link: admitted, record, arm, store, beta, how, "sweeps")


def apply_creep(record: CalibrationRecord, arm: ArmFile, store: RecordStore, fit: CreepFit, how: Apply) -> None:
    """Make a record current that was fitted to creep sweeps; the host keeps it. The record is kept in any case.

    With `how.check`, short creeps about the arm's present pose have to agree with it first. Raises Refused, BusFault.
    """
    _keep(record, arm, store, how)
    check_holds(fit.findings, how.accepted)
    admit(record, arm, store, how.replaced)
    if how.check and fit.found_gain.any():
        gravity, limits = fit.gravity.record(arm, record), DriveLimits.of(arm)
        with open_arm(arm, how.bus) as link:
            link.start()
            link.enable()
            found = run_verify(link, arm, gravity, record, at=lambda begin: check_poses(begin, limits))
        worst = int(np.argmax(found.rms / found.tolerance))
        if not found.passed:
            raise Refused(
                f"{found.names[worst]}: in the check motion {found.rms[worst]:.3f} N·m RMS against the model, allowed"
                f" {found.tolerance[worst]:.3f}; record {record.id} is kept, and not made current"
            )
    store.activate(record.id, arm, how.by, "creep sweeps")


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
    _keep(record, arm, store, how)
    admitted = admit(record, arm, store, how.replaced)
    before = admitted.before
    if before is not None and not fitted_to(before, data_of(record)):
        _refuse_worse(arm, before, *heldout_errors(rows, fit, before))
    return _write(lambda link: admitted, record, arm, store, beta, how, "slow motion")


def apply_rollback(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, how: Apply, reason: str
) -> tuple[str, ...]:
    """Write an earlier record to the controllers and make it current again; returns the joints written.

    Its only gate is the distance from what the controllers hold. Raises Refused, BusFault.
    """
    gravity = store.current(GravityRecord, arm)
    beta = None if gravity is None else np.array(gravity.beta)

    def gate(link: ArmDriver) -> Admitted:
        held = {joint: link.read_calibration(joint) for joint in range(link.n)}
        return admit_rollback(record, arm, store, held, how.replaced)

    _check_names(arm, how)
    return _write(gate, record, arm, store, beta, how, reason)


def admit_sweeps(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    data: Sequence[SweepData],
    findings: Sequence[FitFinding],
    how: Apply,
) -> Admitted:
    """The gates of a record from sweeps: the model holds, bounds, change, held-out data; raises GateRefused."""
    check_holds(findings, how.accepted)
    admitted = admit(record, arm, store, how.replaced)
    if admitted.before is not None and not how.replaced:
        check_heldout(record, admitted.before, arm, data, store.current(GravityRecord, arm))
    return admitted


def check_holds(findings: Sequence[FitFinding], accepted: Sequence[str] = ()) -> None:
    """Raise GateRefused if the fit found that the sensor model does not hold on a joint that was not `accepted` so."""
    broken = next((each for each in findings if each.breaks_model and each.joint not in accepted), None)
    if broken is not None:
        why = broken.text.removeprefix(f"{broken.joint}: ").rstrip(".")
        raise GateRefused(Refusal.MODEL, broken.joint, why=why)


def check_heldout(
    new: CalibrationRecord,
    old: CalibrationRecord,
    arm: ArmFile,
    data: Sequence[SweepData],
    gravity: GravityRecord | None = None,
) -> None:
    """Raise GateRefused if held-out readings of a joint are predicted worse than by the old record.

    New gains, offsets and mass moments are estimated from the other steps; the old record's gains and offsets are
    fixed, and so are the mass moments of `gravity`; without it those are estimated too. A record that was fitted to
    some of these readings is not judged by them: for it they are not held out.
    """
    digests = {each.digest for each in data}
    if fitted_to(old, digests):
        return
    rows = sweep_readings([each.require(arm) for each in data])
    independent = gravity is not None and not fitted_to(gravity, digests)
    beta = np.array(gravity.require(arm).beta) if gravity is not None and independent else None
    fresh = heldout_scores(new, arm, rows, refit=True)
    _refuse_worse(arm, old, fresh, heldout_scores(old, arm, rows, refit=False, beta=beta))


def fitted_to(record: ArmRecord, digests: Set[str]) -> bool:
    """Whether a record comes from some of these data sets: for it they are not held out."""
    return not digests.isdisjoint(record.sources.values())


def data_of(record: ArmRecord) -> set[str]:
    """Digests of the data that a record comes from; other records, such as gravity's, are named by their ids."""
    return {digest for name, digest in record.sources.items() if not name.endswith(digest)}


def _refuse_worse(arm: ArmFile, old: CalibrationRecord, new_errors: Array, old_errors: Array) -> None:
    worse = worse_joint(new_errors, old_errors)
    if worse is not None:
        raise GateRefused(Refusal.HELD_OUT, arm.joint_names[worse[0]], ratio=worse[1], record=old.id)


def _keep(record: CalibrationRecord, arm: ArmFile, store: RecordStore, how: Apply) -> None:
    """Keep the record; raise Refused if there is nothing to write, BadInput on an unknown joint."""
    _check_names(arm, how)
    store.add(record.require(arm))
    if all(joint.offset is None for joint in record.joints):
        raise Refused("--apply: no joint has a gain or an offset, so nothing is written")


def _check_names(arm: ArmFile, how: Apply) -> None:
    for option, joints in (("--replaced", how.replaced), ("--accept", how.accepted)):
        for unknown in sorted(set(joints) - set(arm.joint_names)):
            raise BadInput(f"{option} {unknown}: there is no such joint; the arm has {', '.join(arm.joint_names)}")


def _write(
    gate: Callable[[ArmDriver], Admitted],
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    beta: Array | None,
    how: Apply,
    reason: str,
) -> tuple[str, ...]:
    exchanged = f"; sensor exchanged: {', '.join(how.replaced)}" if how.replaced else ""
    with open_arm(arm, how.bus) as link:
        link.start()
        recover(arm, store, link)
        admitted = gate(link)
        motion = CheckMotion(link, arm, record, beta) if how.check else None
        if motion is not None:
            link.enable()
            motion.before()
        check = None if motion is None else motion.after
        return install(admitted, store, link, by=how.by, reason=reason + exchanged, check=check, flash=how.flash)
