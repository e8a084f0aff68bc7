"""The record store's database: PostgreSQL as SQLite, old schemas brought up to date, full disks named."""

import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import fake_controllers
import pytest
import sqlalchemy as sa
from made_records import ARM, arm_file, calibration, copied, gravity
from postgres import NoServer, server, stoppable_server

from armlink.errors import BadInput, Refused
from calib.install.journaled_write import install
from calib.install.plausibility import Admitted
from calib.records import database
from calib.records.database import TABLES, StoreFault, open_database
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore

AS_OF_SESSION_1 = """
CREATE TABLE records (id VARCHAR(8) NOT NULL, kind VARCHAR NOT NULL, arm VARCHAR NOT NULL, serial VARCHAR NOT NULL,
  created VARCHAR NOT NULL, body TEXT NOT NULL, PRIMARY KEY (id));
CREATE TABLE activations (number INTEGER NOT NULL PRIMARY KEY, record VARCHAR(8) NOT NULL REFERENCES records (id),
  kind VARCHAR NOT NULL, arm VARCHAR NOT NULL, serial VARCHAR NOT NULL, at VARCHAR NOT NULL, "by" VARCHAR NOT NULL,
  reason VARCHAR NOT NULL);
CREATE TRIGGER IF NOT EXISTS records_no_update BEFORE UPDATE ON records
  BEGIN SELECT RAISE(ABORT, 'records is append-only'); END;
CREATE TRIGGER IF NOT EXISTS records_no_delete BEFORE DELETE ON records
  BEGIN SELECT RAISE(ABORT, 'records is append-only'); END;
CREATE TRIGGER IF NOT EXISTS activations_no_update BEFORE UPDATE ON activations
  BEGIN SELECT RAISE(ABORT, 'activations is append-only'); END;
CREATE TRIGGER IF NOT EXISTS activations_no_delete BEFORE DELETE ON activations
  BEGIN SELECT RAISE(ABORT, 'activations is append-only'); END;
"""


