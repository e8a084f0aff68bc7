"""Database of the record store: its tables, URL, opening, schema migration."""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from armlink.errors import BadInput
from armlink.extras import require_extra

TABLES = sa.MetaData()


def _texts(*names: str) -> list[sa.Column[str]]:
    return [sa.Column(name, sa.String, nullable=False) for name in names]


def _of_a_record() -> list[sa.Column[Any]]:
    """Columns of a numbered row that is about a record."""
    return [
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
    ]


def _body() -> sa.Column[str]:
    return sa.Column("body", sa.Text, nullable=False)


RECORDS = sa.Table(
    "records",
    TABLES,
    sa.Column("id", sa.String(8), primary_key=True),
    *_texts("kind", "arm", "serial", "created"),
    _body(),
)
ACTIVATIONS = sa.Table("activations", TABLES, *_of_a_record(), *_texts("kind", "arm", "serial", "at", "by", "reason"))
WRITES = sa.Table("writes", TABLES, *_of_a_record(), *_texts("arm", "serial", "at", "by", "stage"), _body())
"""Journal of writes to controllers: stage `begun` with the calibrations held before, then `finished` or `undone`."""

MIGRATIONS = ("0001", "0002")
"""Revisions of the schema, oldest first; the last one makes the tables above."""


def append_only(table: str, dialect: str) -> list[str]:
    """Statements that make the database itself refuse to change or delete rows of a table."""
    if dialect == "sqlite":
        return [
            f"CREATE TRIGGER IF NOT EXISTS {table}_no_{change.lower()} BEFORE {change} ON {table} "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
            for change in ("UPDATE", "DELETE")
        ]
    if dialect == "postgresql":
        refuse = f"{table}_append_only"
        return [
            f"CREATE OR REPLACE FUNCTION {refuse}() RETURNS trigger LANGUAGE plpgsql AS "
            f"$$ BEGIN RAISE EXCEPTION '{table} is append-only'; END $$",
            f"CREATE TRIGGER {refuse} BEFORE UPDATE OR DELETE ON {table} FOR EACH ROW EXECUTE FUNCTION {refuse}()",
            f"CREATE TRIGGER {refuse}_all BEFORE TRUNCATE ON {table} FOR EACH STATEMENT EXECUTE FUNCTION {refuse}()",
        ]
    return []


HEAD = MIGRATIONS[-1]
ANSWER_SECONDS = 10
"""Longest wait for a database: for another writer of an SQLite file, or for a server's answer [s]."""
_POSTGRESQL = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "options": f"-c statement_timeout={ANSWER_SECONDS * 1000}",
}
"""Of libpq: how long it waits for a connection, and how long the server may work [s, s, s, –, ms]."""
_VERSION = "alembic_version"
_FILE = "file"
"""Key of a connection's notes: the identity of the file that it holds open."""
FileIdentity = tuple[int, int] | None
"""Device and inode; None for a database that is no file of its own."""
_LOCK = int.from_bytes(b"arml")
"""Advisory lock on PostgreSQL that serialises writers, as SQLite does by itself."""


class StoreFault(BadInput):
    """The record store cannot be reached, read or written now; nothing was changed."""


class _Replaced(Exception):
    """Another file has got the name of the one that a connection holds open."""


def default_url() -> str:
    """URL of the store: ARMLINK_STORE, else in the user's state directory (XDG_STATE_HOME, else ~/.local/state)."""
    if named := os.environ.get("ARMLINK_STORE"):
        return named
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return f"sqlite:///{state / 'armlink' / 'records.db'}"


def open_database(url: str) -> sa.Engine:
    """Open, or create, the database at an SQLAlchemy URL or a file path, with the present schema.

    An older schema is migrated; raises BadInput for a newer one, or if the database cannot be opened.
    """
    full = _full_url(url)
    try:
        if sa.make_url(full).get_backend_name() == "postgresql":
            require_extra(f"record store {_shown(full)}", "postgresql")
        connect = _POSTGRESQL if sa.make_url(full).get_backend_name() == "postgresql" else {}
        engine = sa.create_engine(full, pool_pre_ping=True, connect_args=connect)
        if engine.dialect.name == "sqlite":
            _prepare_sqlite(engine)
        elif connect:
            from calib.records.hanging_server import give_up_when_silent  # psycopg is an extra

            give_up_when_silent(engine, ANSWER_SECONDS)
        _migrate(engine)
    except (sa.exc.SQLAlchemyError, ImportError, OSError, ValueError) as error:
        raise BadInput(f"record store {_shown(full)}: cannot be opened: {first_line(error)}") from None
    return engine


@contextmanager
def transaction(engine: sa.Engine) -> Iterator[sa.Connection]:
    """One writing transaction: all of it is on disk when it returns, or nothing is. Raises StoreFault if it fails.

    At its end it asks once more whether the file is still the store's: what is committed to another one is lost.
    """
    _file_of(engine)  # before SQLite would make an empty one
    try:
        with engine.execution_options(writing=True).begin() as connection:
            _require_same_file(engine, connection)
            _lock(connection)
            yield connection
            _require_same_file(engine, connection)
    except _Replaced:
        raise _replaced(engine) from None
    except sa.exc.IntegrityError:
        raise
    except sa.exc.SQLAlchemyError as error:
        raise _fault(engine, "nothing was written", error) from None


