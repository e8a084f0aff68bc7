"""Events: of the observer in words, to the journal, to the clients of the stream, and to the process's log."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from typing import Any

from calib.daemon.state.journal import Journal
from calib.daemon.view import EventItem, EventRecord, Hub
from calib.observer.decision import Event
from calib.observer.evidence import DRIFT

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
        at = {"time": self.now(), "t": self._monotonic()}
        return {**at, "kind": kind, "joint": joint, "text": text, "evidence": finite(evidence)}

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


Description = tuple[str, str, dict[str, Any]]
"""(kind, text, evidence)"""

_EFFECTS = {
    "friction": "the sensor now reads friction as well",
    "spring": "a spring (cable, hose) pulls at the joint",
    "slip": "the position reading has slipped",
    "tilt": "the base has tilted",
    "scale": "all torques changed by one factor: gravity, supply voltage, or a common scale",
    "temperature": "the zeros of several sensors moved together: temperature or supply voltage",
}
_OF_MOTORS = {
    "gain": (
        "drift",
        "its drive reads {change:+.1%} ± {std:.1%} more torque: measure its torque constant again, with creep sweeps",
    ),
    "offset": (
        "drift",
        "its drive reads {change:+.3f} ± {std:.3f} N·m without torque: measure this offset again, with creep sweeps",
    ),
    "friction": ("effect", "its friction has changed by {change:+.0%} ± {std:.0%}"),
}
"""Cause → kind and text, where torque is a motor current."""


def describe(event: Event) -> Description:
    """An observer's event in the terms of the API (docs/daemon-api.md)."""
    joint, evidence = event.joint or "the arm", event.evidence
    if event.kind == "alarm":
        kind, text = "alarm", f"{joint}: sensor and model disagree ({evidence.get('channel', '?')})"
    elif event.kind == "undecided":
        why = "; ".join(evidence.get("reasons", []))
        kind, text = "undecided", f"{joint}: the calibration was not changed: {why}"
    elif event.kind == "proposal":
        kind, text = "drift", f"{joint}: a drift of the sensor is confirmed: {_change(evidence)}"
    else:
        kind, text = _verdict(joint, evidence)
    return kind, text, evidence


def one_alarm_a_joint(events: list[Event]) -> list[Event]:
    """The same events, with simultaneous alarms of one joint merged into one that lists all its channels."""
    channels: dict[str | None, list[str]] = {}
    for event in events:
        if event.kind == "alarm":
            channels.setdefault(event.joint, []).append(event.evidence["channel"])
    merged = []
    for event in events:
        if event.kind != "alarm":
            merged.append(event)
        elif event.joint in channels:
            merged.append(replace(event, evidence={"channel": ", ".join(channels.pop(event.joint))}))
    return merged


def _verdict(joint: str, evidence: dict[str, Any]) -> tuple[str, str]:
    cause, sure = evidence["cause"], f"confidence {evidence['confidence']:.1%}"
    if evidence.get("motor") and cause in _OF_MOTORS:
        kind, text = _OF_MOTORS[cause]
        change, std = evidence["values"][0], evidence["std"][0]
        return kind, f"{joint}: {text.format(change=change, std=2 * std)}; {sure}"
    if cause in DRIFT:
        beside = f", and {evidence['beside']}" if "beside" in evidence else ""
        return "drift", f"{joint}{beside}: the torque sensor drifts ({cause}); {sure}; nothing was written yet"
    if cause == "none":
        return "clear", "sensors and model agree again, so the cause is gone (a collision, a contact, a load)"
    if cause in ("payload", "tool"):
        return "payload", f"{_load(cause, evidence)}; {sure}"
    if cause == "ambiguous":
        return "undecided", f"the cause is still ambiguous ({' or '.join(evidence['rivals'])}); {sure}"
    if cause == "unknown":
        several = "contact, or several effects at once: no single cause explains the readings; estimates are paused"
        return "contact", several
    return "effect", f"{joint}: {_EFFECTS.get(cause, cause)}; {sure}; estimates are paused"


def _load(cause: str, evidence: dict[str, Any]) -> str:
    mass, place = evidence["mass"], ", ".join("?" if x is None else f"{x:.3f}" for x in evidence["com"])
    held = (
        "estimates are paused"
        if cause == "payload"
        else "the load stays, so it counts as a tool and is part of the model from now on"
    )
    if mass is None:
        return f"payload of unknown mass, since the joint axes are too close together; {held}"
    if mass < 0:
        return f"{-mass:.3f} kg were removed at ({place}) m in the frame of the last link"
    return f"payload of {mass:.3f} kg at ({place}) m in the frame of the last link; {held}"


def _change(evidence: dict[str, Any]) -> str:
    return (
        f"gain {evidence['gain']:.5f} ± {evidence['gain_std']:.5f}, "
        f"offset {evidence['offset']:+.3f} ± {evidence['offset_std']:.3f} N·m"
    )
