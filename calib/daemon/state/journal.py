"""The daemon's journal: events, proposals, decisions, estimates over time and the observer's state, in one SQLite file.

Events, proposals and decisions are append-only (SQLite triggers refuse changes). Rows that belong together are written
in one transaction: a kill at any moment leaves all of them or none.
"""

import json
import logging
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from armlink.errors import BadInput
from calib.daemon.state.proposal_row import PROPOSALS, ProposalRow, proposal_of
from calib.daemon.view.api_models import EventRecord
from calib.observer.decision import Finding

R = TypeVar("R")

SCHEMA = 1
LOCK_SECONDS = 0.05
"""Wait for another program's lock, on the event loop [s]; events that cannot be kept now are kept later."""
OPEN_SECONDS = 10.0
"""Likewise at the start [s]."""
RETRY_SECONDS = 1.0
"""After a failure nothing is written for this time, so that a lock does not hold the event loop at every write [s]."""
CACHE_KB = 256
"""SQLite's page cache: the default 2 MB fills over days, which looks like a memory leak."""
AGED_EVENTS = 20_000
"""Events whose age is asked for: of a daemon that says 20 faults an hour, those of a month."""
_TABLES = """
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY AUTOINCREMENT, time TEXT NOT NULL, t REAL NOT NULL, kind TEXT NOT NULL, joint TEXT,
    text TEXT NOT NULL, evidence TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS proposals (
    id INTEGER PRIMARY KEY AUTOINCREMENT, time TEXT NOT NULL, joint TEXT NOT NULL, record TEXT NOT NULL,
    base TEXT NOT NULL, finding TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS decisions (
    id INTEGER PRIMARY KEY AUTOINCREMENT, proposal INTEGER NOT NULL REFERENCES proposals(id), time TEXT NOT NULL,
    state TEXT NOT NULL, by TEXT NOT NULL, note TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS history (
    id INTEGER PRIMARY KEY AUTOINCREMENT, time TEXT NOT NULL, t REAL NOT NULL, record TEXT, estimate TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS belief (
    one INTEGER PRIMARY KEY CHECK (one = 1), time TEXT NOT NULL, calibration TEXT, gravity TEXT, state TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS history_time ON history(time);
CREATE INDEX IF NOT EXISTS decisions_proposal ON decisions(proposal);
"""
_APPEND_ONLY = ("events", "proposals", "decisions")

log = logging.getLogger("armlink.daemon")


@dataclass(frozen=True)
class Belief:
    """The observer's saved state, and the records that it is relative to."""

    calibration: str | None
    gravity: str | None
    state: dict[str, Any]