@contextmanager
def reading(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A connection that reads; raises StoreFault where the database fails, and the next one is opened anew."""
    _file_of(engine)  # before SQLite would make an empty one
    try:
        with engine.connect() as connection:
            _require_same_file(engine, connection)
            yield connection
    except _Replaced:
        raise _replaced(engine) from None
    except sa.exc.SQLAlchemyError as error:
        raise _fault(engine, "cannot be read", error) from None


def _file_of(engine: sa.Engine) -> FileIdentity:
    """Device and inode of the file that has the store's name now; None for a store that is no file of its own.

    Raises StoreFault where there is none.
    """
    if not _is_file(engine):
        return None
    try:
        found = os.stat(str(engine.url.database))
    except OSError as error:
        engine.dispose()
        raise StoreFault(f"{_store_name(engine)}: the file is gone ({error.strerror}): put it back") from None
    return found.st_dev, found.st_ino


def _is_file(engine: sa.Engine) -> bool:
    name = engine.url.database or ""
    return engine.dialect.name == "sqlite" and name not in ("", ":memory:") and not name.startswith("file:")


def _require_same_file(engine: sa.Engine, connection: sa.Connection) -> None:
    """Raise _Replaced where this connection holds another file than the one that has the store's name.

    A connection follows its file, not the name: what is written through it would be in a file that nobody opens again.
    """
    if _file_of(engine) != connection.info.get(_FILE):
        raise _Replaced


def _replaced(engine: sa.Engine) -> StoreFault:
    """The refusal of what was under way; the file that has the name now is opened, and migrated, for the next call.

    Called once the old file's transaction is over: its journal would be replayed into the new one.
    """
    engine.dispose()
    try:
        _migrate(engine)
    except sa.exc.SQLAlchemyError as error:
        return _fault(engine, "it was replaced by another file, which cannot be opened", error)
    return StoreFault(
        f"{_store_name(engine)} was replaced by another file while it was in use. Nothing was written, and the new "
        "file is used from now on: try again"
    )


def _fault(engine: sa.Engine, what: str, error: sa.exc.SQLAlchemyError) -> StoreFault:
    """A failure of the database in one line; its connections are closed, since they may hold a lost server or file."""
    engine.dispose()
    reason = first_line(getattr(error, "orig", None) or error)
    return StoreFault(f"{_store_name(engine)}: {what}: {reason}: correct the cause and repeat the command")


def _store_name(engine: sa.Engine) -> str:
    """The store at the beginning of a message, without its password."""
    return f"record store {engine.url.render_as_string(hide_password=True)}"


def _migrate(engine: sa.Engine) -> None:
    """Migrate the schema to HEAD; a store older than migrations has the tables of 0001 and no version."""
    with engine.connect() as connection:
        if _version(connection) == HEAD:
            return
    with engine.execution_options(writing=True).begin() as connection:
        _lock(connection)
        found = _version(connection)
        if found == HEAD:  # another process was first
            return
        if found is not None and found not in MIGRATIONS:
            raise BadInput(
                f"{_store_name(engine)}: its schema {found} is newer than schema {HEAD} of this armlink, so "
                "nothing was changed: install a newer armlink"
            )
        _upgrade(connection, stamp=found is None and sa.inspect(connection).has_table("records"))


def _upgrade(connection: sa.Connection, stamp: bool) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    if stamp:
        command.stamp(config, "0001")
    command.upgrade(config, HEAD)


def _lock(connection: sa.Connection) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))


def _version(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table(_VERSION):
        return None
    return connection.execute(sa.text(f"SELECT version_num FROM {_VERSION}")).scalar()


def _full_url(url: str) -> str:
    if "://" not in url:
        return f"sqlite:///{Path(url).expanduser().resolve()}"
    scheme, _, rest = url.partition("://")
    return f"postgresql+psycopg://{rest}" if scheme in ("postgres", "postgresql") else url


def _shown(url: str) -> str:
    try:
        return sa.make_url(url).render_as_string(hide_password=True)
    except sa.exc.ArgumentError:
        return url


def _prepare_sqlite(engine: sa.Engine) -> None:
    """Rollback journal, full synchronisation, transactions that take the write lock at their start."""
    if engine.url.database not in (None, "", ":memory:"):
        Path(str(engine.url.database)).parent.mkdir(parents=True, exist_ok=True)

    @sa.event.listens_for(engine, "connect")
    def _on_connect(connection: Any, pooled: Any) -> None:
        connection.isolation_level = None  # pysqlite would begin by itself, and too late
        connection.execute(f"PRAGMA busy_timeout={ANSWER_SECONDS * 1000}")
        _to_one_file(connection)
        for pragma in ("synchronous=FULL", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}")
        pooled.info[_FILE] = _file_of(engine)

    @sa.event.listens_for(engine, "begin")
    def _on_begin(connection: sa.Connection) -> None:
        writing = connection.get_execution_options().get("writing", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _to_one_file(connection: sqlite3.Connection) -> None:
    """Keep everything in the store's own file between transactions, by a rollback journal.

    A write-ahead log stays beside it: if another file gets the store's name, a copy put back say, SQLite would replay
    the log of the file before into it. A store of an older armlink that is in use keeps its log until it is not.
    """
    with suppress(sqlite3.OperationalError):
        connection.execute("PRAGMA journal_mode=DELETE")


def first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]
