"""The record store: append-only, on SQLite by default or PostgreSQL by URL; what is current is the last activation."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
import yaml

from armlink.armfile import ArmFile
from armlink.errors import BadInput, Refused
from calib.records import CalibrationRecord, GravityRecord, Record, parse_record

R = TypeVar("R", CalibrationRecord, GravityRecord)
AnyRecord = CalibrationRecord | GravityRecord

_TABLES = sa.MetaData()
_RECORDS = sa.Table(
    "records",
    _TABLES,
    sa.Column("id", sa.String(8), primary_key=True),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("arm", sa.String, nullable=False),
    sa.Column("serial", sa.String, nullable=False),
    sa.Column("created", sa.String, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
)
_ACTIVATIONS = sa.Table(
    "activations",
    _TABLES,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("arm", sa.String, nullable=False),
    sa.Column("serial", sa.String, nullable=False),
    sa.Column("at", sa.String, nullable=False),
    sa.Column("by", sa.String, nullable=False),
    sa.Column("reason", sa.String, nullable=False),
)
for _table in (_RECORDS, _ACTIVATIONS):  # SQLite itself refuses what an append-only store never does
    for _change in ("UPDATE", "DELETE"):
        _statement = (
            f"CREATE TRIGGER IF NOT EXISTS {_table.name}_no_{_change.lower()} BEFORE {_change} ON {_table.name} "
            f"BEGIN SELECT RAISE(ABORT, '{_table.name} is append-only'); END"
        )
        sa.event.listen(_table, "after_create", sa.DDL(_statement).execute_if(dialect="sqlite"))  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class Activation:
    """One line of the activation log: from `at` (ISO 8601) on, `record` was the current one of its kind."""

    number: int
    record: str
    kind: str
    at: str
    by: str
    reason: str


def default_url() -> str:
    """URL of the store in the user's state directory (XDG_STATE_HOME, else ~/.local/state)."""
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return f"sqlite:///{state / 'armlink' / 'records.db'}"


