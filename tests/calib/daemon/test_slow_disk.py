"""A disk that takes long, or never answers: nobody waits for it, that is shown, and nothing is lost or done twice."""

import asyncio
import logging
import sqlite3
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from failing_calls import OtherCommit
from fast_daemon import START, FastDaemon, drifted, metric, settings

from armlink.arm_file import load_arm
from armlink.loop.messages import Up
from calib.daemon.environment import Worker
from calib.daemon.main_loop import Daemon
from calib.daemon.settings import DaemonSection, Options
from calib.daemon.state import arm_state
from calib.daemon.state import journal as journal_of
from calib.daemon.state.journal import SILENT_SECONDS, Journal
from calib.daemon.view import EventItem, NotPossible, State
from calib.records.records import CalibrationRecord, provenance

PATIENCE = 60.0
"""On a busy machine [s]."""


class NoProcess:
    """Stands for the bus process, which says nothing."""

    def fileno(self) -> int:
        return -1

    def pump(self) -> list[Any]:
        return []


class SlowCommit(OtherCommit):
    """A database whose transactions end only once they may."""

    def __init__(self, real: sqlite3.Connection) -> None:
        super().__init__(real)
        self.may, self.gave_up = threading.Event(), False

    def at_commit(self) -> None:
        self.gave_up = self.gave_up or not self.may.wait(PATIENCE / 6)


def waiting(daemon: FastDaemon) -> int:
    """The newest proposal."""
    return daemon.view.proposals()[0].id


def test_the_event_loop_turns_and_answers_while_the_disk_does_not(tmp_path: Path) -> None:
    async def main() -> None:
        options = Options(arm="sarcos", socket=tmp_path / "api.sock", store=str(tmp_path / "records.db"))
        daemon = Daemon(options, load_arm("sarcos"), NoProcess(), tmp_path / "state")  # type: ignore[arg-type]
        journal = daemon.service.journal
        slow: Any = SlowCommit(journal._db)
        journal._db = slow
        daemon.service.events.say("clock", None, "while the disk hangs", {})
        for _ in range(20):
            daemon._turn(time.monotonic(), 0.0)
            assert daemon.view.status().arm == "sarcos"
            await asyncio.sleep(0)
        assert not slow.gave_up, "the loop waited for the disk"
        assert "while the disk hangs" not in [event.text for event in await asyncio.to_thread(daemon.view.events)]
        slow.may.set()
        async with asyncio.timeout(PATIENCE):
            while journal.waiting:
                await asyncio.sleep(0.001)
        assert [event.text for event in daemon.view.events()][-1] == "while the disk hangs"
        daemon.service.close("end")

    asyncio.run(main())


