"""The daemon's journal: events, proposals, decisions, estimates over time and the observer's state, in one SQLite file.

Events, proposals and decisions are append-only (SQLite triggers refuse changes). Rows that belong together are written
in one transaction: a kill at any moment leaves all of them or none.

Nobody waits for the disk: transactions queue, in their order, for a thread that owns the file. What they say counts,
for proposals and the API, once they are on disk; a write that fails is tried again, and a disk that does not answer
shows in `trouble`.
"""

import json
import logging
import sqlite3
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar, cast

from armlink.content.atomic_file import file_identity
from armlink.errors import BadInput
from calib.daemon.environment import RETRY_SECONDS, Worker
from calib.daemon.state.journal_rows import PROPOSALS, HistoryReader, ProposalRow, proposal_of, utc_text
from calib.daemon.view import EventRecord
from calib.observer.decision import DriftFinding
from calib.records.database import ANSWER_SECONDS, append_only

R = TypeVar("R")

SCHEMA = 1
LOCK_SECONDS = 0.05
"""Wait for another program's lock [s]; what cannot be kept now is kept later."""
SILENT_SECONDS = 2.0
"""A disk that takes longer for a write is said to be in trouble [s]: four times what the SD specification (4.6.2.2)
allows a card for one."""
MOST_WAITING = 10_000
"""Transactions that wait for the disk; beyond it the oldest that hold nothing but events, which the process's log has
too, and history give way."""
LARGEST_ROW = 2**53 - 1
"""The largest whole number that JSON carries everywhere (RFC 8259, section 6)."""
MOST_PROPOSALS = 1000
"""Proposals in memory, the newest; of an older one nothing can be decided any more."""
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
_BELIEF = "INSERT OR REPLACE INTO belief(one, time, calibration, gravity, state) VALUES (1, ?, ?, ?, ?)"
_APPEND_ONLY = ("events", "proposals", "decisions")

log = logging.getLogger("armlink.daemon")


@dataclass(frozen=True)
class SavedBelief:
    """The observer's saved state, and the records that it is relative to."""

    calibration: str | None
    gravity: str | None
    state: dict[str, Any]


@dataclass
class Transaction:
    """Rows that are on disk together or not at all."""

    statements: list[tuple[str, tuple[Any, ...]]] = field(default_factory=list)
    kept: list[Callable[[], object]] = field(default_factory=list)
    """To be called once it is on disk."""
    proposals: set[int] = field(default_factory=set)
    """Those that it adds or decides."""


