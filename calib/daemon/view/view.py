"""The interface of the service to the web layer, and its refusals.

All calls but those for events, history and the arm's shape are made on the service's event loop (asyncio, the same
thread); no answer waits for bus or disk.
"""

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from calib.daemon.view.api_models import (
    DrawnArm,
    EventItem,
    EventRecord,
    HistoryPoint,
    JointEstimate,
    JointNow,
    JointsItem,
    Proposal,
    Status,
)
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class Window:
    """K rows of n joints, oldest first."""

    names: tuple[str, ...]
    time: datetime
    """Of the newest row."""
    t: Array
    """Time since the oldest row (K,) [s]."""
    channels: dict[str, Array]
    """`position` [rad], `torque` and `model_torque` [N·m], `temperature` [°C] → (K, n); NaN if missing."""


class NotPossible(Exception):
    """An approval or rejection that is not possible now; the message says why (HTTP 409)."""


class NoSuch(Exception):
    """No proposal or joint of that id or name (HTTP 404)."""


class NotYet(Exception):
    """A decision that is taken, but not on disk yet; the message says so (HTTP 503)."""


class Decisions(Protocol):
    """Decisions that a person may take through the API. Raises NoSuch, NotPossible.

    The answer is there once the decision is on disk; it stands even if nobody waits for that.
    """

    def approve(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Write a pending proposal and make its record current; `digest` is the `hash` of what was looked at.

        It is `approved` once that is on disk, and `applied` or `failed` a moment later (an event).
        """
        ...

    def reject(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Drop a pending proposal; `digest` likewise."""
        ...


class Subscription(Protocol):
    """One client's stream: bounded; a client that is too slow loses the oldest items and never delays the daemon."""

    async def get(self) -> JointsItem | EventItem: ...

    def close(self) -> None: ...


class DaemonView(Protocol):
    """Everything that the web layer can reach. Nothing here commands torque or motion."""

    @property
    def decisions(self) -> Decisions: ...

    def status(self) -> Status: ...

    def joints(self) -> tuple[JointNow, ...]:
        """Every joint as of the newest snapshot, base to tip."""
        ...

    def window(self, seconds: float, most: int) -> Window:
        """Readings of the last `seconds` (at most 600), thinned evenly to at most `most` rows."""
        ...

    def arm(self) -> DrawnArm:
        """The arm's shape, from its model; raises NoSuch if that cannot be read. May be called in any thread."""
        ...

    def estimates(self) -> tuple[JointEstimate, ...]:
        """Every joint's gain and offset, base to tip; empty while there is no gravity record."""
        ...

    def events(self, after: int = 0, limit: int = 500) -> tuple[EventRecord, ...]:
        """At most `limit` events with an id above `after`, oldest first; ask again after the last id for more.

        May be called in any thread.
        """
        ...

    def history(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> tuple[HistoryPoint, ...]:
        """Estimates over time, oldest first, thinned evenly to at most `most` per joint; raises NoSuch.

        Without a joint: those of every joint, one joint after the other. May be called in any thread.
        """
        ...

    def history_pages(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> Iterator[tuple[HistoryPoint, ...]]:
        """Likewise in pieces that fit in memory; what it raises it raises at the first."""
        ...

    def proposals(self, limit: int = 200) -> tuple[Proposal, ...]: ...

    def subscribe(self) -> Subscription:
        """A new client of the stream, which begins with the present joints."""
        ...
