"""A dependency of the daemon fails: it goes on, says so, loses no event, and is right again when that has passed."""

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from failing_calls import DEPENDENCIES, OtherCommit, events, watched_drift
from fast_daemon import FastDaemon, drifted, metric, settings
from made_records import activate_by_hand, copied
from postgres import NoServer, stoppable_server
from same_thread import journal_at

from armlink.errors import BadInput, BusFault
from calib.daemon.state.journal import Journal
from calib.daemon.view import EventItem, HistoryPoint, State
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str | None]]:
    with pytest.MonkeyPatch.context() as patch:
        daemon = watched_drift(tmp_path_factory.mktemp("undisturbed"), lambda dependency, count: False, patch)
        found = events(daemon)
    assert {kind for kind, _ in found} >= {"alarm", "drift", "proposal", "approved", "recalibration"}
    assert daemon.wrong == []
    return found


BURSTS = {"store": (14, 28), "journal": (11, 22), "disk": (2, 4), "pipe": (5, 200), "notify": (5, 10)}
"""How many calls in a row fail, of how many; each failure of the pipe is a new bus process."""


@pytest.mark.long
@pytest.mark.parametrize("failing", DEPENDENCIES)
def test_no_failing_call_ends_it_or_loses_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: list[tuple[str, str | None]], failing: str
) -> None:
    row, period = BURSTS[failing]
    daemon = watched_drift(
        tmp_path, lambda name, count: name == failing and count % period >= period - row, monkeypatch
    )
    assert daemon.failing.failed[failing] >= (
        4 if failing == "disk" else 10
    )  # recordings pause for a minute after each
    assert daemon.lost() == []
    assert daemon.wrong == []
    assert [event for event in undisturbed if event not in events(daemon)] == []
    assert daemon.store.unfinished_write(daemon.arm) is None


def test_single_failures_of_all_at_once_are_right_again_within_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: list[tuple[str, str | None]]
) -> None:
    daemon = watched_drift(tmp_path, lambda name, count: count % 97 == 13, monkeypatch)
    assert min(daemon.failing.failed.values()) >= 1
    assert (daemon.lost(), daemon.wrong) == ([], [])
    assert [event for event in undisturbed if event not in events(daemon)] == []