class Journal:
    """One process writes it; any other may read it. `_db` is for the thread that `run` gives work to."""

    def __init__(self, path: Path, monotonic: Callable[[], float], run: Worker) -> None:
        """Open or create it; raises BadInput if that is not possible. `monotonic` is the clock of retries [s].

        One that is damaged is set aside, under another name, and a new one is begun.
        """
        self.path, self._monotonic, self._run = path, monotonic, run
        self._reader = HistoryReader(path)
        self._failed_at, self._asked_at = -float("inf"), float("inf")
        self._took = 0.0
        """Duration of the last write [s]."""
        self._failure = ""
        self._queue: deque[Transaction] = deque()
        self._asked = 0
        """Transactions, the first of the queue, that are being written."""
        self._open_one: Transaction | None = None
        self._refused = False
        """The schema refuses a row of the queue: transactions are written one by one, to find out which."""
        self._rows: dict[int, ProposalRow] = {}
        self._unread = True
        """Something was written since the proposals were read."""
        self._last_event = self._next_event = self._next_proposal = 0
        self._belief: tuple[str | None, str | None, str] | None = None
        self.set_aside = ""
        """Name of a damaged journal that was set aside; empty if none was."""
        self._damaged = self._replaced = False
        self._file: tuple[int, int] | None = None
        """Device and inode of the file that is open; one of another program may take its name."""
        self._db: sqlite3.Connection = None  # type: ignore[assignment]
        try:
            self._open()
        except (sqlite3.DatabaseError, OSError, UnicodeDecodeError) as error:
            self._damaged = _is_damage(error)
            if not self._damaged:
                raise self._not_opened(error) from None
            self._reopen()

    @property
    def trouble(self) -> str:
        """Why nothing is kept, in one line; empty while it is."""
        if self._failure:
            return self._failure
        waited = self._monotonic() - self._asked_at if self._asked else 0.0
        if waited > SILENT_SECONDS:
            return f"the journal cannot be written: the disk has not answered for {waited:.0f} s"
        if self._took > SILENT_SECONDS:
            return f"the journal can hardly be written, since the disk took {self._took:.0f} s for the last write"
        return ""

    def require_writable(self) -> None:
        """Raise sqlite3.OperationalError after a write that failed; a disk that takes long may be waited for."""
        if self._failure:
            raise sqlite3.OperationalError(self._failure)

    @property
    def waiting(self) -> int:
        return len(self._queue)

    @property
    def deciding(self) -> set[int]:
        """Proposals of which something is not on disk yet."""
        return {number for each in self._queue for number in each.proposals}

    def _not_opened(self, error: Exception) -> BadInput:
        return BadInput(f"{self.path}: the journal cannot be opened: {error}")

    def _reopen(self) -> None:
        """Go over to the file that has the journal's name now or, if that is damaged, set it aside and begin another.

        Raises BadInput if that is not possible.
        """
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        aside = self.path.with_name(f"{self.path.name}.damaged-{stamp}")
        try:
            if not self._damaged:
                # its write-ahead log, which SQLite leaves where the file was moved, would be taken for the new file's
                with suppress(sqlite3.ProgrammingError):  # closed by an attempt before
                    self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            if self._db is not None:
                self._db.close()
            for suffix in ("", "-wal", "-shm") if self._damaged else ():
                with suppress(FileNotFoundError):
                    self.path.with_name(self.path.name + suffix).rename(aside.with_name(aside.name + suffix))
            self._open()
        except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
            self._damaged = self._damaged or _is_damage(error)
            raise self._not_opened(error) from None
        self.set_aside = aside.name if self._damaged else self.set_aside
        self._damaged = self._replaced = False

    def _open(self) -> None:
        path = self.path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._db = sqlite3.connect(path, isolation_level=None, timeout=ANSWER_SECONDS, check_same_thread=False)
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"cache_size=-{CACHE_KB}"):
            self._db.execute(f"PRAGMA {pragma}")
        found = self._db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if found != "ok":
            raise sqlite3.DatabaseError(f"malformed: {found}")
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version not in (0, SCHEMA):
            raise BadInput(
                f"{path}: the journal has schema {version}, but this program writes schema {SCHEMA}: use the "
                "version of armlink that wrote the journal"
            )
        with self._committed():
            for statement in filter(str.strip, _TABLES.split(";")):
                self._db.execute(statement)
            for statement in chain.from_iterable(append_only(table, "sqlite") for table in _APPEND_ONLY):
                self._db.execute(statement)
            self._db.execute(f"PRAGMA user_version={SCHEMA}")
        self._file = file_identity(path)
        self._db.execute(f"PRAGMA busy_timeout={int(LOCK_SECONDS * 1000)}")
        self._read_proposals()
        newest = "SELECT COALESCE(MAX(id), 0) FROM "
        event, proposal = (int(self._db.execute(newest + table).fetchone()[0]) for table in ("events", "proposals"))
        if max(event, proposal) > LARGEST_ROW:
            raise sqlite3.DatabaseError("malformed: an unknown id")
        if not self._next_event:
            self._belief = self._db.execute("SELECT calibration, gravity, state FROM belief").fetchone()
        # ids go on where a file is begun anew, or another one takes its place, under way
        self._last_event = max(self._last_event, event)
        self._next_event, self._next_proposal = (
            max(number, one + 1) for number, one in ((self._next_event, event), (self._next_proposal, proposal))
        )

    def close(self) -> None:
        """Close the file; what still waits is lost."""
        self._db.close()

    # ---- transactions

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Everything inside is kept together, soon; transactions may be nested. An exception drops all of it."""
        if self._open_one is not None:
            yield
            return
        self._open_one = made = Transaction()
        try:
            yield
        finally:
            self._open_one = None
        if not made.statements and not made.kept:
            return
        self._queue.append(made)
        self._make_room()
        self._write_on()

    def once_kept(self, act: Callable[[], object]) -> None:
        """Call `act` once the transaction under way is on disk; at once without one."""
        if self._open_one is None:
            act()
        else:
            self._open_one.kept.append(act)

    def failed(self, error: sqlite3.Error) -> None:
        """Note a failure, for the status; from any thread."""
        self._damaged = self._damaged or _is_damage(error)
        if not self._failure:
            log.error("journal: %s", error)
        self._failure = f"the journal cannot be written: {error}"
        self._failed_at = self._monotonic()

    def probe(self) -> None:
        """Try again what has failed, begin another file where it is damaged, and find out whether trouble is over."""
        if self._asked:
            return
        if self._damaged or self._replaced:
            self._ask(self._reopen, self._opened_anew)
        elif self._queue:
            self._write_on()
        elif self.trouble and self._monotonic() - self._failed_at >= RETRY_SECONDS:
            with self.transaction():
                self._write(f"PRAGMA user_version={SCHEMA}")

    def _write(self, statement: str, *values: Any, proposal: int | None = None) -> None:
        """Add a row to the transaction under way, or make one of it."""
        with self.transaction():
            transaction = cast(Transaction, self._open_one)
            transaction.statements.append((statement, values))
            if proposal is not None:
                transaction.proposals.add(proposal)

    def _make_room(self) -> None:
        if len(self._queue) <= MOST_WAITING:
            return
        for number in range(self._asked, len(self._queue)):
            if not self._queue[number].proposals:
                del self._queue[number]
                return

    def _write_on(self) -> None:
        """Write all that waits, in one go: a slow disk takes as long for one row as for a thousand."""
        if self._asked or not self._queue or self._damaged or self._replaced:
            return
        if self._failure and self._monotonic() - self._failed_at < RETRY_SECONDS:
            return
        batch = tuple(self._queue)[: 1 if self._refused else None]
        self._ask(lambda: self._commit(batch), self._committed_or_not, len(batch))

    def _ask(self, work: Callable[[], R], done: Callable[[R | Exception], None], asked: int = 1) -> None:
        """Give the thread work: for `asked` transactions of the queue, or another one."""

        def back(outcome: R | Exception) -> None:
            self._asked, self._took = 0, self._monotonic() - self._asked_at
            if isinstance(outcome, Exception) and not isinstance(outcome, sqlite3.Error | BadInput):
                raise outcome
            done(outcome)

        self._asked, self._asked_at = asked, self._monotonic()
        self._run(work, back)

    def _commit(self, batch: tuple[Transaction, ...]) -> tuple[int, sqlite3.Error | None]:
        """On the thread: everything is on disk, or nothing is and sqlite3.Error is raised.

        Returns the number of transactions, and the error where the proposals could not be read afterwards.
        """
        self._require_same_file()
        with self._committed():
            for transaction in batch:
                for statement, values in transaction.statements:
                    self._db.execute(statement, values)
        self._require_same_file()  # what was committed to another one is lost
        self._unread = self._unread or any(transaction.proposals for transaction in batch)
        try:
            if self._unread:
                self._read_proposals()
        except sqlite3.Error as error:
            return len(batch), error
        return len(batch), None

    def _require_same_file(self) -> None:
        """Raise sqlite3.OperationalError where the file that is open has lost its name."""
        if file_identity(self.path) != self._file:
            self._replaced = True
            raise sqlite3.OperationalError(f"{self.path} was moved, or replaced by another file")

    @contextmanager
    def _committed(self) -> Iterator[None]:
        try:
            self._db.execute("BEGIN IMMEDIATE")
            yield
            self._db.execute("COMMIT")
        except BaseException:
            with suppress(sqlite3.Error):
                self._db.rollback()
            raise

    def _committed_or_not(self, outcome: tuple[int, sqlite3.Error | None] | Exception) -> None:
        if isinstance(outcome, sqlite3.IntegrityError):
            if self._refused:
                log.error("journal: a row is left out (%s): %s", outcome, self._queue.popleft().statements)
            self._refused = not self._refused
            self._write_on()
            return
        if isinstance(outcome, Exception):
            self.failed(cast(sqlite3.Error, outcome))
            return
        count, unread = outcome
        self._failure = ""
        if unread is not None:
            self.failed(unread)
        acts = [act for _ in range(count) for act in self._queue.popleft().kept]
        for act in acts:
            act()
        self._write_on()

    def _opened_anew(self, outcome: Exception | None) -> None:
        self._failure = ""
        if isinstance(outcome, Exception):
            self.failed(sqlite3.OperationalError(str(outcome)))
        self._write_on()

    def _read_proposals(self) -> None:
        """The newest, newest first; raises sqlite3.Error, also for rows that are damaged and still rows."""
        query = PROPOSALS + " ORDER BY p.id DESC LIMIT ?"
        self._rows = {row.id: row for row in self._read(proposal_of, query, (MOST_PROPOSALS,))}
        self._unread = False

    def _read(self, take: Callable[[tuple[Any, ...]], R], query: str, values: tuple[Any, ...]) -> list[R]:
        """Rows as `take` makes them; on the thread, or before there is work for it."""
        return _made(take, self._db.execute(query, values))

    # ---- events

    def add_event(
        self, time: datetime, t: float, kind: str, joint: str | None, text: str, evidence: dict[str, Any]
    ) -> int:
        number, self._next_event = self._next_event, self._next_event + 1
        statement = "INSERT INTO events(id, time, t, kind, joint, text, evidence) VALUES (?, ?, ?, ?, ?, ?, ?)"
        with self.transaction():
            self._write(statement, number, utc_text(time), t, kind, joint, text, json.dumps(evidence))
            self.once_kept(lambda: setattr(self, "_last_event", max(self._last_event, number)))
        return number

    def events(self, after: int = 0, limit: int = 500) -> list[EventRecord]:
        """Events on disk with a larger id, oldest first; raises sqlite3.Error. From any thread."""
        try:
            return _made(_event, self._reader.events(max(-(2**63), min(after, 2**63 - 1)), limit))
        except sqlite3.Error as error:
            if _is_damage(error):
                self.failed(error)
            raise

    @property
    def last_event(self) -> int:
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

    def add_proposal(self, time: datetime, joint: str, record: str, base: str, finding: DriftFinding) -> int:
        """Append a pending proposal and return its id; earlier pending ones of the joint are superseded."""
        number, self._next_proposal = self._next_proposal, self._next_proposal + 1
        statement = "INSERT INTO proposals(id, time, joint, record, base, finding) VALUES (?, ?, ?, ?, ?, ?)"
        values = utc_text(time), joint, record, base, json.dumps(finding.as_json())
        with self.transaction():
            for earlier in self.proposals():
                if earlier.proposal.joint == joint and earlier.proposal.state == "pending":
                    self.decide(earlier.id, time, "superseded", "daemon", "replaced by a newer proposal")
            self._write(statement, number, *values, proposal=number)
        return number

    def decide(self, proposal: int, time: datetime, state: str, by: str, note: str = "") -> None:
        """Append a decision: the newest one is the proposal's state. None where a new journal lacks the proposal."""
        statement = (
            "INSERT INTO decisions(proposal, time, state, by, note) SELECT ?, ?, ?, ?, ? "
            "WHERE EXISTS (SELECT 1 FROM proposals WHERE id = ?)"
        )
        self._write(statement, proposal, utc_text(time), state, by, note, proposal, proposal=proposal)

    def proposals(self, limit: int = 200) -> list[ProposalRow]:
        return list(self._rows.values())[:limit]

    def pending(self) -> int:
        return sum(row.proposal.state == "pending" for row in self.proposals())

    def proposal(self, number: int) -> ProposalRow | None:
        return self._rows.get(number)

    def proposal_numbered(self, number: int) -> ProposalRow | None:
        return next((row for row in self._rows.values() if row.proposal.id == number), None)

    # ---- belief and history

    def save_belief(self, time: datetime, calibration: str | None, gravity: str | None, state: dict[str, Any]) -> None:
        """Replace the observer's saved state, whole or not at all."""
        self._belief = calibration, gravity, json.dumps(state)
        for waits in list(self._queue)[self._asked :]:  # this one takes their place
            waits.statements = [each for each in waits.statements if each[0] is not _BELIEF]
        self._write(_BELIEF, utc_text(time), *self._belief)

    def belief(self) -> SavedBelief | None:
        """The observer's saved state; None if there is none or it cannot be read."""
        row = self._belief
        try:
            return None if row is None else SavedBelief(row[0], row[1], json.loads(row[2]))
        except (ValueError, TypeError):
            return None

    def add_history(self, time: datetime, t: float, record: str | None, estimate: dict[str, Any]) -> None:
        statement = "INSERT INTO history(time, t, record, estimate) VALUES (?, ?, ?, ?)"
        self._write(statement, utc_text(time), t, record, json.dumps(estimate))

    def thin_history(self, before: datetime, keep_every: int) -> None:
        """Keep one in `keep_every` of the estimates before a time."""
        self._write("DELETE FROM history WHERE time < ? AND id % ? != 0", utc_text(before), keep_every)


def _made(take: Callable[[tuple[Any, ...]], R], rows: Iterable[tuple[Any, ...]]) -> list[R]:
    """Rows as `take` makes them; raises sqlite3.Error where one is damaged."""
    try:
        return [take(row) for row in rows]
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise sqlite3.DatabaseError(f"a malformed row ({type(error).__name__})") from None


def _is_damage(error: Exception) -> bool:
    """Whether a file is none that SQLite can read; UnicodeDecodeError is of its message that quotes the file."""
    words = ("malformed", "not a database", "decode to UTF-8")
    return isinstance(error, UnicodeDecodeError) or any(each in str(error) for each in words)


def _event(row: tuple[Any, ...]) -> EventRecord:
    number, time, t, kind, joint, text, evidence = row
    return EventRecord(id=number, time=time, t=t, kind=kind, joint=joint, text=text, evidence=json.loads(evidence))


def _aged(row: tuple[Any, ...]) -> tuple[float, str | None, dict[str, Any] | None]:
    t, joint, evidence = row
    return float(t), joint, None if evidence is None else dict(json.loads(evidence))
