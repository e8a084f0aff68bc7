"""Answers that are read from the disk: in threads of their own; long ones page by page as the client takes them."""

import asyncio
import sqlite3
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from fastapi.responses import StreamingResponse
from pydantic import TypeAdapter

from calib.daemon.view import DaemonView, HistoryPoint
from calib.daemon.web.parameters import HistoryQuery

MOST_ANSWERS, MOST_OF_AN_OWNER = 16, 12
"""Long answers under way, in all and of one process or address; each has one page in memory."""
DISK_SECONDS = 5.0
"""A short answer that the disk has not given within this time is given up; a decision that is not on it by then is
answered with "not yet" [s]."""
_POINTS = TypeAdapter(tuple[HistoryPoint, ...])
T = TypeVar("T")


class TooMany(Exception):
    """No room for another client (HTTP 429)."""


class Histories:
    """GET /api/history, and whatever else reads the history."""

    def __init__(self, view: DaemonView) -> None:
        self._view, self._under_way = view, Counter[str]()
        self._thread = ThreadPoolExecutor(1, "history")
        self._short = ThreadPoolExecutor(1, "events")

    async def short(self, work: Callable[[], T]) -> T:
        """The value of `work`, which reads little, not behind long answers; raises sqlite3.Error, also if it waits."""
        try:
            async with asyncio.timeout(DISK_SECONDS):
                return await asyncio.get_running_loop().run_in_executor(self._short, work)
        except TimeoutError:
            raise sqlite3.OperationalError(f"the disk has not answered for {DISK_SECONDS:.0f} s") from None

    async def aside(self, owner: str, work: Callable[[], T]) -> T:
        """The value of `work`, which reads history, from the thread; raises TooMany and what `work` raises."""
        self._enter(owner)
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, work)
        finally:
            self._under_way[owner] -= 1

    async def answer(self, owner: str, query: HistoryQuery) -> StreamingResponse:
        """The points that a query asks for; raises NoSuch, TooMany."""
        pages = self._view.history_pages(query.joint or None, query.since, query.until, query.limit)
        return await self.send(owner, _as_json(pages), bytes, "application/json")

    async def send(
        self,
        owner: str,
        pages: Iterator[T],
        encode: Callable[[T], bytes],
        media_type: str,
        headers: dict[str, str] | None = None,
    ) -> StreamingResponse:
        """Pages as they are encoded, in the thread, one at a time; raises TooMany and what the first one raises."""
        pieces = (encode(page) for page in pages)
        first = await self.aside(owner, lambda: next(pieces, None))
        return StreamingResponse(self._body(owner, first, pieces), media_type=media_type, headers=headers)

    async def _body(self, owner: str, piece: bytes | None, pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
        self._under_way[owner] += 1
        try:
            while piece is not None:
                yield piece
                piece = await asyncio.get_running_loop().run_in_executor(self._thread, next, pieces, None)
        finally:
            self._under_way[owner] -= 1

    def _enter(self, owner: str) -> None:
        self._under_way = +self._under_way
        if self._under_way.total() >= MOST_ANSWERS or self._under_way[owner] >= MOST_OF_AN_OWNER:
            raise TooMany(f"{self._under_way.total()} long answers are already under way: ask again in a moment")
        self._under_way[owner] += 1


def _as_json(pages: Iterator[tuple[HistoryPoint, ...]]) -> Iterator[bytes]:
    separator = b"["
    for page in pages:
        if page:
            yield separator + _POINTS.dump_json(page)[1:-1]
            separator = b","
    yield b"[]" if separator == b"[" else b"]"
