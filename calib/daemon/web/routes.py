"""The API's routes (docs/daemon-api.md). All read, except the two that decide on a proposal; none commands motion."""

import asyncio
import sqlite3
from collections.abc import Callable
from concurrent.futures import Future
from datetime import timedelta
from itertools import chain
from typing import Annotated, Any

from fastapi import APIRouter, Body, Header, Path, Query, Request
from fastapi.responses import FileResponse, Response

from calib.daemon.view import (
    DaemonView,
    DrawnArm,
    EventRecord,
    ExternalNow,
    HistoryPoint,
    JointEstimate,
    JointNow,
    NoSuch,
    NotPossible,
    NotYet,
    Overview,
    Proposal,
    Status,
)
from calib.daemon.web.connection import Owner, peer_of
from calib.daemon.web.history import (
    DISK_SECONDS,
    LARGEST_ID,
    ApiError,
    Decision,
    EventsQuery,
    Histories,
    HistoryQuery,
    Id,
    OverviewQuery,
    StreamQuery,
    TooMany,
    add_window,
    points_as_json,
)
from calib.daemon.web.stream import StreamResponse, Streams

REFUSALS: dict[int | str, dict[str, Any]] = {
    400: {"model": ApiError, "description": "The Host header is not a name of this daemon, or the body ended early"},
    401: {"model": ApiError, "description": "For TCP only: the token is missing or wrong"},
    408: {"model": ApiError, "description": "The body of the request did not arrive in time"},
    413: {"model": ApiError, "description": "The body of the request is too large"},
    422: {"model": ApiError, "description": "A parameter is not valid"},
    429: {"model": ApiError, "description": "There are too many requests, long answers, or clients on the stream"},
    503: {"model": ApiError, "description": "The journal cannot be read or written at present"},
}
NO_SUCH: dict[int | str, dict[str, Any]] = {404: {"model": ApiError, "description": "Not found"}}
NOT_NOW: dict[int | str, dict[str, Any]] = {
    403: {"model": ApiError, "description": "The request came from a page of another origin"},
    409: {"model": ApiError, "description": "No decision is possible at present"},
}
STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events: `joints` (a JointsItem, 10 Hz), `contact` (a ContactItem) and `event` (an "
        "EventItem, with its id).",
        "content": {"text/event-stream": {"schema": {"type": "string"}}},
    }
}
_HTML: dict[int | str, dict[str, Any]] = {200: {"content": {"text/html": {}}, "description": "HTML"}}
REPORT_CSP = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline';"
    " style-src 'unsafe-inline'; img-src data: blob:"
)
"""The report is one file with its scripts inside; it may not send requests to this daemon or anyone else."""

ProposalId = Annotated[int, Path(ge=1, le=LARGEST_ID)]
OptionalDecision = Annotated[Decision | None, Body()]


def api_router(view: DaemonView, streams: Streams, metrics: Callable[[], bytes]) -> APIRouter:
    router = APIRouter(responses=REFUSALS)
    histories = streams.histories
    _add_now(router, view, histories)
    _add_past(router, view, histories)
    add_window(router, view, histories)
    _add_proposals(router, view)

    @router.get("/api/stream", response_class=Response, responses=STREAM, tags=["now"])
    async def stream(
        owner: Owner, query: Annotated[StreamQuery, Query()], last_event_id: Annotated[Id | None, Header()] = None
    ) -> Response:
        """Joints at 10 Hz, and events as they happen; a slow client still gets every event, in order."""
        if not streams.make_room(owner):
            raise TooMany(f"{streams.clients} clients are already on the stream: close one, or try again later")
        return StreamResponse(streams, query.after if last_event_id is None else last_event_id)

    @router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}}, tags=["now"])
    async def prometheus() -> Response:
        """Metrics for Prometheus."""
        return Response(metrics(), media_type="text/plain; version=0.0.4; charset=utf-8")

    return router


