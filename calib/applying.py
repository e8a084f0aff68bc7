"""`armlink calibrate --apply`: gates, the check motion before, the write, the check motion after."""

from collections.abc import Sequence
from dataclasses import dataclass

from armlink.armfile import ArmFile
from armlink.errors import Refused
from armlink.link import Link
from calib.check_motion import CheckMotion
from calib.dataset import SweepData
from calib.gates import check_gates
from calib.records import Array, CalibrationRecord
from calib.store import RecordStore
from calib.writing import install, mend


@dataclass(frozen=True)
class Apply:
    """How a record from sweeps goes to the controllers."""

    by: str
    """Who ordered it."""
    bus: str | None = None
    """INTERFACE:CHANNEL[@BITRATE]; None is the arm file's."""
    replaced: Sequence[str] = ()
    """Joints whose sensor was exchanged: their change is not judged by their history."""
    check: bool = True
    """Make the check motion before and after."""
    flash: bool = False
    """Also store to flash."""


def apply_calibration(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    data: Sequence[SweepData],
    beta: Array | None,
    how: Apply,
) -> tuple[str, ...]:
    """Write a record that was fitted to `data` to the controllers and make it current; returns the joints written.

    `beta` (2n,) [kg·m] is the gravity model that the check motion is judged by. The record is kept in any case. Raises
    Refused where a gate or the check says no, BusFault; the controllers then hold what they held.
    """
    store.add(record.require(arm))
    if all(joint.offset is None for joint in record.joints):
        raise Refused("--apply: no joint has a gain or an offset, so nothing is written")
    unknown = sorted(set(how.replaced) - set(arm.joint_names))
    if unknown:
        raise Refused(f"--replaced {unknown[0]}: no such joint; the arm has {', '.join(arm.joint_names)}")
    check_gates(record, arm, store, data, how.replaced)
    with Link.open(arm, how.bus) as link:
        link.start()
        mend(arm, store, link)
        motion = CheckMotion(link, arm, record, beta) if how.check else None
        if motion is not None:
            link.enable()
            motion.before()
        after = None if motion is None else motion.after
        return install(record, arm, store, link, by=how.by, reason=_reason(how), check=after, flash=how.flash)


def _reason(how: Apply) -> str:
    exchanged = f"; sensor exchanged: {', '.join(how.replaced)}" if how.replaced else ""
    return f"sweeps{exchanged}"
