"""Whether the arm on the bus is the one that a record is of: by its serial number, and by those of its drives.

Records are kept under an arm's name and serial number, as its arm file has them. Two arms whose files have no serial
number, or the same, would get each other's calibrations; what gives them away are the serial numbers of their drives,
which a sweep notes in its records and every write in the journal.
"""

from collections.abc import Sequence

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import DriveSerial
from calib.records.records import CalibrationRecord
from calib.records.store import ControllerWrite, RecordStore


def require_own_arm(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, found: Sequence[DriveSerial]
) -> tuple[str, ...]:
    """Raise Refused unless these drives are of the arm whose record this is; returns their serial numbers.

    An arm without a serial number is nobody's own, unless it is simulated in this process and ends with it.
    """
    if not arm.has_serial and not all(drive.simulated for drive in found):
        raise Refused(
            f"{arm.name}: its serial is {arm.serial}, so the calibration may belong to another arm of this "
            f"name, and nothing is written to its drives: give this arm a serial in {arm.path.name} "
            "(`serial: …`), then calibrate again from its sweeps"
        )
    drives = tuple(drive.number for drive in found)
    _require_shared(arm, drives, record.drives, f"on which record {record.id} was measured")
    last = store.last_write(arm)
    if last is not None:
        _require_shared(
            arm, drives, drives_written(last), f"to which record {last.record} was written on {last.at[:10]}"
        )
    return drives


def require_drives_of(line: ControllerWrite, arm: ArmFile, found: Sequence[DriveSerial]) -> None:
    """Raise Refused where a write that is to be undone was begun on the drives of another arm."""
    drives = [drive.number for drive in found]
    _require_shared(arm, drives, drives_written(line), f"of the unfinished write of {line.at[:10]}")


def drives_written(line: ControllerWrite) -> tuple[str, ...]:
    """Serial numbers of the drives that a write was begun on; none in a journal of before they were noted."""
    return tuple(str(each) for each in line.body.get("drives", ()))


def _require_shared(arm: ArmFile, drives: Sequence[str], known: Sequence[str], what: str) -> None:
    """Drives are exchanged one by one: an arm that has none of them any more is another one."""
    here, there = sorted({*drives} - {""}), sorted({*known} - {""})
    if here and there and not {*here} & {*there}:
        raise Refused(
            f"{arm.name} {arm.serial}: none of its drives ({here[0]} …) is one of the drives {what} "
            f"({there[0]} …), so another arm has the same name and serial, and nothing was written: give "
            f"each arm a serial of its own in its arm file ({arm.path.name}) and calibrate it"
        )