@pytest.fixture(scope="session")
def postgresql() -> Iterator[str]:
    try:
        with server() as url:
            yield url
    except NoServer as error:
        pytest.skip(str(error))


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database of each kind."""
    if request.param == "sqlite":
        return str(tmp_path / "records.db")
    base = request.getfixturevalue("postgresql")
    name = f"t{abs(hash(request.node.nodeid)):x}"
    administration = base.replace("postgresql", "postgresql+psycopg") + "/postgres"
    engine = sa.create_engine(administration, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return f"{base}/{name}"


def test_records_activations_and_rollback(url: str) -> None:
    store = RecordStore(url)
    first = store.put(calibration(), ARM, by="ann", reason="sweep")
    second = store.put(calibration(1.05, parent=first), ARM, by="bob", reason="sweep")
    store.put(gravity(), ARM, by="ann", reason="identify")
    store.rollback(ARM, to=first, by="cy", reason="sensor exchanged")
    store.close()
    again = RecordStore(url)
    assert again.current(CalibrationRecord, ARM) == calibration()
    assert again.current(GravityRecord, ARM) == gravity()
    assert len(again.history(ARM)) == 3
    log = [(line.record, line.by, line.reason) for line in again.activations(ARM) if line.kind == "calibration"]
    assert log == [(first, "ann", "sweep"), (second, "bob", "sweep"), (first, "cy", "sensor exchanged")]
    assert again.history(arm_file(serial="8")) == []
    with pytest.raises(Refused, match="serial is 7"):
        again.put(calibration(), arm_file(serial="8"), by="ann", reason="")


def test_the_database_refuses_change_and_deletion(url: str) -> None:
    RecordStore(url).put(calibration(), ARM, by="ann", reason="sweep")
    engine = open_database(url)
    tables = ("records", "activations")
    statements = [f"DELETE FROM {table}" for table in tables] + [f"UPDATE {table} SET arm = 'x'" for table in tables]
    if engine.dialect.name == "postgresql":
        statements.append("TRUNCATE records, activations, writes")
    for statement in statements:
        with pytest.raises(sa.exc.DBAPIError, match="append-only"), engine.begin() as connection:
            connection.execute(sa.text(statement))
    assert RecordStore(url).current(CalibrationRecord, ARM) == calibration()


def test_writers_at_the_same_time_lose_nothing(url: str) -> None:
    """Four threads open the empty store at once and put records, the same ones too."""
    ready, failed = threading.Barrier(4), []

    def work(number: int) -> None:
        try:
            ready.wait()
            store = RecordStore(url)
            for k in range(5):
                store.put(calibration(1.0 + 0.001 * k), ARM, by=str(number), reason="together")
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert len(RecordStore(url).history(ARM)) == 5
    assert len(RecordStore(url).activations(ARM)) == 20


def test_the_schema_is_what_the_code_expects(url: str) -> None:
    inspector = sa.inspect(open_database(url))
    for table in TABLES.sorted_tables:
        assert [column["name"] for column in inspector.get_columns(table.name)] == [c.name for c in table.columns]


def test_a_store_of_session_1_is_brought_up_to_date_and_keeps_its_rows(tmp_path: Path) -> None:
    """The tables as the first version made them, without a version number, and two rows."""
    path = tmp_path / "records.db"
    engine = sa.create_engine(f"sqlite:///{path}")
    record, raw = calibration(), engine.raw_connection()
    raw.driver_connection.executescript(AS_OF_SESSION_1)
    row = (record.id, "calibration", "bench", "7", record.created.isoformat(), record.model_dump_json())
    raw.driver_connection.execute("INSERT INTO records VALUES (?, ?, ?, ?, ?, ?)", row)
    line = (1, record.id, "calibration", "bench", "7", "2026-11-20T10:00:00+00:00", "ann", "sweep")
    raw.driver_connection.execute("INSERT INTO activations VALUES (?, ?, ?, ?, ?, ?, ?, ?)", line)
    raw.commit()
    raw.close()
    store = RecordStore(str(path))
    assert store.current(CalibrationRecord, ARM) == record
    assert [each.by for each in store.activations(ARM)] == ["ann"]
    assert store.writes(ARM) == []
    store.put(calibration(1.05), ARM, by="bob", reason="sweep")
    assert len(RecordStore(str(path)).activations(ARM)) == 2


def test_a_schema_whose_number_is_damaged_is_refused_in_one_line(tmp_path: Path) -> None:
    """SQLite keeps bytes in a column of text."""
    url = f"sqlite:///{tmp_path / 'records.db'}"
    RecordStore(url).close()
    engine = open_database(url)
    with engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = x'30ff'"))
    with pytest.raises(BadInput, match="is newer than schema"):
        RecordStore(url)


@pytest.mark.parametrize("newer", ["0999", "09\n99"])
def test_a_store_of_a_newer_armlink_is_refused_in_one_line(url: str, newer: str) -> None:
    RecordStore(url).put(calibration(), ARM, by="ann", reason="sweep")
    engine = open_database(url)
    with engine.begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = :newer"), {"newer": newer})
    with pytest.raises(BadInput, match=r"schema 09 ?99 is newer than schema") as refused:
        RecordStore(url)
    assert "\n" not in str(refused.value)


def test_a_server_that_is_not_there_is_one_line_without_the_password() -> None:
    with pytest.raises(BadInput, match="cannot be opened") as refused:
        RecordStore("postgresql://armlink:secret@127.0.0.1:9/records")
    assert "secret" not in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_server_that_hangs_is_a_failure_after_a_while_and_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its processes stand still (SIGSTOP); the kernel goes on to acknowledge what is sent, so that TCP sees nothing."""
    monkeypatch.setattr("calib.records.database.ANSWER_SECONDS", 0.3)
    monkeypatch.setitem(database._POSTGRESQL, "connect_timeout", 2)
    try:
        with stoppable_server() as running:
            store, arm = RecordStore(f"{running.url}/postgres"), arm_file()
            store.put(calibration(), arm, by="ann", reason="sweep")
            record = store.current(CalibrationRecord, arm)
            silence = r"cannot be read: the server has not answered for 0\.3 s"

            def read() -> None:
                with database.reading(store._engine) as connection:
                    running.hang()
                    connection.execute(sa.text("SELECT 1"))

            with pytest.raises(StoreFault, match=silence) as fault:
                read()
            assert "\n" not in str(fault.value)
            with pytest.raises(StoreFault, match="cannot be read: connection timeout expired"):
                store.current(CalibrationRecord, arm)
            running.go_on()
            assert store.current(CalibrationRecord, arm) == record
            store.close()
    except NoServer as reason:
        pytest.skip(str(reason))


def filled(path: Path) -> RecordStore:
    """A store with one record, which is current."""
    store = RecordStore(str(path))
    store.put(calibration(), ARM, by="ann", reason="sweep")
    return store


