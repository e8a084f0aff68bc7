"""The record store: append-only, SQLite by default or PostgreSQL by URL; the last activation says what is current."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from armlink.arm_file import ArmFile, read_yaml
from armlink.errors import BadInput, Refused
from armlink.torque_calibration import Calibration
from calib.records.bounds import require_sound
from calib.records.database import (
    ACTIVATIONS,
    RECORDS,
    WRITES,
    StoreFault,
    default_url,
    first_line,
    open_database,
    reading,
    transaction,
)
from calib.records.records import CalibrationRecord, GravityRecord, digest_id, parse_record

R = TypeVar("R", CalibrationRecord, GravityRecord)
AnyRecord = CalibrationRecord | GravityRecord
BLANK = Calibration(1.0, 0.0)


@dataclass(frozen=True)
class Activation:
    """One line of the activation log: from `at` (ISO 8601) on, `record` was the current one of its kind."""

    number: int
    record: str
    kind: str
    at: str
    by: str
    reason: str


@dataclass(frozen=True)
class ControllerWrite:
    """One line of the journal of writes to controllers: `begun`, later `finished` or `undone`."""

    number: int
    record: str
    at: str
    by: str
    stage: str
    body: dict[str, Any]
    """begun: `before` (what each controller held), `reason`, `gates`, `drives`; undone: `reason`."""


class RecordStore:
    """Records, and the log of which was current when. Nothing is changed or deleted; a roll-back is an append too."""

    def __init__(self, url: str | None = None) -> None:
        """Open, or create, the store at an SQLAlchemy URL or a file path; raises BadInput if that fails."""
        self._engine = open_database(url or default_url())
        self.url = self._engine.url.render_as_string(hide_password=True)

    def close(self) -> None:
        self._engine.dispose()

    def add(self, record: AnyRecord) -> str:
        """Append a record and return its id; adding the same record again changes nothing. Raises Refused."""
        row = {name: getattr(record, name) for name in ("id", "kind", "arm", "serial")}
        row |= {"created": record.created.isoformat(), "body": record.model_dump_json()}
        with transaction(self._engine) as connection:
            known = connection.execute(sa.select(RECORDS.c.body).where(RECORDS.c.id == record.id)).scalar()
            if known is None:
                connection.execute(RECORDS.insert().values(row))
            elif known != row["body"]:
                raise Refused(f"record {record.id}: another record has this id already; repeat the command")
        return record.id

    def get(self, record_id: str) -> AnyRecord:
        """The record of that id; raises Refused if there is none."""
        with reading(self._engine) as connection:
            body = connection.execute(sa.select(RECORDS.c.body).where(RECORDS.c.id == record_id)).scalar()
        if body is None:
            raise Refused(f"there is no record {record_id} in {self.url}; `history` lists the records of an arm")
        return self._record(record_id, body)

    def usable(self, record_id: str, arm: ArmFile, now: datetime | None = None) -> AnyRecord:
        """The record of that id, to be used on this arm; raises Refused if it is of another, or of no working one.

        `now`, when it becomes current, as for `require_sound`.
        """
        return require_sound(self.get(record_id).require(arm), arm, now)

    def activate(self, record_id: str, arm: ArmFile, by: str, reason: str) -> None:
        """Make a kept record the current one of its kind; raises Refused if it is of another arm, or not sound."""
        record = self.usable(record_id, arm, datetime.now(UTC))
        with transaction(self._engine) as connection:
            _activate(connection, record, arm, by, reason)

    def put(self, record: AnyRecord, arm: ArmFile, by: str, reason: str) -> str:
        """Append a record and make it current; returns its id. One that is not sound is kept, and Refused raised."""
        self.add(record.require(arm))
        self.activate(record.id, arm, by, reason)
        return record.id

    def former(self, arm: ArmFile, record_id: str) -> AnyRecord:
        """A record that was current before and is not now; raises Refused if there is none, or it is of another arm."""
        record = self.usable(record_id, arm)
        log = [line.record for line in self.activations(arm) if line.kind == record.kind]
        if record_id not in log:
            raise Refused(
                f"record {record_id} was never current on {arm.name} {arm.serial}, so it cannot become current again"
            )
        if log[-1] == record_id:
            raise Refused(f"record {record_id} is current on {arm.name} {arm.serial} already")
        return record

    def rollback(self, arm: ArmFile, to: str, by: str, reason: str = "rollback") -> None:
        """Return to a record that was current before; raises Refused if it never was, or is now."""
        self.activate(self.former(arm, to).id, arm, by, reason)

    def current(self, kind: type[R], arm: ArmFile) -> R | None:
        """The current record of a kind; None if there is none yet.

        Raises Refused if it is of another description of this arm (a changed arm needs a new calibration), or if a
        number in it can be of no working arm.
        """
        found = self._current_id(kind.model_fields["kind"].default, arm)
        if found is None:
            return None
        record = self.usable(found, arm)
        assert isinstance(record, kind)
        return record

    def required(self, kind: type[R], arm: ArmFile) -> R:
        """The current record of a kind; raises Refused as `current` does, and where there is none yet."""
        found = self.current(kind, arm)
        if found is None:
            raise no_record(arm, kind.model_fields["kind"].default)
        return found

    def _record(self, record_id: str, body: str) -> AnyRecord:
        """The record of a row; raises StoreFault where the row is not what was stored under its id."""
        if digest_id(body) != record_id:
            raise StoreFault(
                f"record store {self.url}: the content of record {record_id} was changed: restore the store from a copy"
            )
        return parse_record(self._parsed(body), f"record {record_id}")

    def _parsed(self, body: str) -> Any:
        """The JSON of a row; raises StoreFault where it is damaged."""
        try:
            return json.loads(body)
        except (ValueError, RecursionError, TypeError):
            raise StoreFault(f"record store {self.url}: a row is damaged: restore the store from a copy") from None

    def _current_id(self, kind: str, arm: ArmFile) -> str | None:
        log = [line.record for line in self.activations(arm) if line.kind == kind]
        return log[-1] if log else None

    def activations(self, arm: ArmFile) -> list[Activation]:
        log = ACTIVATIONS.c
        wanted = sa.select(log.number, log.record, log.kind, log.at, log.by, log.reason)
        wanted = wanted.where(log.arm == arm.name, log.serial == arm.serial).order_by(log.number)
        with reading(self._engine) as connection:
            return [Activation(*row) for row in connection.execute(wanted)]

    def history(self, arm: ArmFile) -> list[AnyRecord]:
        """All records of this arm (name and serial), oldest first, of any description."""
        rows = RECORDS.c
        wanted = sa.select(rows.id, rows.body).where(rows.arm == arm.name, rows.serial == arm.serial)
        with reading(self._engine) as connection:
            found = connection.execute(wanted.order_by(rows.created, rows.id)).all()
        return [self._record(*row) for row in found]

    def begin_write(
        self,
        record_id: str,
        arm: ArmFile,
        by: str,
        before: Sequence[dict[str, Any]],
        *,
        reason: str,
        gates: str,
        drives: Sequence[str] = (),
    ) -> ControllerWrite:
        """Note what each controller holds, before any is written: from that an interrupted write is undone.

        `drives`: serial numbers of the arm's drives, joint by joint; empty for one that tells none.
        """
        body = {"before": list(before), "reason": reason, "gates": gates, "drives": list(drives)}
        line = ControllerWrite(0, record_id, _now(), by, "begun", body)
        with transaction(self._engine) as connection:
            row = _write_row(line, arm, record_id, line.stage, line.body)
            number = connection.execute(WRITES.insert().values(row).returning(WRITES.c.number)).scalar_one()
        return replace(line, number=number)

    def finish_write(self, line: ControllerWrite, arm: ArmFile) -> None:
        """End a write that succeeded and make its record current, unless it is already; both or neither."""
        record, current = self.get(line.record), self._current_id("calibration", arm)
        with transaction(self._engine) as connection:
            if record.id != current:
                _activate(connection, record, arm, line.by, str(line.body["reason"]))
            connection.execute(WRITES.insert().values(_write_row(line, arm, record.id, "finished", {})))

    def last_write(self, arm: ArmFile) -> ControllerWrite | None:
        """Line `begun` of the newest write to this arm's controllers that succeeded; None if there is none."""
        begun: ControllerWrite | None = None
        last: ControllerWrite | None = None
        for line in self.writes(arm):
            if line.stage == "begun":
                begun = line
            elif line.stage == "finished":
                last = begun
        return last

    def undo_write(self, line: ControllerWrite, arm: ArmFile, reason: str) -> None:
        """Note that the controllers hold the calibrations from before that write again.

        A store that was exchanged for another since knows nothing of that write, and gets no line.
        """
        with transaction(self._engine) as connection:
            begun = sa.select(WRITES.c.record).where(WRITES.c.number == line.number)
            if connection.execute(begun).scalar() == line.record:
                row = _write_row(line, arm, line.record, "undone", {"reason": reason})
                connection.execute(WRITES.insert().values(row))

    def unfinished_write(self, arm: ArmFile) -> ControllerWrite | None:
        """The write to this arm's controllers that was begun but not ended, as after a power loss; None if none is."""
        log = self.writes(arm)
        return log[-1] if log and log[-1].stage == "begun" else None

    def writes(self, arm: ArmFile) -> list[ControllerWrite]:
        log = WRITES.c
        wanted = sa.select(log.number, log.record, log.at, log.by, log.stage, log.body)
        wanted = wanted.where(log.arm == arm.name, log.serial == arm.serial).order_by(log.number)
        with reading(self._engine) as connection:
            return [ControllerWrite(*row[:5], self._parsed(row[5])) for row in connection.execute(wanted)]

    def import_yaml(self, path: Path, arm: ArmFile) -> str:
        """Append the record of a YAML file (as `ArmRecord.to_yaml` wrote it), not making it current; returns its id.

        Raises BadInput if the file is no record or was changed, Refused if it is of another arm or not sound.
        """
        return self.add(require_sound(load_yaml(path).require(arm), arm, datetime.now(UTC)))