def test_a_truncated_store_is_said_and_the_records_stay_in_force(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    records, database = daemon.view.status().records, tmp_path / "records.db"
    daemon.store.close()
    shutil.copy(database, tmp_path / "copy.db")
    database.write_bytes(database.read_bytes()[:5000])
    for name in ("records.db-wal", "records.db-shm"):
        (tmp_path / name).unlink(missing_ok=True)
    daemon.run(10)
    status = daemon.view.status()
    assert "cannot be read" in (status.store_fault or "")
    assert status.detail == status.store_fault
    assert (status.records, status.state) == (records, State.OBSERVING)
    assert metric(daemon, "record_store_up") == "0.0"
    daemon.store.close()
    shutil.copy(tmp_path / "copy.db", database)
    daemon.run(5)
    status = daemon.view.status()
    assert (status.store_fault, status.detail, status.records) == (None, "", records)
    assert metric(daemon, "record_store_up") == "1.0"
    assert [event.kind for event in daemon.of_kind("fault", "recovered")] == ["fault", "recovered"]


def test_a_postgresql_that_restarts_is_found_again(tmp_path: Path) -> None:
    try:
        with stoppable_server() as server:
            daemon = FastDaemon(tmp_path, 1, settings("propose"), store=f"{server.url}/postgres")
            daemon.run(10)
            records = daemon.view.status().records
            assert records.calibration is not None
            server.stop()
            daemon.run(10)
            assert daemon.view.status().store_fault
            assert daemon.view.status().records == records
            server.start()
            daemon.run(5)
            assert daemon.view.status().store_fault is None
            better = daemon.good_records()[0]
            daemon.store.put(better, daemon.arm, by="ann", reason="sweep")
            daemon.run(6)
            assert daemon.view.status().records.calibration == better.id
            daemon.store.close()
    except NoServer as reason:
        pytest.skip(str(reason))


def test_a_store_that_does_not_answer_holds_nobody_up(tmp_path: Path) -> None:
    """As a hung PostgreSQL: the look for records, which runs aside, does not come back."""
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    later = []
    daemon.run_aside = lambda work, done: later.append((work, done))
    daemon.run(30)
    assert len(later) == 1
    assert daemon.view.status().state is State.OBSERVING
    assert "records.db has not answered for 2" in (daemon.view.status().store_fault or "")
    assert metric(daemon, "record_store_up") == "0.0"
    daemon.run_aside = lambda work, done: done(work())
    work, done = later.pop()
    done(work())
    daemon.run(6)
    assert daemon.view.status().detail == ""


# ---- the journal


def test_a_lock_of_another_program_holds_the_daemon_for_a_moment_only(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(5)
    other = sqlite3.connect(tmp_path / "state" / "journal.db", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    assert daemon.service.journal._db.execute("PRAGMA busy_timeout").fetchone() == (50,)  # [ms]
    tried = []
    daemon.service.journal._db.set_trace_callback(tried.append)
    for number in range(100):
        daemon.service.events.say("clock", None, f"number {number}", {})
    daemon.service.journal._db.set_trace_callback(None)
    assert len(tried) == 1
    assert daemon.view.status().journal_fault
    other.execute("ROLLBACK")
    daemon.run(3)
    assert [event.text for event in daemon.of_kind("clock")] == [f"number {number}" for number in range(100)]
    assert daemon.view.status().journal_fault is None


def test_a_state_that_becomes_read_only_is_said_and_loses_no_event(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(5)
    daemon.service.journal._db.execute("PRAGMA query_only=ON")
    daemon.service.events.say("clock", None, "while it was read-only", {})
    daemon.run(5)
    assert daemon.view.status().detail == "the journal cannot be written: attempt to write a readonly database"
    assert daemon.view.status().state is State.OBSERVING
    daemon.service.journal._db.execute("PRAGMA query_only=OFF")
    daemon.run(3)
    assert daemon.view.status().detail == ""
    assert [event.text for event in daemon.of_kind("clock")] == ["while it was read-only"]


def test_a_state_that_is_read_only_at_the_start_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, connect = tmp_path / "journal.db", sqlite3.connect
    sqlite3.connect(path).execute("CREATE TABLE events (id)").connection.close()

    def read_only(given: Path, **options: object) -> sqlite3.Connection:
        return connect(f"file:{given}?mode=ro", uri=True, **options)  # type: ignore[call-overload,no-any-return]

    monkeypatch.setattr(sqlite3, "connect", read_only)
    with pytest.raises(
        BadInput, match=r"journal.db: the journal cannot be opened: attempt to write a readonly database"
    ):
        journal_at(path)


class NoCommit(OtherCommit):
    """A database that takes everything but the end of a transaction."""

    def at_commit(self) -> None:
        raise sqlite3.OperationalError("database or disk is full")


def test_what_cannot_be_committed_is_not_half_kept(tmp_path: Path) -> None:
    journal = journal_at(tmp_path / "journal.db", lambda: 0.0)
    real = journal._db

    journal._db = NoCommit(real)  # type: ignore[assignment]
    journal.add_history(datetime(2026, 1, 1, tzinfo=UTC), 0.0, None, {})
    assert not real.in_transaction
    assert real.execute("SELECT COUNT(*) FROM history").fetchone() == (0,)
    assert "disk is full" in journal.trouble
    assert journal.waiting == 1


def test_a_disk_that_is_full_at_the_start_is_said_and_the_start_is_kept_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = Journal._commit
    monkeypatch.setattr(Journal, "_commit", lambda *_: (_ for _ in ()).throw(sqlite3.OperationalError("disk is full")))
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(3)
    assert "disk is full" in daemon.view.status().detail
    monkeypatch.setattr(Journal, "_commit", commit)
    daemon.run(3)
    assert daemon.view.status().detail == ""
    assert daemon.view.events()[0].kind == "started"


def damage(path: Path) -> None:
    """As a disk does that returns other pages than were written."""
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(b"\xa5" * 4096 * 6)


def test_a_damaged_journal_is_set_aside_and_that_is_said(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(30)
    daemon.service.close("end")
    journal = tmp_path / "state" / "journal.db"
    damage(journal)
    daemon.start()
    daemon.run(10)
    (event,) = daemon.of_kind("fault")
    (aside,) = journal.parent.glob("journal.db.damaged-*")
    assert event.text == f"the journal was damaged: it was moved to {aside.name}, and a new, empty journal was begun"
    assert daemon.view.status().detail == ""
    assert daemon.view.status().state is State.OBSERVING


def test_a_journal_that_is_damaged_under_way_is_set_aside_too(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    daemon.service.journal.failed(sqlite3.DatabaseError("database disk image is malformed"))
    daemon.run(5)
    assert [event.text.partition(":")[0] for event in daemon.of_kind("fault")] == ["the journal was damaged"]
    assert daemon.view.status().detail == ""


EVENTS = "UPDATE events SET "


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    "spoil",
    [
        "INSERT INTO decisions(proposal, time, state, by, note) VALUES (1, '2026-01-01', 'appro\x01ed', 'ann', '')",
        "UPDATE proposals SET finding = '{\"joint\": 2'",
        EVENTS + "evidence = substr(evidence, 2)",
        EVENTS + "text = x'ff'",
        "UPDATE proposals SET finding = '[]'",
        "UPDATE proposals SET time = 'x'",
        EVENTS + "evidence = '[1]'",
        EVENTS + "time = 'x'",
        EVENTS + "text = CAST(x'ff' AS TEXT)",
    ],
)
def test_a_row_that_is_damaged_and_still_a_row_is_damage_of_the_journal(tmp_path: Path, spoil: str) -> None:
    """SQLite's own check does not see it: the status, each second, and the API failed for good."""
    daemon = drifted(tmp_path)
    daemon.service.save(history=True)
    assert daemon.view.proposals()
    daemon.service.close("end")
    spoiled(tmp_path / "state" / "journal.db", spoil)
    daemon.start()
    daemon.run(3)
    with contextlib.suppress(sqlite3.Error):  # 503 of the API
        daemon.view.events()
    daemon.run(3)
    assert [event.text.partition(":")[0] for event in daemon.of_kind("fault")] == ["the journal was damaged"]
    assert daemon.view.status().state is State.OBSERVING
    assert daemon.view.proposals() == ()


@pytest.mark.sample(2)
@pytest.mark.parametrize("spoil", ["estimate = '{'", "estimate = '{}'", "estimate = '7'", "time = '2026'", "t = 'x'"])
def test_a_damaged_row_of_history_is_left_out(tmp_path: Path, spoil: str) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    for _ in range(3):
        daemon.service.save(history=True)
        daemon.run(1)

    def pages() -> Iterator[tuple[HistoryPoint, ...]]:
        return daemon.view.history_pages(daemon.arm.joint_names[0])

    _, second, *others = whole = [point.time for page in pages() for point in page]
    daemon.service.close("end")
    spoiled(tmp_path / "state" / "journal.db", f"UPDATE history SET {spoil} WHERE id = 2")
    daemon.start()
    daemon.run(3)
    left = {point.time for page in pages() for point in page}
    assert left >= {whole[0], *others}
    assert second not in left


@pytest.mark.parametrize("state", ["7.5", "[1]", "null", "{"])
def test_a_damaged_belief_is_none(tmp_path: Path, state: str) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    daemon.service.close("end")
    spoiled(tmp_path / "state" / "journal.db", f"UPDATE belief SET state = '{state}'")
    daemon.start()
    daemon.run(3)
    assert daemon.view.status().state is State.OBSERVING


def test_a_schema_that_sqlite_cannot_quote_is_damage(tmp_path: Path) -> None:
    journal_at(tmp_path / "journal.db", lambda: 0.0).close()
    content = (tmp_path / "journal.db").read_bytes()
    (tmp_path / "journal.db").write_bytes(content.replace(b"CREATE TABLE events", b"CREATE \xd2\xff\xfeLE events"))
    assert journal_at(tmp_path / "journal.db", lambda: 0.0).set_aside.startswith("journal.db.damaged-")


def spoiled(journal: Path, statement: str) -> None:
    """A bit that flipped in a row, as far as SQLite is concerned."""
    with contextlib.closing(sqlite3.connect(journal)) as db, db:
        for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            db.execute(f"DROP TRIGGER {name}")
        db.execute(statement)


def test_a_journal_that_is_no_database_is_set_aside(tmp_path: Path) -> None:
    (tmp_path / "journal.db").write_bytes(b"no database at all" * 1000)
    journal = journal_at(tmp_path / "journal.db", lambda: 0.0)
    assert journal.set_aside.startswith("journal.db.damaged-")
    assert journal.events() == []


# ---- store, bus and journal at once


def test_a_store_that_is_replaced_by_rename_is_shown_and_followed(tmp_path: Path) -> None:
    """Controllers were written and their records lost: the daemon went on with the file that had lost its name."""
    daemon, path = drifted(tmp_path), tmp_path / "records.db"
    (proposal,) = daemon.view.proposals()
    copied(path, tmp_path / "copy").rename(path)
    refused = daemon.view.approve(proposal.id, "ann").result(0)
    assert (refused.state, "was replaced by another file" in refused.note) == ("failed", True)
    assert not any(call.startswith("write") for call in daemon.sdo)
    (tmp_path / "away").write_bytes(path.read_bytes())
    (tmp_path / "away").rename(path)
    daemon.run(12)
    faults = [event for event in daemon.of_kind("fault", "recovered") if "record store" in event.text]
    assert [event.kind for event in faults][-2:] == ["fault", "recovered"]
    assert "was replaced by another file while it was in use" in faults[-2].text
    assert daemon.view.status().store_fault is None
    assert daemon.view.status().state is State.OBSERVING
    written = daemon.store.put(daemon.good_records()[0], daemon.arm, by="ann", reason="sweep")
    assert written in [record.id for record in RecordStore(str(path)).history(daemon.arm)]


def test_while_the_store_s_file_is_gone_nothing_is_written(tmp_path: Path) -> None:
    daemon, path = drifted(tmp_path), tmp_path / "records.db"
    path.rename(tmp_path / "away.db")
    daemon.run(7)
    assert "the file is gone" in (daemon.view.status().store_fault or "")
    answer = daemon.view.approve(daemon.view.proposals()[0].id, "ann").result(0)
    assert (answer.state, "the file is gone" in answer.note) == ("failed", True)
    assert not any(call.startswith("write") for call in daemon.sdo)
    assert not path.exists()
    (tmp_path / "away.db").rename(path)
    daemon.run(7)
    assert daemon.view.status().store_fault is None


def test_a_record_of_no_working_arm_that_is_current_is_told_and_not_observed_against(tmp_path: Path) -> None:
    """A date of 2200 ended the bus process, under the policy apply."""
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(5)
    current, wrong = daemon.good_records()[0], {"created": datetime(2200, 1, 1, tzinfo=UTC)}
    record = current.model_copy(update=wrong)
    activate_by_hand(daemon.store, record)
    daemon.run(7)
    assert f"record {record.id}: created is 2200-01-01, expected 1984 to 2106" in daemon.view.status().detail
    assert daemon.view.status().records.calibration != record.id
    assert not any(call.startswith("write") for call in daemon.sdo)


@pytest.mark.parametrize(("bus", "state"), [("fails too", "failed"), ("works", "applied")])
def test_a_write_whose_outcome_the_journal_does_not_take_is_kept_later(tmp_path: Path, bus: str, state: str) -> None:
    daemon = drifted(tmp_path)
    streamed = daemon.service.hub.subscribe()
    real = daemon.service.journal._db

    def written(joint: int) -> None:
        daemon.service.journal._db = NoCommit(real)  # type: ignore[assignment]
        if bus == "fails too":
            raise BusFault("joint gone")

    daemon.on_write = written
    daemon.view.approve(daemon.view.proposals()[0].id, "ann")
    daemon.run(7)  # a look at the record store lies within
    daemon.service.journal._db = real
    assert daemon.view.proposals()[0].state == "approved"
    assert "disk is full" in daemon.view.status().detail
    kind = {"failed": "fault", "applied": "recalibration"}[state]
    assert kind not in [item.event.kind for item in streamed._queue if isinstance(item, EventItem)]
    daemon.run(3)
    assert daemon.view.proposals()[0].state == state
    assert len(daemon.of_kind(kind)) == 1
    assert [item.event.kind for item in streamed._queue if isinstance(item, EventItem)].count(kind) == 1
    assert daemon.view.status().detail == ""
    current = daemon.store.current(CalibrationRecord, daemon.arm)
    assert current is not None
    assert daemon.view.status().records.calibration == current.id
    daemon.on_write = lambda joint: None
    daemon.run(60)
    found_again = {"failed": 1, "applied": 0}[state]
    assert len(daemon.view.proposals()) == 1 + found_again


def test_an_outcome_that_waited_for_a_journal_that_was_begun_anew_is_said_and_holds_nothing_up(tmp_path: Path) -> None:
    daemon = drifted(tmp_path)

    def written(joint: int) -> None:
        daemon.service.journal._db.execute("PRAGMA query_only=ON")

    daemon.on_write = written
    daemon.view.approve(daemon.view.proposals()[0].id, "ann")
    daemon.service.journal.failed(sqlite3.DatabaseError("database disk image is malformed"))
    daemon.run(5)
    assert daemon.view.status().detail == ""
    assert daemon.view.proposals() == ()
    assert [event.joint for event in daemon.of_kind("recalibration")] == ["joint_3"]