def test_a_disk_that_does_not_answer_shows_and_keeps_all_events_in_order(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    rows, streamed = daemon.view.status().rows, daemon.service.hub.subscribe()
    daemon.disk.held = True
    for number in range(20):
        daemon.service.events.say("clock", None, f"number {number}", {})
        daemon.run(1)
    status = daemon.view.status()
    assert status.detail.startswith("the journal cannot be written: the disk has not answered for ")
    assert metric(daemon, "journal_up") == "0.0"
    assert status.state is State.OBSERVING
    assert status.rows > rows
    assert not daemon.of_kind("clock")
    assert not [item for item in streamed._queue if isinstance(item, EventItem)]
    daemon.disk.release()
    assert [event.text for event in daemon.of_kind("clock")] == [f"number {number}" for number in range(20)]
    told = [item.event for item in streamed._queue if isinstance(item, EventItem)]
    assert [event.text for event in told] == [f"number {number}" for number in range(20)]
    assert [event.id for event in told] == [event.id for event in daemon.of_kind("clock")]
    daemon.run(3)
    assert daemon.view.status().detail == ""
    assert metric(daemon, "journal_up") == "1.0"


def test_a_disk_that_took_long_shows_until_it_is_quick_again(tmp_path: Path) -> None:
    now = [0.0]
    held: list[Any] = []
    journal = Journal(tmp_path / "journal.db", lambda: now[0], lambda work, done: held.append((work, done)))
    journal.add_history(datetime(2026, 1, 1, tzinfo=UTC), 0.0, None, {})
    for seconds, trouble in ((SILENT_SECONDS + 1.0, "took 3 s"), (0.1, "")):
        ((work, done),) = held
        held.clear()
        now[0] += seconds
        done(work())
        assert trouble in journal.trouble
        assert bool(trouble) == bool(journal.trouble)
        journal.probe()


def test_an_approval_waits_for_the_disk_and_no_controller_is_written_before(tmp_path: Path) -> None:
    daemon = drifted(tmp_path)
    daemon.disk.held = True
    daemon.sdo.clear()
    answer = daemon.view.approve(waiting(daemon), "ann")
    daemon.run(10)
    assert not answer.done()
    assert [each for each in daemon.sdo if each.startswith("write")] == []
    assert daemon.view.proposals()[0].state == "pending"
    for decide in (daemon.view.approve, daemon.view.reject):
        with pytest.raises(NotPossible, match="already decided; the decision waits for the disk"):
            decide(waiting(daemon), "bob")
    daemon.disk.release()
    assert answer.result(0).state in ("approved", "applied")
    assert daemon.view.proposals()[0].state == "applied"
    assert [event.kind for event in daemon.of_kind("approved", "recalibration")] == ["approved", "recalibration"]


def test_an_approval_that_is_not_on_disk_at_a_kill_was_never_given(tmp_path: Path) -> None:
    daemon = drifted(tmp_path)
    daemon.disk.held = True
    daemon.sdo.clear()
    daemon.view.approve(waiting(daemon), "ann")
    daemon.kill()
    daemon.disk.held, daemon.disk.waiting = False, []
    daemon.start()
    assert daemon.view.proposals()[0].state == "pending"
    assert [each for each in daemon.sdo if each.startswith("write")] == []
    assert daemon.view.approve(waiting(daemon), "ann").result(0).state in ("approved", "applied")


def test_an_approval_is_not_written_once_another_record_is_in_force(tmp_path: Path) -> None:
    daemon = drifted(tmp_path)
    daemon.disk.held = True
    answer = daemon.view.approve(waiting(daemon), "ann")
    provenance_of = provenance(daemon.arm, created=START + timedelta(hours=1))
    other = CalibrationRecord(**provenance_of, joints=daemon.good_records()[0].joints)
    daemon.store.put(other, daemon.arm, by="ann", reason="sweep")
    daemon.run(15)
    assert daemon.view.status().records.calibration == other.id
    daemon.sdo.clear()
    daemon.disk.release()
    assert answer.result(0).state in ("approved", "failed")
    assert daemon.view.proposals()[0].state == "failed"
    assert "became current" in daemon.view.proposals()[0].note
    assert [each for each in daemon.sdo if each.startswith("write")] == []


def test_nothing_is_written_automatically_before_it_is_on_disk(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(40)
    daemon.drift()
    daemon.disk.held = True
    daemon.sdo.clear()
    daemon.run(80)
    assert [each for each in daemon.sdo if each.startswith("write")] == []
    daemon.disk.release()
    daemon.run(3)
    assert [event.joint for event in daemon.of_kind("recalibration")] == ["joint_3"]


def test_what_waits_is_bounded_and_decisions_are_never_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_of, "MOST_WAITING", 50)
    daemon = drifted(tmp_path)
    daemon.disk.held = True
    daemon.service.events.say("clock", None, "is being written", {})
    daemon.view.reject(waiting(daemon), "ann")
    for number in range(200):
        daemon.service.events.say("clock", None, f"number {number}", {})
        daemon.service.save()
    assert daemon.service.journal.waiting == 50
    beliefs = [each for one in daemon.service.journal._queue for each, _ in one.statements if "belief" in each]
    assert len(beliefs) == 1
    daemon.disk.release()
    assert daemon.view.proposals()[0].state == "rejected"
    assert daemon.of_kind("clock")[-1].text == "number 199"


def test_a_row_that_the_schema_refuses_holds_no_other_up(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.disk.held = True
    daemon.service.events.say("clock", None, "before", {})
    daemon.service.journal._write("INSERT INTO events(id) VALUES (?)", 1)
    daemon.service.events.say("clock", None, "after", {})
    daemon.disk.release()
    assert [event.text for event in daemon.of_kind("clock")] == ["before", "after"]
    assert daemon.view.status().detail == ""


def test_recordings_that_the_disk_does_not_take_are_left_out_and_begin_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(arm_state, "MOST_WAITING", 5)
    daemon = FastDaemon(tmp_path, 1, DaemonSection.model_validate({"recording": {"rate": 25.0}}))
    daemon.run(2)
    daemon.disk.held = True
    with caplog.at_level(logging.ERROR):
        daemon.run(30)
    assert daemon.service.recordings._waiting == 5
    assert [each.getMessage() for each in caplog.records].count(
        "recordings: the disk is too slow, so samples are left out"
    ) == 1
    daemon.disk.release()
    daemon.run(5)
    daemon.service.close("end")
    assert len(list((tmp_path / "state" / "recordings").glob("*.mcap"))) == 2


def test_the_end_does_not_wait_for_ever(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("propose"))
    daemon.run(10)
    daemon.disk.held = True
    daemon.service.events.say("clock", None, "not on disk", {})
    daemon.service.take(Up(daemon.held()))
    with caplog.at_level(logging.ERROR):
        daemon.service.close("end")
    assert any("entries are not in the journal" in each.getMessage() for each in caplog.records)


def test_work_is_done_in_its_order_and_its_end_is_waited_for_within_a_bound() -> None:
    async def main() -> None:
        worker, may, done = Worker(asyncio.get_running_loop(), "test"), threading.Event(), list[Any]()
        worker(lambda: may.wait(PATIENCE), done.append)
        worker(lambda: 1 / 0, done.append)
        worker(lambda: worker_thread.append(threading.current_thread()), done.append)
        assert not worker.drain(0.01)
        assert done == []
        may.set()
        assert worker.drain(PATIENCE)
        assert done[0] is True
        assert isinstance(done[1], ZeroDivisionError)
        assert worker_thread[0] is not threading.current_thread()
        worker(lambda: "on the loop", done.append)
        async with asyncio.timeout(PATIENCE):
            while done[-1] != "on the loop":
                await asyncio.sleep(0.001)

    worker_thread: list[threading.Thread] = []
    asyncio.run(main())