def test_a_full_disk_is_said_and_nothing_is_lost(tmp_path: Path) -> None:
    """A file may not grow beyond what it is: as a full disk does, the write fails and what was there stands."""
    path = tmp_path / "records.db"
    store = filled(path)
    script = (
        "import resource, sys, made_records as t\n"
        "from armlink.errors import BadInput\n"
        "from calib.records.store import RecordStore\n"
        "store = RecordStore(sys.argv[1])\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({8192}, {resource.RLIM_INFINITY}))\n"
        "try:\n"
        "    for k in range(200):\n"
        "        store.put(t.calibration(1.1 + 0.001 * k), t.ARM, by='ann', reason='sweep')\n"
        "except BadInput as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "nothing was written" in done.stdout
    assert done.stdout.count("\n") == 1
    kept = RecordStore(str(path)).history(ARM)
    assert calibration() in kept
    assert len(kept) - len(store.activations(ARM)) in (0, 1)  # a put is two transactions: kept, then current


# ---- a store is its file, not its name


def test_a_store_that_was_replaced_by_rename_is_noticed_before_anything_is_written(tmp_path: Path) -> None:
    path = tmp_path / "records.db"
    store = filled(path)
    copied(path, tmp_path / "backup.db").rename(path)
    with pytest.raises(StoreFault, match=r"was replaced by another file while it was in use\. Nothing was written"):
        store.put(calibration(1.05), ARM, by="ann", reason="sweep")
    store.put(calibration(1.06), ARM, by="ann", reason="sweep")
    assert {record.id for record in RecordStore(str(path)).history(ARM)} == {calibration().id, calibration(1.06).id}


def test_a_store_that_was_replaced_is_noticed_by_whoever_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "records.db"
    store = filled(path)
    RecordStore(str(tmp_path / "other.db")).close()
    (tmp_path / "other.db").rename(path)
    with pytest.raises(StoreFault, match="was replaced"):
        store.current(CalibrationRecord, ARM)
    assert store.current(CalibrationRecord, ARM) is None


def test_a_store_that_is_replaced_within_a_transaction_keeps_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "records.db"
    store = RecordStore(str(path))
    copied(path, tmp_path / "backup.db")

    def replaced(connection: sa.Connection) -> None:
        (tmp_path / "backup.db").rename(path)

    monkeypatch.setattr(database, "_lock", replaced)
    with pytest.raises(StoreFault, match="nothing was written"):  # by SQLite itself, which has no log beside the file
        store.add(calibration())
    monkeypatch.undo()
    assert store.history(ARM) == []
    assert RecordStore(str(path)).history(ARM) == []


def test_a_store_whose_file_is_gone_is_not_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "records.db"
    store = filled(path)
    path.rename(tmp_path / "away.db")
    for _ in range(2):
        with pytest.raises(StoreFault, match=r"the file is gone \(No such file or directory\): put it back"):
            store.add(calibration(1.05))
        with pytest.raises(StoreFault, match="the file is gone"):
            store.history(ARM)
    assert not path.exists()
    (tmp_path / "away.db").rename(path)
    assert store.current(CalibrationRecord, ARM) == calibration()


def test_a_file_that_is_no_store_in_its_place_is_one_line_until_it_is_restored(tmp_path: Path) -> None:
    path = tmp_path / "records.db"
    store = filled(path)
    copied(path, tmp_path / "backup.db")
    (tmp_path / "text").write_text("no database, but longer than the header of one, which has a hundred bytes" * 9)
    (tmp_path / "text").rename(path)
    for _ in range(2):
        with pytest.raises(StoreFault):
            store.current(CalibrationRecord, ARM)
    (tmp_path / "backup.db").rename(path)
    found = [None]
    for _ in range(2):  # the first may say that it was replaced
        try:
            found.append(store.current(CalibrationRecord, ARM))
        except StoreFault:
            continue
    assert found[-1] == calibration()


def test_controllers_get_back_what_they_held_where_the_store_is_replaced_during_a_write(tmp_path: Path) -> None:
    path = tmp_path / "records.db"
    store, controllers = RecordStore(str(path)), fake_controllers.Controllers()
    store.put(fake_controllers.record(), fake_controllers.ARM, by="ann", reason="sweep")
    copied(path, tmp_path / "backup.db")

    def replaced() -> None:
        (tmp_path / "backup.db").rename(path)

    joints = tuple(fake_controllers.joint(name, 1.15) for name in fake_controllers.NAMES)
    admitted = Admitted(fake_controllers.record(joints=joints), fake_controllers.ARM, "none")
    with pytest.raises(StoreFault, match="was replaced"):
        install(admitted, store, controllers, by="ann", reason="x", check=replaced)  # type: ignore[arg-type]
    assert [held.gain for held in controllers.held] == [pytest.approx(1.1)] * 2
    assert RecordStore(str(path)).unfinished_write(fake_controllers.ARM) is None
