"""Parameters of requests, typed: unknown names, empty values and times without a zone are handled here."""

import re
from datetime import UTC, datetime
from typing import Annotated, Any, Self

from pydantic import AfterValidator, AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

LARGEST_ID = 2**63 - 1
"""Largest integer of SQLite."""
EARLIEST, LATEST = datetime(1970, 1, 2, tzinfo=UTC), datetime(2999, 12, 31, tzinfo=UTC)

Id = Annotated[int, Field(ge=0, le=LARGEST_ID)]


class ApiError(BaseModel):
    """Every answer that is not 2xx."""

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
