"""Writing a record to the controllers: noted first, each pair read back, checked, made current; else put back.

In this order, so that a process killed at any moment leaves either the old record in force or the new one, and a
journal that says what the controllers held: the record is kept, the journal line is on disk, each controller's pair is
staged, read back bit for bit and made active (`armlink.link.torque_sensor_record`), the check is made, flash is
written if that was asked for, the record becomes current and the journal line ends, both in one transaction.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import Calibration
from calib.records.records import CalibrationRecord
from calib.records.store import ControllerWrite, RecordStore

SAME_REAL32 = 1e-6
"""Relative difference that REAL32 in the controller may make to a value of a record."""


class Controllers(Protocol):
    """What writing needs of the link (`armlink.link.link.Link`)."""

    def read_calibration(self, joint: int) -> Calibration:
        """Active gain and offset [N·m] of joint j."""
        ...

    def write_calibration(
        self, joint: int, gain: float, offset: float, record_id: int, date: int = 0, store: bool = False
    ) -> Calibration:
        """Stage, read back and make active gain and offset [N·m] of a joint, then store to flash; raises BusFault."""
        ...


Check = Callable[[], str | None]
"""Made once the new pairs are active: what is worse with them than before, None where nothing is."""


def install(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    controllers: Controllers,
    *,
    by: str,
    reason: str,
    joints: Sequence[int] | None = None,
    check: Check | None = None,
    flash: bool = False,
) -> tuple[str, ...]:
    """Write a record's gains and offsets to its controllers and make it current; returns the joints written.

    `joints` (default: all) are those that are written; a value that is not identifiable stays what the controller
    holds. An earlier write that was killed half-way is undone first. Raises Refused where the check finds the arm
    worse or the record is of another arm, BusFault, BadInput; the controllers then hold what they held before, or, if
    even that fails, the next `install` or `mend` puts it back.
    """
    mend(arm, store, controllers)
    store.add(record.require(arm))
    chosen = range(len(record.joints)) if joints is None else joints
    before = {j: controllers.read_calibration(j) for j in chosen}
    line = store.begin_write(record.id, arm, by, [_kept(record.joints[j].name, j, before[j]) for j in chosen])
    stored = False
    try:
        _write(record, controllers, before, flash=False)
        complaint = check() if check is not None else None
        if complaint:
            raise Refused(f"record {record.id}: {complaint}: the controllers hold the old pairs again")
        if flash:
            stored = True
            _write(record, controllers, before, flash=True)
        store.activate(record.id, arm, by, reason, finishes=line)
    except BaseException as error:
        _put_back(controllers, line, store=stored)
        store.undo_write(line, arm, f"{type(error).__name__}: {error}".strip(": ").partition("\n")[0])
        raise
    return tuple(record.joints[j].name for j in chosen)


def mend(arm: ArmFile, store: RecordStore, controllers: Controllers) -> ControllerWrite | None:
    """Undo the last write to this arm's controllers if it was begun and never ended; returns it, None if all is well.

    A controller that holds what it held before, or what that write brought, gets the old pair; one that somebody has
    given another pair since is left as it is. Raises BusFault.
    """
    line = store.unfinished_write(arm)
    if line is None:
        return None
    record = store.get(line.record)
    assert isinstance(record, CalibrationRecord)
    strangers = []
    for entry in line.body["before"]:
        j, held = int(entry["joint"]), controllers.read_calibration(int(entry["joint"]))
        old = (entry["gain"], entry["offset"])
        if _same(held, old) or _same(held, _pair(record, j, *old)):
            _restore(controllers, entry, store=False)
        else:
            strangers.append(str(entry["name"]))
    left = f"; {', '.join(strangers)} held another pair since, left as it is" if strangers else ""
    store.undo_write(line, arm, f"was cut off before it ended{left}")
    return line


def _write(record: CalibrationRecord, controllers: Controllers, before: dict[int, Calibration], flash: bool) -> None:
    date = int(record.created.timestamp())
    for j, held in before.items():
        gain, offset = _pair(record, j, held.gain, held.offset)
        controllers.write_calibration(j, gain, offset, record.number, date=date, store=flash)


def _pair(record: CalibrationRecord, j: int, gain: float, offset: float) -> tuple[float, float]:
    """Gain and offset [N·m] of joint j, what is held where the record has none."""
    joint = record.joints[j]
    return (gain if joint.gain is None else joint.gain, offset if joint.offset is None else joint.offset)


def _put_back(controllers: Controllers, line: ControllerWrite, store: bool) -> None:
    for entry in line.body["before"]:
        _restore(controllers, entry, store)


def _restore(controllers: Controllers, entry: dict[str, Any], store: bool) -> None:
    held = (float(entry["gain"]), float(entry["offset"]), int(entry["record_id"]))
    controllers.write_calibration(int(entry["joint"]), *held, date=int(entry["date"]), store=store)


def _kept(name: str, joint: int, held: Calibration) -> dict[str, Any]:
    content = {key: getattr(held, key) for key in ("gain", "offset", "record_id", "date")}
    return {"joint": joint, "name": name, **content}


def _same(held: Calibration, pair: tuple[float, float]) -> bool:
    return all(same_real32(found, wanted) for found, wanted in zip((held.gain, held.offset), pair, strict=True))


def same_real32(found: float, wanted: float) -> bool:
    """Whether a value read from a controller is the one written, as REAL32 keeps it."""
    return abs(found - wanted) <= SAME_REAL32 * max(1.0, abs(wanted))
