"""Calibrations in force by record, for the drives that keep none themselves (entry point `armlink.calibrations`)."""

from armlink.arm_file import ArmFile
from armlink.torque_calibration import Calibration
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore

BLANK = Calibration(1.0, 0.0)


def calibrations_in_force(arm: ArmFile) -> tuple[Calibration | None, ...]:
    """Gain and offset of each joint by the arm's current calibration record in the default store; None without one.

    A value that the record does not identify counts as 1 or 0. Raises Refused if the record is of another description
    of the arm.
    """
    store = RecordStore()
    try:
        record = store.current(CalibrationRecord, arm)
    finally:
        store.close()
    if record is None:
        return (None,) * len(arm.require_link().joints)
    date, found = int(record.created.timestamp()), []
    for joint in record.joints:
        values = joint.torque_calibration(BLANK)
        found.append(Calibration(values.gain, values.offset, record.number, date))
    return tuple(found)
