"""Queries, and answers that are read from the disk or are long: in threads of their own.

Parameters are typed: unknown names, empty values and times without a zone are handled here. Long answers are sent page
by page as the client takes them; the readings of the last minutes as JSON for the page, as CSV and MCAP to keep.
"""

import asyncio
import csv
import io
import re
import sqlite3
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from fastapi import APIRouter, Query
from fastapi.responses import Response, StreamingResponse
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    model_validator,
)

from armlink.recording.joint_messages import TOPICS
from armlink.recording.mcap import RecordingWriter
from calib.daemon.view import DaemonView, HistoryPoint, Window, WindowRows
from calib.daemon.web.connection import Owner
from gcomp.arrays import Array

LARGEST_ID = 2**63 - 1
"""Largest integer of SQLite."""
EARLIEST, LATEST = datetime(1970, 1, 2, tzinfo=UTC), datetime(2999, 12, 31, tzinfo=UTC)

Id = Annotated[int, Field(ge=0, le=LARGEST_ID)]


class ApiError(BaseModel):
    """Every refusal of a request; what is not HTTP, and a connection too many, are answered in plain text."""

    error: str
    """One line: the problem, and what was expected."""


def _empty_is_none(value: Any) -> Any:
    return None if value == "" else value


def _plus_sent_as_space(value: Any) -> Any:
    """A + that is not escaped as %2B arrives as a space: 2026-01-01T08:00:00 02:00."""
    return re.sub(r"(?<=[T ]\d\d:\d\d)(:[\d.]+)? (?=\d\d:\d\d$)", r"\1+", value) if isinstance(value, str) else value


def _in_range(value: datetime) -> datetime:
    if not EARLIEST <= value <= LATEST:
        raise ValueError(f"expected a time between {EARLIEST.year} and {LATEST.year}")
    return value


Instant = Annotated[
    Annotated[AwareDatetime, AfterValidator(_in_range)] | None,
    BeforeValidator(_plus_sent_as_space),
    BeforeValidator(_empty_is_none),
    Field(description="ISO 8601 with zone, for example 2026-05-01T08:00:00Z; empty for no limit"),
]


class _Query(BaseModel):
    model_config = ConfigDict(extra="forbid")


class EventsQuery(_Query):
    """GET /api/events."""

    after: Annotated[Id, BeforeValidator(lambda value: 0 if value == "" else value)] = 0
    """Events with a larger id."""
    limit: Annotated[int, Field(ge=1, le=1000)] = 500
    """Largest number of events, oldest first; ask again after the last id for more."""


class HistoryQuery(_Query):
    """GET /api/history."""

    joint: Annotated[str, Field(max_length=200, description="name of a joint; empty for every joint")] = ""
    since: Annotated[Instant, Field(alias="from")] = None
    until: Annotated[Instant, Field(alias="to")] = None
    limit: Annotated[int, Field(ge=2, le=20000)] = 2000
    """Largest number of points per joint, thinned evenly."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.since is not None and self.until is not None and self.since > self.until:
            raise ValueError("parameter `from` must not be later than parameter `to`")
        return self


class OverviewQuery(_Query):
    """GET /api/overview."""

    seconds: Annotated[float, Field(ge=0, le=1e9)] = 3600.0
    """Time span of the history [s]; 0: all of it."""
    limit: Annotated[int, Field(ge=2, le=2000)] = 120
    """Largest number of history points per joint, thinned evenly."""
    events: Annotated[int, Field(ge=1, le=500)] = 500
    """Largest number of events."""


class WindowQuery(_Query):
    """GET /api/window, as JSON, CSV or MCAP."""

    seconds: Annotated[float, Field(gt=0, le=600)] = 600.0
    """Time span that ends with the newest reading [s]."""
    limit: Annotated[int, Field(ge=2, le=6001)] = 6001
    """Largest number of rows, thinned evenly."""


class StreamQuery(_Query):
    """GET /api/stream."""

    after: Annotated[Id | None, BeforeValidator(_empty_is_none)] = None
    """Begin with all events after this id, like the header Last-Event-ID; without it: only new ones."""


class Decision(BaseModel):
    """Body of approve and reject; optional."""

    model_config = ConfigDict(extra="forbid")

    by: Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[^\x00-\x1f\x7f]+$")] | None = None
    """Who decides, for the audit trail."""
    hash: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """`hash` of the proposal as it was looked at: the decision is refused (409) where the proposal is another one."""


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
    """Whatever reads the history, such as GET /api/history."""

    def __init__(self) -> None:
        self._under_way = Counter[str]()
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
        self._under_way = +self._under_way
        if self._under_way.total() >= MOST_ANSWERS or self._under_way[owner] >= MOST_OF_AN_OWNER:
            raise TooMany(f"{self._under_way.total()} long answers are already under way: ask again in a moment")
        self._under_way[owner] += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, work)
        finally:
            self._under_way[owner] -= 1

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


def points_as_json(pages: Iterator[tuple[HistoryPoint, ...]]) -> Iterator[bytes]:
    separator = b"["
    for page in pages:
        if page:
            yield separator + _POINTS.dump_json(page)[1:-1]
            separator = b","
    yield b"[]" if separator == b"[" else b"]"


COLUMNS = {"position": "q", "torque": "tau", "temperature": "temp", "model_torque": "model"}
"""Channel → prefix of its columns in CSV; q, tau and temp are those of a recording."""
MODEL_TOPICS = TOPICS | {"/model_torques": (None, None, "model_torque")}
"""In MCAP the model's torque is effort on a topic of its own."""
PIECE = 1 << 16
"""Bytes sent at once, so that a client that stops reading keeps little waiting."""
ROWS = 200
"""Rows of CSV in a piece."""
CSV, MCAP = "text/csv", "application/octet-stream"


