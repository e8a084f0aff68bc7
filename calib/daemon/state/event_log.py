"""The event log: every event goes to the journal, to the clients of the stream and to the process's log."""

import logging
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import datetime
from typing import Any

from calib.daemon.state.journal import Journal
from calib.daemon.view.api_models import EventItem, EventRecord
from calib.daemon.view.fan_out import Hub

CLOCK_JUMP = 2.0
"""The wall clock was set if between two ticks it moves by this much more or less than the monotonic clock [s]; what
NTP slews in a second is below a millisecond."""

log = logging.getLogger("armlink.daemon")


class EventLog:
    """`say` keeps and publishes an event."""

    def __init__(
        self, journal: Journal, hub: Hub, monotonic: Callable[[], float], wall: Callable[[], datetime]
    ) -> None:
        self._journal, self._hub, self._monotonic, self.now = journal, hub, monotonic, wall
        self._wall_ahead = wall().timestamp() - monotonic()

    def say(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> int:
        """Keep an event, publish it, log it; returns its id. Raises sqlite3.Error if the disk fails."""
        now, t = self.now(), self._monotonic()
        text, evidence = " ".join(text.split()), finite(evidence)
        number = self._journal.add_event(now, t, kind, joint, text, evidence)
        record = EventRecord(id=number, time=now, t=t, kind=kind, joint=joint, text=text, evidence=evidence)
        self._hub.publish(EventItem(event=record))
        level = logging.WARNING if kind in ("fault", "refused", "alarm") else logging.INFO
        log.log(level, text, extra={"event": number, "kind": kind, "joint": joint})
        return number

    def together(self) -> AbstractContextManager[None]:
        """Events and decisions inside are on disk together, or none of them is."""
        return self._journal.transaction()

    def tick(self) -> None:
        """Report that the wall clock, which dates the events, was set."""
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