def load_yaml(path: Path) -> AnyRecord:
    """The record of a YAML file (as `ArmRecord.to_yaml` wrote it); raises BadInput if it is none or was changed."""
    try:
        content = read_yaml(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read as YAML: {first_line(error)}") from None
    return parse_record(content, str(path))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _activate(connection: sa.Connection, record: AnyRecord, arm: ArmFile, by: str, reason: str) -> None:
    row = {"record": record.id, "kind": record.kind, "arm": arm.name, "serial": arm.serial, "by": by}
    row |= {"reason": reason, "at": _now()}
    connection.execute(ACTIVATIONS.insert().values(row))


def _write_row(line: ControllerWrite, arm: ArmFile, record: str, stage: str, body: dict[str, Any]) -> dict[str, Any]:
    row = {"record": record, "arm": arm.name, "serial": arm.serial, "at": _now(), "by": line.by, "stage": stage}
    return row | {"body": json.dumps(body)}


MAKERS = {"calibration": "calibrate", "gravity": "identify"}
"""Kind of record → the command that makes it from sweeps."""


def no_record(arm: ArmFile, kind: str) -> Refused:
    """The refusal of work that needs a record of the `kind`, with the commands that lead to one."""
    return Refused(f"{arm.name} {arm.serial}: there is no {kind} record yet: {way_to(arm, kind)}")


def way_to(arm: ArmFile, *kinds: str, listen_only: bool = False) -> str:
    """The commands that make records of these kinds, from the first; where this program only listens, who may."""
    made = " and ".join(MAKERS[kind] for kind in kinds)
    way = f"sweep the arm, then {made}: armlink sweep {arm.argument} --out unloaded"
    if listen_only:
        return f"give the store that has them as `--store`, or stop the program that commands the arm, then {way}"
    return way


def calibrations_in_force(arm: ArmFile) -> tuple[Calibration | None, ...]:
    """Gain and offset of each joint by the arm's current calibration record in the default store; None without one.

    For the drives that keep none themselves (entry point `armlink.calibrations`). A value that the record does not
    identify counts as 1 or 0. Raises Refused if the record is of another description of the arm.
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