def add_window(router: APIRouter, view: DaemonView, histories: Histories) -> None:
    """GET /api/window, /api/window.csv, /api/window.mcap."""

    @router.get("/api/window", response_model=WindowRows, tags=["past"])
    async def window(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """Readings of the last minutes, oldest first."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, iter([found]), _rows_as_json, "application/json")

    @router.get("/api/window.csv", response_class=Response, responses=_file(CSV), tags=["past"])
    async def window_csv(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """The same as a recording in CSV, with the model's torques as further columns."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, csv_lines(found), str.encode, CSV, _attached(found, "csv"))

    @router.get("/api/window.mcap", response_class=Response, responses=_file(MCAP), tags=["past"])
    async def window_mcap(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """The same as a recording in MCAP, with the model's torques as effort on /model_torques."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, mcap_pieces(found), bytes, MCAP, _attached(found, "mcap"))


def csv_lines(window: Window) -> Iterator[str]:
    """A recording in CSV, many lines at a time; columns of a channel that is missing throughout are left out."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    channels = _present(window)
    numbers = range(1, len(window.names) + 1)
    writer.writerow(["t", *(f"{COLUMNS[name]}_{k}" for name in channels for k in numbers)])
    for first in range(0, len(window.t), ROWS):
        rows = slice(first, first + ROWS)
        for t, *values in zip(window.t[rows], *(each[rows] for each in channels.values()), strict=True):
            writer.writerow([f"{t:.6f}", *(f"{x:.7g}" for row in values for x in row)])
        yield text.getvalue()
        text.seek(0)
        text.truncate()
    if not len(window.t):
        yield text.getvalue()


def mcap_pieces(window: Window) -> Iterator[bytes]:
    """A recording in MCAP, its times those of the wall clock."""
    file, channels = io.BytesIO(), _present(window)
    oldest = window.time.timestamp() - float(window.t[-1]) if len(window.t) else 0.0
    with RecordingWriter(file, window.names, MODEL_TOPICS) as writer:
        for k, t in enumerate(window.t.tolist()):
            writer.append(oldest + t, {name: values[k] for name, values in channels.items()})
    content = file.getbuffer()
    for first in range(0, len(content), PIECE):
        yield bytes(content[first : first + PIECE])


def _present(window: Window) -> dict[str, Array]:
    """Position, torque, and what of the others is known at all."""
    always = ("position", "torque")
    return {
        name: window.channels[name] for name in COLUMNS if name in always or np.isfinite(window.channels[name]).any()
    }


def _rows_as_json(window: Window) -> bytes:
    lists = {name: values.tolist() for name, values in window.channels.items()}
    own = {"time": window.time, "joints": window.names, "t": window.t.round(3).tolist()}
    return WindowRows.model_validate(own | lists).model_dump_json().encode()


def _file(kind: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {kind: {"schema": {"type": "string", "format": "binary"}}}, "description": "A recording"}}


def _attached(window: Window, suffix: str) -> dict[str, str]:
    begin = window.time - timedelta(seconds=float(window.t[-1]) if len(window.t) else 0.0)
    return {"content-disposition": f'attachment; filename="armlink-{begin:%Y%m%dT%H%M%S}Z.{suffix}"'}
