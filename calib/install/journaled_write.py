"""The one door to the joint controllers: every write of a calibration goes through `install`.

The drives must be those of the record's arm. Then in this order, so that a process killed at any moment leaves either
the old record in force or the new one, and a journal of what the controllers held: the gates were passed (`Admitted`),
the record is kept, the journal line is on disk, each controller's calibration is staged, read back bit for bit and made
active, the check is made, flash is written if that was asked for, the record becomes current and the journal line ends,
both in one transaction. If any step fails, every controller gets back what it held.

Records are kept under an arm's name and serial number, as its arm file has them. Two arms whose files have no serial
number, or the same, would get each other's calibrations; what gives them away are the serial numbers of their drives,
which a sweep notes in its records and every write in the journal.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from armlink.arm_file import ArmFile
from armlink.errors import BusFault, Refused
from armlink.link.types import Calibration, Controllers, DriveSerial
from calib.install.plausibility import Admitted
from calib.records.bounds import require_sound
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
            f"({there[0]} …). Another arm has the same name and serial, so nothing was written: give "
            f"each arm its own serial in its arm file ({arm.path.name}) and calibrate it"
        )


Check = Callable[[], str | None]
"""Called once the new calibration is active: a complaint if something is worse than before, else None."""


def install(
    admitted: Admitted,
    store: RecordStore,
    controllers: Controllers,
    *,
    by: str,
    reason: str,
    check: Check | None,
    joints: Sequence[int] | None = None,
    flash: bool = False,
) -> tuple[str, ...]:
    """Write an admitted record's gains and offsets to its controllers and make it current; returns the joints written.

    `joints` (default: all) are those that are written; a value that is not identifiable stays what the controller
    holds. `check` is None if the caller checks later, or does without. An earlier write that was cut off is undone
    first. Raises Refused if the arm on the bus may be another one or the check fails, BusFault, BadInput; the
    controllers then hold what they held before, or, if even that fails, the next `install` or `recover` puts it back.
    """
    record, arm = admitted.record, admitted.arm
    drives = require_own_arm(record, arm, store, _drives(controllers, record))
    recover(arm, store, controllers)
    store.add(require_sound(record.require(arm), arm, datetime.now(UTC)))
    chosen = range(len(record.joints)) if joints is None else joints
    before = {j: controllers.read_calibration(j) for j in chosen}
    entries = [_entry(record.joints[j].name, j, before[j]) for j in chosen]
    line = store.begin_write(record.id, arm, by, entries, reason=reason, gates=admitted.gates, drives=drives)
    stored = False
    try:
        _write(record, controllers, before)
        complaint = check() if check is not None else None
        if complaint:
            raise Refused(f"record {record.id}: {complaint}: the old calibration was written back to the drives")
        if flash:
            stored = True
            _write(record, controllers, before, flash=True)
        store.finish_write(line, arm)
    except BaseException as error:
        for entry in line.body["before"]:
            _restore(controllers, entry, stored)
        store.undo_write(line, arm, f"{type(error).__name__}: {error}".strip(": ").partition("\n")[0])
        raise
    return tuple(record.joints[j].name for j in chosen)


def recover(arm: ArmFile, store: RecordStore, controllers: Controllers) -> ControllerWrite | None:
    """Undo the last write to this arm's controllers if it was begun and never ended; returns it, None if all is well.

    A controller that holds what it held before, or what that write brought, gets the old calibration; one that was
    given another one since is left as it is. Raises Refused where it was begun on another arm, BusFault.
    """
    line = store.unfinished_write(arm)
    if line is None:
        return None
    record = store.get(line.record)
    assert isinstance(record, CalibrationRecord)
    require_drives_of(line, arm, _drives(controllers, record))
    strangers = []
    for entry in line.body["before"]:
        held, old = controllers.read_calibration(int(entry["joint"])), _calibration(entry)
        if old.matches(held) or record.joints[int(entry["joint"])].torque_calibration(old).matches(held):
            _restore(controllers, entry, store=False)
        else:
            strangers.append(str(entry["name"]))
    left = f"; {', '.join(strangers)} got another calibration since then, which was not changed" if strangers else ""
    store.undo_write(line, arm, f"the write was cut off before it ended{left}")
    return line


def _drives(controllers: Controllers, record: CalibrationRecord) -> list[DriveSerial]:
    return [controllers.drive_serial(joint) for joint in range(len(record.joints))]


def _write(
    record: CalibrationRecord, controllers: Controllers, before: Mapping[int, Calibration], flash: bool = False
) -> None:
    date = int(record.created.timestamp())
    for j, held in before.items():
        wanted = record.joints[j].torque_calibration(held)
        now = controllers.write_calibration(j, Calibration(wanted.gain, wanted.offset, record.number, date), flash)
        if not wanted.matches(now):
            raise BusFault(
                f"{record.joints[j].name}: its drive holds gain {now.gain:.6g} and offset {now.offset:.6g} "
                f"N·m, although gain {wanted.gain:.6g} and offset {wanted.offset:.6g} N·m were written"
            )


def _restore(controllers: Controllers, entry: dict[str, Any], store: bool) -> None:
    controllers.write_calibration(int(entry["joint"]), _calibration(entry), store)


def _entry(name: str, joint: int, held: Calibration) -> dict[str, Any]:
    """A controller's calibration as the journal keeps it."""
    content = asdict(held)
    return {"joint": joint, "name": name, **{key: content[key] for key in ("gain", "offset", "record_id", "date")}}


def _calibration(entry: dict[str, Any]) -> Calibration:
    """A controller's calibration from the journal."""
    return Calibration(float(entry["gain"]), float(entry["offset"]), int(entry["record_id"]), int(entry["date"]))
