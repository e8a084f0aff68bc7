"""Gates, check motion, write, check motion; for records from sweeps, creeps, slow motion and from earlier."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.loop.open import ArmDriver, open_arm
from calib.install.check_motion import CheckMotion
from calib.install.journaled_write import install, recover
from calib.install.plausibility import Admitted, GateRefused, Refusal, admit, admit_rollback, check_held_out
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore
from gcomp.arrays import Array


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


def apply_record(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    how: Apply,
    beta: Array | None,
    reason: str,
    broken: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Write a record that was fitted to readings to the controllers and make it current; returns the joints written.

    It carries the proof of held-out data where it replaces another one. `beta` (2n,) [kg·m] judges the check motion;
    None: no gravity model. `broken` says of joints why the sensor model does not hold there. The record is kept in any
    case. Raises Refused if a gate or the check refuses, BusFault; the controllers then hold what they held before.
    """
    _keep(record, arm, store, how)
    admitted = admit_fitted(record, arm, store, how, broken or {})
    return _write(lambda link: admitted, record, arm, store, beta, how, reason)


def apply_creep(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    how: Apply,
    broken: Mapping[str, str],
    check: Callable[[ArmDriver], str | None] | None,
) -> None:
    """Make a record current that was fitted to creep sweeps; the host keeps it. The record is kept in any case.

    With `how.check`, `check` moves the enabled arm and complains if it does not agree with the record; None: no gain to
    check. `broken` says of joints why the model does not hold there. Raises Refused, BusFault.
    """
    _keep(record, arm, store, how)
    _check_holds(broken, how)
    admit(record, arm, store, how.replaced)
    if how.check and check is not None:
        with open_arm(arm, how.bus) as link:
            link.start()
            link.enable()
            complaint = check(link)
        if complaint is not None:
            raise Refused(f"{complaint}; record {record.id} is kept, and not made current")
    store.activate(record.id, arm, how.by, "creep sweeps")


def apply_rollback(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, how: Apply, reason: str
) -> tuple[str, ...]:
    """Write an earlier record to the controllers and make it current again; returns the joints written.

    Its only gate is the distance from what the controllers hold. Raises Refused, BusFault.
    """
    gravity = store.current(GravityRecord, arm)
    beta = None if gravity is None else np.array(gravity.carrying(arm).beta)

    def gate(link: ArmDriver) -> Admitted:
        held = {joint: link.read_calibration(joint) for joint in range(link.n)}
        return admit_rollback(record, arm, store, held, how.replaced)

    _check_names(arm, how)
    return _write(gate, record, arm, store, beta, how, reason)


def admit_fitted(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, how: Apply, broken: Mapping[str, str]
) -> Admitted:
    """The gates of a fitted record: the model holds, bounds, change, held-out data; raises Refused."""
    _check_holds(broken, how)
    admitted = admit(record, arm, store, how.replaced)
    if admitted.before is not None:
        check_held_out(record, admitted.before)
    return admitted


def _check_holds(broken: Mapping[str, str], how: Apply) -> None:
    """Raise GateRefused if the model does not hold on a joint that was not accepted so."""
    for joint, why in broken.items():
        if joint not in how.accepted:
            raise GateRefused(Refusal.MODEL, joint, why=why.removeprefix(f"{joint}: ").rstrip("."))


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