def _add_now(router: APIRouter, view: DaemonView, histories: Histories) -> None:
    @router.get("/api/status", tags=["now"])
    async def status() -> Status:
        """State of daemon and bus, current records."""
        return view.status()

    @router.get("/api/joints", tags=["now"])
    async def joints() -> tuple[JointNow, ...]:
        """Latest readings of every joint, base to tip."""
        return view.joints()

    @router.get("/api/external", tags=["now"])
    async def external() -> ExternalNow:
        """Torque, force and moment that neither arm nor friction explains, with 95 % bounds, and contacts."""
        return view.external()

    @router.get("/api/arm", responses=NO_SUCH, tags=["now"])
    async def arm(owner: Owner) -> DrawnArm:
        """The arm's shape, to draw it at any joint positions."""
        return await histories.aside(owner, view.arm)

    @router.get("/api/estimates", tags=["now"])
    async def estimates() -> tuple[JointEstimate, ...]:
        """Every joint's gain and offset against the installed record, base to tip."""
        return view.estimates()

    @router.get("/api/overview", response_model=Overview, tags=["now"])
    async def overview(owner: Owner, query: Annotated[OverviewQuery, Query()]) -> Response:
        """Everything that the page shows, in one answer, with the newest events and history."""
        status = view.status()
        since = status.time - timedelta(seconds=query.seconds) if query.seconds else None
        answer = Overview(
            status=status,
            joints=view.joints(),
            estimates=view.estimates(),
            external=view.external(),
            proposals=view.proposals(),
            events=(),
            history=(),
        )

        def encoded() -> str:
            events = view.events(after=max(0, status.last_event - query.events))
            history = tuple(chain.from_iterable(view.history_pages(None, since, None, query.limit)))
            return answer.model_copy(update={"events": events, "history": history}).model_dump_json()

        return Response(await histories.aside(owner, encoded), media_type="application/json")


def _add_past(router: APIRouter, view: DaemonView, histories: Histories) -> None:
    @router.get("/api/events", tags=["past"])
    async def events(query: Annotated[EventsQuery, Query()]) -> tuple[EventRecord, ...]:
        """Events after an id, oldest first."""
        return await histories.short(lambda: view.events(after=query.after, limit=query.limit))

    @router.get("/api/history", response_model=tuple[HistoryPoint, ...], responses=NO_SUCH, tags=["past"])
    async def history(owner: Owner, query: Annotated[HistoryQuery, Query()]) -> Response:
        """Gain and offset over time, oldest first; without a joint, one joint after the other."""
        pages = view.history_pages(query.joint or None, query.since, query.until, query.limit)
        return await histories.send(owner, points_as_json(pages), bytes, "application/json")

    @router.get("/api/report", response_class=FileResponse, responses=NO_SUCH | _HTML, tags=["past"])
    async def report() -> FileResponse:
        """The newest report in the state directory, one HTML file."""
        path = view.status().report
        if path is None or not await histories.short(path.is_file):
            raise NoSuch(
                "there is no report yet: this page shows the newest HTML file of the state directory, and "
                "`calibrate --report` writes one there"
            )
        return FileResponse(path, media_type="text/html", headers={"content-security-policy": REPORT_CSP})


def _add_proposals(router: APIRouter, view: DaemonView) -> None:
    @router.get("/api/proposals", tags=["proposals"])
    async def proposals() -> tuple[Proposal, ...]:
        """Proposed recalibrations, newest first."""
        return view.proposals()

    @router.post("/api/proposals/{id}/approve", responses=NO_SUCH | NOT_NOW, tags=["proposals"])
    async def approve(request: Request, id: ProposalId, decision: OptionalDecision = None) -> Proposal:
        """Write a pending proposal to the controller; `applied` or `failed` follows as an event."""
        return await _decided(view.approve, id, request, decision)

    @router.post("/api/proposals/{id}/reject", responses=NO_SUCH | NOT_NOW, tags=["proposals"])
    async def reject(request: Request, id: ProposalId, decision: OptionalDecision = None) -> Proposal:
        """Drop a pending proposal."""
        return await _decided(view.reject, id, request, decision)


async def _decided(
    decide: Callable[[int, str, str | None], Future[Proposal]], number: int, request: Request, given: Decision | None
) -> Proposal:
    """The answer once the decision is on disk; raises NotYet where that takes long.

    The audit trail has the name given, and always the peer of the connection.
    """
    decision, peer = given or Decision(), peer_of(request.scope)
    answer = decide(number, peer.name if decision.by is None else f"{decision.by} ({peer.name})", decision.hash)
    try:
        async with asyncio.timeout(DISK_SECONDS):
            return await asyncio.shield(asyncio.wrap_future(answer))
    except TimeoutError:
        raise NotYet(
            f"the decision on proposal {number} waits for the disk, which has not answered for "
            f"{DISK_SECONDS:.0f} s, and will be carried out when it answers: do not repeat it, look at /api/proposals"
        ) from None


ERRORS: dict[type[Exception], int] = {NoSuch: 404, NotPossible: 409, TooMany: 429, sqlite3.Error: 503, NotYet: 503}
"""HTTP status of what a route may raise."""
