"""The event log: every event goes to the journal, to the clients of the stream and to the process's log."""

import logging
import math
import sqlite3
from collections import deque
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from calib.daemon.state.journal import Journal
from calib.daemon.view.api_models import EventItem, EventRecord
from calib.daemon.view.fan_out import Hub

CLOCK_JUMP = 2.0
"""The wall clock was set if between two ticks it moves by this much more or less than the monotonic clock [s]; what
NTP slews in a second is below a millisecond."""

MOST_WAITING = 10_000
"""Events that wait for a journal that cannot be written; beyond it the oldest are only in the process's log."""

log = logging.getLogger("armlink.daemon")


class Said(NamedTuple):
    """An event as it was said; it gets its id once it is kept."""

    time: datetime
    t: float
    kind: str
    joint: str | None
    text: str
    evidence: dict[str, Any]


class EventLog:
    """`say` keeps and publishes an event; while the journal cannot be written, events wait and none is lost."""

    def __init__(
        self, journal: Journal, hub: Hub, monotonic: Callable[[], float], wall: Callable[[], datetime]
    ) -> None:
        self._journal, self._hub, self._monotonic, self.now = journal, hub, monotonic, wall
        self._wall_ahead = wall().timestamp() - monotonic()
        self._waiting: deque[Said] = deque(maxlen=MOST_WAITING)

    def say(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> None:
        """Keep an event, publish it, log it; within a transaction raises sqlite3.Error if the disk fails."""
        said = self._logged(kind, joint, text, evidence)
        if self._journal.in_transaction:
            self._keep(said)
            return
        self._waiting.append(said)
        self.flush()

    def say_all(
        self, events: Sequence[tuple[str, str | None, str, dict[str, Any]]], also: Callable[[], object]
    ) -> None:
        """Keep events together with what `also` writes; where the disk fails, the events alone as soon as it can."""
        said = [self._logged(*event) for event in events]
        try:
            with self._journal.transaction():
                for event in said:
                    self._keep(event)
                also()
        except sqlite3.Error as error:
            self._journal.failed(error)
            self._waiting.extend(said)

    def flush(self) -> None:
        """Keep and publish the events that wait, in their order, as far as the journal takes them."""
        try:
            while self._waiting:
                self._keep(self._waiting[0])
                self._waiting.popleft()
        except sqlite3.Error as error:
            self._journal.failed(error)

    def _logged(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> Said:
        said = Said(self.now(), self._monotonic(), kind, joint, " ".join(text.split()), finite(evidence))
        level = logging.WARNING if kind in ("fault", "refused", "alarm") else logging.INFO
        log.log(level, said.text, extra={"kind": kind, "joint": joint})
        return said

    def _keep(self, said: Said) -> None:
        number = self._journal.add_event(*said)
        item = EventItem(event=EventRecord(id=number, **said._asdict()))
        self._journal.once_kept(lambda: self._hub.publish(item))

    def tick(self) -> None:
        """Keep what waits, and report that the wall clock, which dates the events, was set."""
        self.flush()
        before, self._wall_ahead = self._wall_ahead, self.now().timestamp() - self._monotonic()
        jump = self._wall_ahead - before
        if abs(jump) > CLOCK_JUMP:
            self.say("clock", None, f"the wall clock was set by {jump:+.1f} s", {"seconds": jump})


def finite(value: Any) -> Any:
    """A value that JSON can represent: numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, bool | str | int) or value is None:
        return value
    value = float(value)
    return value if math.isfinite(value) else None
