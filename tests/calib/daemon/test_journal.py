"""The daemon's journal: what supersedes what, and how much of a history is read."""

import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from same_thread import journal_at

from calib.daemon.state.journal import Journal
from calib.daemon.state.journal_rows import HistoryReader
from calib.observer.decision import DriftFinding

NOW = datetime(2026, 5, 1, tzinfo=UTC)


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return journal_at(tmp_path / "journal.db")


def test_a_newer_proposal_supersedes_the_pending_one_of_its_joint_alone(journal: Journal) -> None:
    def propose(joint: str) -> int:
        finding = DriftFinding(0, "gain", 1.02, 0.0, np.zeros((2, 2)), 40, 0.99)
        return journal.add_proposal(NOW, joint, "00c0ffee", "0ddba115", finding)

    decided, other, first = propose("j1"), propose("j2"), propose("j1")
    journal.decide(other, NOW, "rejected", "ann")
    assert journal.proposal(decided).proposal.state == "superseded"
    waiting, second = propose("j2"), propose("j1")
    states = {row.id: row.proposal.state for row in journal.proposals()}
    assert states == {
        decided: "superseded",
        other: "rejected",
        first: "superseded",
        waiting: "pending",
        second: "pending",
    }
    assert journal.pending() == 2


def test_the_least_age_of_an_event_is_by_the_monotonic_clock_over_restarts_of_the_machine(journal: Journal) -> None:
    def said(t: float, kind: str, days: int = 0) -> None:
        journal.add_event(NOW + timedelta(days=days), t, kind, "j1", "", {"proposal": t})

    for t, kind, days in ((100, "written", 0), (400, "other", 9), (10, "started", -9), (50, "written", 3)):
        said(float(t), kind, days)
    assert journal.least_ages("written", now=70.0) == [
        ("j1", {"proposal": 50.0}, 20.0),
        ("j1", {"proposal": 100.0}, 360.0),
    ]
    assert journal.least_ages("written", now=5.0)[0][2] == 0.0
    assert journal.least_ages("none", now=70.0) == []


@pytest.mark.parametrize(("most", "read"), [(1, [7]), (2, [3, 7]), (3, [1, 4, 7]), (7, list(range(1, 8))), (0, [7])])
def test_a_history_is_thinned_evenly_to_what_is_asked_for_and_keeps_the_newest(
    journal: Journal, most: int, read: list[int]
) -> None:
    for minute in range(7):
        journal.add_history(NOW + timedelta(minutes=minute), 60.0 * minute, None, {})
    reader = HistoryReader(journal.path)
    assert reader.chosen(None, None, most) == read
    assert reader.chosen(NOW + timedelta(minutes=2), NOW + timedelta(minutes=3), 9) == [3, 4]


def test_ids_that_leave_no_room_for_more_are_damage(tmp_path: Path) -> None:
    first = journal_at(tmp_path / "journal.db")
    first._db.execute(
        "INSERT INTO events(id, time, t, kind, text, evidence) VALUES (?, '', 0, '', '', '{}')", (2**63 - 1,)
    )
    first.close()
    second = journal_at(tmp_path / "journal.db")
    assert second.set_aside.startswith("journal.db.damaged-")
    assert second.add_event(NOW, 0.0, "clock", None, "", {}) == 1


def test_ids_go_on_over_a_restart_and_where_a_file_is_begun_anew_under_way(tmp_path: Path) -> None:
    journal = journal_at(tmp_path / "journal.db", lambda: 0.0)
    finding = DriftFinding(0, "gain", 1.02, 0.0, np.zeros((2, 2)), 40, 0.99)
    assert [journal.add_proposal(NOW, "j1", "0a", "0b", finding) for _ in range(2)] == [1, 2]
    journal.failed(sqlite3.DatabaseError("database disk image is malformed"))
    journal.probe()
    assert journal.proposals() == []
    journal.decide(2, NOW, "approved", "ann")
    assert journal.add_proposal(NOW, "j1", "0a", "0b", finding) == 3
    journal.close()
    assert [row.proposal.state for row in journal_at(tmp_path / "journal.db").proposals()] == ["pending"]


@pytest.mark.parametrize("how", ["moved", "another", "older copy", "no journal"])
def test_a_journal_whose_name_another_file_has_taken_goes_on_in_that_one(tmp_path: Path, how: str) -> None:
    now, path = [0.0], tmp_path / "journal.db"

    def keep(text: str) -> int:
        return journal.add_event(NOW, now[0], "clock", None, text, {})

    journal = journal_at(path, lambda: now[0])
    keep("of before")
    if how == "another":
        journal_at(tmp_path / "taken.db").close()
    if how == "older copy":
        with sqlite3.connect(path) as source, sqlite3.connect(tmp_path / "taken.db") as copy:
            source.backup(copy)
    if how == "no journal":
        (tmp_path / "taken.db").write_text("not a database, for longer than the header of one " * 9)
    path.rename(tmp_path / "away.db")
    if how != "moved":
        (tmp_path / "taken.db").rename(path)

    number = keep("on the way")
    assert journal.trouble == f"the journal cannot be written: {path} was moved, or replaced by another file"
    for now[0] in (1.0, 2.0, 3.0):
        journal.probe()
    assert (journal.trouble, journal.waiting) == ("", 0)
    assert keep("of after") == number + 1
    kept = [*{"older copy": ["of before"]}.get(how, []), "on the way", "of after"]
    assert [event.text for event in journal.events()] == kept
    journal.close()
    with sqlite3.connect(tmp_path / "away.db") as away:
        assert away.execute("SELECT text FROM events").fetchall() == [("of before",)]
    assert bool(journal.set_aside) == (how == "no journal")
