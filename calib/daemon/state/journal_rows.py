"""Rows of the journal as others get them, and the reader of events and history from any thread."""

import hashlib
import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from calib.daemon.view import Proposal
from calib.observer.decision import DriftFinding
from calib.records.records import number_of


@dataclass(frozen=True)
class ProposalRow:
    id: int
    """Its row in this journal; a journal that is begun anew counts from 1 again, so that nobody outside knows it."""
    finding: DriftFinding
    """The drift that it was made from."""
    proposal: Proposal


PROPOSALS = (
    "SELECT p.id, p.time, p.joint, p.record, p.base, p.finding, d.state, d.by, d.time, d.note FROM proposals p "
    "LEFT JOIN decisions d ON d.id = (SELECT MAX(id) FROM decisions WHERE proposal = p.id)"
)
"""Columns that `proposal_of` takes."""


def proposal_of(row: tuple[Any, ...]) -> ProposalRow:
    """A row of PROPOSALS; raises ValueError, TypeError, KeyError or IndexError for one that holds something else."""
    number, opened, joint, record, base, found, state, by, decided, note = row
    values = json.loads(found)
    decides = json.dumps([joint, record, base, values], sort_keys=True)
    finding = DriftFinding.from_json(values)
    gain_std, offset_std = finding.std
    proposal = Proposal(
        id=number_of(record),
        hash=hashlib.sha256(decides.encode()).hexdigest(),
        time=datetime.fromisoformat(opened),
        state=state or "pending",
        joint=joint,
        cause=finding.cause,
        gain=finding.gain,
        gain_std=gain_std,
        offset=finding.offset,
        offset_std=offset_std,
        rows=finding.rows,
        confidence=finding.confidence,
        record=record,
        base=base,
        decided_at=None if decided is None else datetime.fromisoformat(decided),
        decided_by=by,
        note=note or "",
    )
    return ProposalRow(number, finding, proposal)


HistoryRow = tuple[datetime, float, str | None, dict[str, Any]]
"""Time, monotonic time [s], record id, estimates of all joints."""
PAGE = 100
"""Rows that are in memory at a time, and are made JSON of without letting other threads run."""
LOCK_SECONDS = 2.0
"""Wait for another program's lock [s]."""


class HistoryReader:
    """Every call opens the file, so that none keeps the journal from cleaning up. Raises sqlite3.Error."""

    def __init__(self, path: Path) -> None:
        self._url = f"file:{quote(str(path.resolve()))}?mode=ro"

    def chosen(self, since: datetime | None, until: datetime | None, most: int) -> list[int]:
        """Ids of a time span's rows, oldest first, thinned evenly to at most `most`; always includes the newest."""
        span = (utc_text(since) if since else "", utc_text(until) if until else "9999")
        found = self._rows("SELECT id FROM history WHERE time >= ? AND time <= ? ORDER BY id DESC", span)
        step = max(1, -(-len(found) // max(most, 1)))
        return [number for (number,) in found[::step]][::-1]

    def events(self, after: int, limit: int) -> list[tuple[Any, ...]]:
        """Rows (id, time, t, kind, joint, text, evidence) with a larger id, oldest first."""
        query = "SELECT id, time, t, kind, joint, text, evidence FROM events WHERE id > ? ORDER BY id LIMIT ?"
        return self._rows(query, (after, limit))

    def pages(self, ids: Sequence[int]) -> Iterator[list[HistoryRow]]:
        """The rows of these ids, in their order, PAGE at a time; those thinned out or damaged are left out."""
        for begin in range(0, len(ids), PAGE):
            page = ids[begin : begin + PAGE]
            marks = ",".join("?" * len(page))
            query = f"SELECT time, t, record, estimate FROM history WHERE id IN ({marks}) ORDER BY id"
            yield [row for row in map(_row, self._rows(query, tuple(page))) if row is not None]

    def _rows(self, query: str, values: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        with closing(sqlite3.connect(self._url, uri=True, timeout=LOCK_SECONDS)) as db:
            return db.execute(query, values).fetchall()


def _row(found: tuple[Any, ...]) -> HistoryRow | None:
    time, t, record, estimate = found
    try:
        return datetime.fromisoformat(time), t, record, json.loads(estimate)
    except (ValueError, TypeError):
        return None


def utc_text(time: datetime) -> str:
    """UTC with microseconds: sorts as text."""
    return time.astimezone(UTC).isoformat(timespec="microseconds")