class RecordStore:
    """Records, and the log of which was current when. Nothing is changed or deleted; going back is an append too."""

    def __init__(self, url: str | None = None) -> None:
        """Open, and make where missing, the store at an SQLAlchemy URL or a file path; raises BadInput if it cannot."""
        full = _full_url(url or default_url())
        try:
            self._engine = sa.create_engine(full)
            self.url = self._engine.url.render_as_string(hide_password=True)
            if self._engine.dialect.name == "sqlite":
                _prepare_sqlite(self._engine)
            _TABLES.create_all(self._engine)
        except (sa.exc.SQLAlchemyError, ImportError, OSError) as error:
            raise BadInput(f"record store {full}: cannot be opened: {_first_line(error)}") from None

    def close(self) -> None:
        """Let go of the database."""
        self._engine.dispose()

    def add(self, record: AnyRecord) -> str:
        """Append a record and return its id; adding the same record again changes nothing. Raises Refused."""
        row = {name: getattr(record, name) for name in ("id", "kind", "arm", "serial")}
        row |= {"created": record.created.isoformat(), "body": record.model_dump_json()}
        with self._write() as connection:
            known = connection.execute(sa.select(_RECORDS.c.body).where(_RECORDS.c.id == record.id)).scalar()
            if known is None:
                connection.execute(_RECORDS.insert().values(row))
            elif known != row["body"]:
                raise Refused(f"record {record.id}: another record has this id already; make it again")
        return record.id

    def get(self, record_id: str) -> AnyRecord:
        """The record of that id; raises Refused where there is none."""
        with self._engine.connect() as connection:
            body = connection.execute(sa.select(_RECORDS.c.body).where(_RECORDS.c.id == record_id)).scalar()
        if body is None:
            raise Refused(f"no record {record_id} in {self.url}; armlink history ARM lists those that there are")
        return parse_record(json.loads(body), f"record {record_id}")

    def activate(self, record_id: str, arm: ArmFile, by: str, reason: str) -> Activation:
        """Make a kept record the current one of its kind; raises Refused if it is of another arm."""
        record = self.get(record_id).require(arm)
        row = {"record": record.id, "kind": record.kind, "arm": arm.name, "serial": arm.serial, "by": by}
        row |= {"reason": reason, "at": datetime.now(UTC).isoformat(timespec="seconds")}
        with self._write() as connection:
            connection.execute(_ACTIVATIONS.insert().values(row))
        return self.activations(arm)[-1]

    def put(self, record: AnyRecord, arm: ArmFile, by: str, reason: str) -> str:
        """Append a record and make it current; returns its id."""
        self.add(record.require(arm))
        return self.activate(record.id, arm, by, reason).record

    def former(self, arm: ArmFile, record_id: str) -> AnyRecord:
        """A record that was current before and is not now; raises Refused if it never was, or is of another arm."""
        record = self.get(record_id).require(arm)
        log = [line.record for line in self.activations(arm) if line.kind == record.kind]
        if record_id not in log:
            raise Refused(f"record {record_id} was never current on {arm.name} {arm.serial}: nothing to go back to")
        if log[-1] == record_id:
            raise Refused(f"record {record_id} is current on {arm.name} {arm.serial} already")
        return record

    def rollback(self, arm: ArmFile, to: str, by: str, reason: str = "rollback") -> Activation:
        """Go back to a record that was current before; raises Refused if it never was, or is now."""
        return self.activate(self.former(arm, to).id, arm, by, reason)

    def current(self, kind: type[R], arm: ArmFile) -> R | None:
        """The current record of a kind, None where there is none yet.

        Raises Refused where it is of another description of this arm: a changed arm needs a new calibration.
        """
        wanted = kind.model_fields["kind"].default
        log = [line for line in self.activations(arm) if line.kind == wanted]
        if not log:
            return None
        record = self.get(log[-1].record).require(arm)
        assert isinstance(record, kind)
        return record

    def activations(self, arm: ArmFile) -> list[Activation]:
        """The activation log of this arm (name and serial), oldest first."""
        log = _ACTIVATIONS.c
        wanted = sa.select(log.number, log.record, log.kind, log.at, log.by, log.reason)
        wanted = wanted.where(log.arm == arm.name, log.serial == arm.serial).order_by(log.number)
        with self._engine.connect() as connection:
            return [Activation(*row) for row in connection.execute(wanted)]

    def history(self, arm: ArmFile) -> list[AnyRecord]:
        """All records of this arm (name and serial), oldest first, of whatever description."""
        rows = _RECORDS.c
        wanted = sa.select(rows.id, rows.body).where(rows.arm == arm.name, rows.serial == arm.serial)
        with self._engine.connect() as connection:
            found = connection.execute(wanted.order_by(rows.created, rows.id)).all()
        return [parse_record(json.loads(body), f"record {record_id}") for record_id, body in found]

    def import_yaml(self, path: Path, arm: ArmFile) -> str:
        """Append the record of a YAML file (as `Record.to_yaml` wrote it), not making it current; returns its id.

        Raises BadInput where the file is no record or was changed, Refused where it is of another arm.
        """
        try:
            content: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise BadInput(f"{path}: cannot be read as YAML: {_first_line(error)}") from None
        return self.add(parse_record(content, str(path)).require(arm))

    @contextmanager
    def _write(self) -> Iterator[sa.Connection]:
        """One transaction: everything in it is on disk when it returns, or nothing is."""
        with self._engine.execution_options(writing=True).begin() as connection:
            yield connection


def export_yaml(record: Record, path: Path) -> None:
    """Write a record to a YAML file, whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(record.to_yaml(), encoding="utf-8")
    part.replace(path)


def _full_url(url: str) -> str:
    if "://" in url:
        return url
    return f"sqlite:///{Path(url).expanduser().resolve()}"


def _prepare_sqlite(engine: sa.Engine) -> None:
    """Write-ahead log, full synchronisation, transactions that take the write lock at their start."""
    if engine.url.database not in (None, "", ":memory:"):
        Path(str(engine.url.database)).parent.mkdir(parents=True, exist_ok=True)

    @sa.event.listens_for(engine, "connect")
    def _on_connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # pysqlite would begin by itself, and too late
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=10000"):
            connection.execute(f"PRAGMA {pragma}")

    @sa.event.listens_for(engine, "begin")
    def _on_begin(connection: sa.Connection) -> None:
        writing = connection.get_execution_options().get("writing", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
