"""The event log: every event goes to the journal, to the clients of the stream and to the process's log."""

import logging
import math
from collections.abc import Callable
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
    """`say` keeps an event and, once it is kept, publishes it; while it cannot be kept it waits in the journal."""

    def __init__(
        self, journal: Journal, hub: Hub, monotonic: Callable[[], float], wall: Callable[[], datetime]
    ) -> None:
        self._journal, self._hub, self._monotonic, self.now = journal, hub, monotonic, wall
        self._wall_ahead = wall().timestamp() - monotonic()

    def say(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> None:
        """Keep an event, within a transaction together with the rest of it; publish it; log it."""
        said = self._logged(kind, joint, text, evidence)
        with self._journal.transaction():
            number = self._journal.add_event(**said)
            item = EventItem(event=EventRecord(id=number, **said))
            self._journal.once_kept(lambda: self._hub.publish(item))

    def _logged(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> dict[str, Any]:
        text = " ".join(text.split())
        level = logging.WARNING if kind in ("fault", "refused", "alarm") else logging.INFO
        log.log(level, text, extra={"kind": kind, "joint": joint})
        return {
            "time": self.now(),
            "t": self._monotonic(),
            "kind": kind,
            "joint": joint,
            "text": text,
            "evidence": finite(evidence),
        }

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