class Journal:
    """One process writes it; any other may read it. Raises sqlite3.Error if the disk fails."""

    def __init__(self, path: Path, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Open or create it; raises BadInput if that is not possible. `monotonic` is the clock of retries [s].

        One that is damaged is set aside, under another name, and a new one is begun.
        """
        self.path, self._monotonic = path, monotonic
        self._failed_at = -float("inf")
        self._last_event = self._pending = 0
        self._after_commit: list[Callable[[], object]] = []
        self.trouble = ""
        """Why nothing can be written, in one line; empty while it can."""
        self.set_aside = ""
        """Name of a damaged journal that was set aside; empty if none was."""
        self._damaged = False
        self._db: sqlite3.Connection = None  # type: ignore[assignment]
        try:
            self._open()
        except UnicodeDecodeError:  # of SQLite's own message, which quotes what it could not read
            self._begin_anew()
        except sqlite3.DatabaseError as error:
            if not _is_damage(error):
                raise self._not_opened(error) from None
            self._begin_anew()
        except OSError as error:
            raise self._not_opened(error) from None

    def _not_opened(self, error: Exception) -> BadInput:
        return BadInput(f"{self.path}: the journal cannot be opened: {error}")

    def _begin_anew(self) -> None:
        """Set the damaged file aside and begin another; raises BadInput if that is not possible."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        aside = self.path.with_name(f"{self.path.name}.damaged-{stamp}")
        self._damaged, self.trouble = False, ""
        try:
            if self._db is not None:
                self._db.close()
            for suffix in ("", "-wal", "-shm"):
                with suppress(FileNotFoundError):
                    self.path.with_name(self.path.name + suffix).rename(aside.with_name(aside.name + suffix))
            self._open()
        except (sqlite3.Error, OSError) as error:
            raise self._not_opened(error) from None
        self.set_aside = aside.name

    def _open(self) -> None:
        path = self.path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._db = sqlite3.connect(path, isolation_level=None, timeout=OPEN_SECONDS)
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"cache_size=-{CACHE_KB}"):
            self._db.execute(f"PRAGMA {pragma}")
        found = self._db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if found != "ok":
            raise sqlite3.DatabaseError(f"malformed: {found}")
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version not in (0, SCHEMA):
            raise BadInput(f"{path}: journal of schema {version}, this program has {SCHEMA}: use its own version")
        with self.transaction():
            for statement in filter(str.strip, _TABLES.split(";")):
                self._db.execute(statement)
            for table in _APPEND_ONLY:
                for change in ("UPDATE", "DELETE"):
                    self._db.execute(
                        f"CREATE TRIGGER IF NOT EXISTS {table}_no_{change.lower()} BEFORE {change} ON {table} "
                        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
                    )
            self._db.execute(f"PRAGMA user_version={SCHEMA}")
        self._db.execute(f"PRAGMA busy_timeout={int(LOCK_SECONDS * 1000)}")

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Everything inside is on disk at its end, or nothing is; transactions may be nested.

        Raises sqlite3.Error, at once for RETRY_SECONDS after a failure.
        """
        if self._db.in_transaction:
            yield
            return
        if self.trouble and self._monotonic() - self._failed_at < RETRY_SECONDS:
            raise sqlite3.OperationalError(self.trouble)
        try:
            self._db.execute("BEGIN IMMEDIATE")
            yield
            self._db.execute("COMMIT")
        except BaseException as error:
            self._after_commit.clear()
            with suppress(sqlite3.Error):
                self._db.rollback()
            if isinstance(error, sqlite3.Error):
                self.failed(error)
            raise
        self.trouble = ""
        acts, self._after_commit = self._after_commit, []
        for act in acts:
            act()

    def once_kept(self, act: Callable[[], object]) -> None:
        """Call `act` once what is written now is on disk: at once, or at the end of the transaction; else never."""
        if self.in_transaction:
            self._after_commit.append(act)
        else:
            act()

    @property
    def in_transaction(self) -> bool:
        """Whether what is written now is on disk only with the rest of a transaction."""
        return self._db.in_transaction

    def failed(self, error: sqlite3.Error) -> None:
        """Note a failure, for the status."""
        self._damaged = self._damaged or _is_damage(error)
        if not self.trouble:
            log.error("journal: %s", error)
            self.trouble = f"the journal cannot be written: {error}"
            self._failed_at = self._monotonic()
        elif str(error) != self.trouble:
            self._failed_at = self._monotonic()

    def probe(self) -> None:
        """After a failure: find out whether it can be written again, or begin another where it is damaged."""
        if self._damaged:
            with suppress(BadInput):
                self._begin_anew()
        if self.trouble:
            with suppress(sqlite3.Error), self.transaction():
                self._db.execute(f"PRAGMA user_version={SCHEMA}")

    def guard(self, act: Callable[[], object]) -> None:
        """Call `act`, which writes; a failing disk is logged and shown in the status, and stops nothing."""
        try:
            act()
        except sqlite3.Error as error:
            self.failed(error)

    def _read(self, take: Callable[[tuple[Any, ...]], R], query: str, values: tuple[Any, ...]) -> list[R]:
        """Rows as `take` makes them; raises sqlite3.Error, and remembers damage: a page may be damaged unseen."""
        try:
            return [take(row) for row in self._db.execute(query, values)]
        except (ValueError, TypeError, KeyError, IndexError) as error:
            damage = sqlite3.DatabaseError(f"a malformed row ({type(error).__name__})")
            self.failed(damage)
            raise damage from None
        except sqlite3.Error as error:
            if _is_damage(error):
                self.failed(error)
            raise

    # ---- events

    def add_event(
        self, time: datetime, t: float, kind: str, joint: str | None, text: str, evidence: dict[str, Any]
    ) -> int:
        """Append an event and return its id."""
        row = (_iso(time), t, kind, joint, text, json.dumps(evidence))
        with self.transaction():
            cursor = self._db.execute(
                "INSERT INTO events(time, t, kind, joint, text, evidence) VALUES (?, ?, ?, ?, ?, ?)", row
            )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def events(self, after: int = 0, limit: int = 500) -> list[EventRecord]:
        """Events with a larger id, oldest first."""
        query = "SELECT id, time, t, kind, joint, text, evidence FROM events WHERE id > ? ORDER BY id LIMIT ?"
        return self._read(_event, query, (max(-(2**63), min(after, 2**63 - 1)), limit))

    @property
    def last_event(self) -> int:
        """Id of the newest event, as last read where it cannot be read now; 0 if there is none."""
        with suppress(sqlite3.Error):
            self._last_event = int(self._db.execute("SELECT COALESCE(MAX(id), 0) FROM events").fetchone()[0])
        return self._last_event

    def least_ages(self, kind: str, now: float) -> list[tuple[str | None, dict[str, Any], float]]:
        """Joint, evidence and least age [s] of the newest events of a kind, by the monotonic clock alone.

        That clock stands at `now` [s]; where it began anew, as at a restart of the machine, no time is counted.
        """
        query = "SELECT t, joint, CASE WHEN kind = ? THEN evidence END FROM events ORDER BY id DESC LIMIT ?"
        found, age, later = [], 0.0, now
        for t, joint, evidence in self._read(_aged, query, (kind, AGED_EVENTS)):
            age, later = age + max(later - t, 0.0), t
            if evidence is not None:
                found.append((joint, evidence, age))
        return found

    # ---- proposals

    def add_proposal(self, time: datetime, joint: str, record: str, base: str, finding: Finding) -> int:
        """Append a pending proposal and return its id; earlier pending ones of the joint are superseded."""
        with self.transaction():
            for earlier in self.proposals():
                if earlier.joint == joint and earlier.state == "pending":
                    self.decide(earlier.id, time, "superseded", "daemon", "a newer proposal")
            cursor = self._db.execute(
                "INSERT INTO proposals(time, joint, record, base, finding) VALUES (?, ?, ?, ?, ?)",
                (_iso(time), joint, record, base, json.dumps(finding.as_json())),
            )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def decide(self, proposal: int, time: datetime, state: str, by: str, note: str = "") -> None:
        """Append a decision: the newest one is the proposal's state."""
        with self.transaction():
            self._db.execute(
                "INSERT INTO decisions(proposal, time, state, by, note) VALUES (?, ?, ?, ?, ?)",
                (proposal, _iso(time), state, by, note),
            )

    def proposals(self, limit: int = 200) -> list[ProposalRow]:
        """Newest first."""
        return self._read(proposal_of, PROPOSALS + " ORDER BY p.id DESC LIMIT ?", (limit,))

    def pending(self) -> int:
        """Number of pending proposals, as last read where they cannot be read now."""
        with suppress(sqlite3.Error):
            self._pending = sum(row.state == "pending" for row in self.proposals())
        return self._pending

    def proposal(self, number: int) -> ProposalRow | None:
        """The proposal of that id."""
        if not 0 < number < 2**63:
            return None
        return next(iter(self._read(proposal_of, PROPOSALS + " WHERE p.id = ?", (number,))), None)

    def proposal_of(self, record: str) -> ProposalRow | None:
        """The newest proposal of that record."""
        found = self._read(proposal_of, PROPOSALS + " WHERE p.record = ? ORDER BY p.id DESC LIMIT 1", (record,))
        return next(iter(found), None)

    # ---- belief and history

    def save_belief(self, time: datetime, calibration: str | None, gravity: str | None, state: dict[str, Any]) -> None:
        """Replace the observer's saved state, whole or not at all."""
        with self.transaction():
            self._db.execute(
                "INSERT OR REPLACE INTO belief(one, time, calibration, gravity, state) VALUES (1, ?, ?, ?, ?)",
                (_iso(time), calibration, gravity, json.dumps(state)),
            )

    def belief(self) -> Belief | None:
        """The observer's saved state; None if there is none or it cannot be read."""
        row = self._db.execute("SELECT calibration, gravity, state FROM belief").fetchone()
        try:
            return None if row is None else Belief(row[0], row[1], json.loads(row[2]))
        except ValueError:
            return None

    def add_history(self, time: datetime, t: float, record: str | None, estimate: dict[str, Any]) -> None:
        """Append the estimates of all joints."""
        with self.transaction():
            self._db.execute(
                "INSERT INTO history(time, t, record, estimate) VALUES (?, ?, ?, ?)",
                (_iso(time), t, record, json.dumps(estimate)),
            )

    def thin_history(self, before: datetime, keep_every: int) -> None:
        """Keep one in `keep_every` of the estimates before a time."""
        with self.transaction():
            self._db.execute("DELETE FROM history WHERE time < ? AND id % ? != 0", (_iso(before), keep_every))


def _is_damage(error: sqlite3.Error) -> bool:
    return any(words in str(error) for words in ("malformed", "not a database", "decode to UTF-8"))


def _event(row: tuple[Any, ...]) -> EventRecord:
    number, time, t, kind, joint, text, evidence = row
    return EventRecord(id=number, time=time, t=t, kind=kind, joint=joint, text=text, evidence=json.loads(evidence))


def _aged(row: tuple[Any, ...]) -> tuple[float, str | None, dict[str, Any] | None]:
    t, joint, evidence = row
    return float(t), joint, None if evidence is None else dict(json.loads(evidence))


def _iso(time: datetime) -> str:
    """UTC with microseconds: sorts as text."""
    return time.astimezone(UTC).isoformat(timespec="microseconds")
