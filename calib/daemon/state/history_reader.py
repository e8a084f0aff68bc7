"""Reads the journal's events and history from any thread, on connections of its own: no answer holds anybody up."""

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

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
        span = (_iso(since) if since else "", _iso(until) if until else "9999")
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


def _iso(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="microseconds")
