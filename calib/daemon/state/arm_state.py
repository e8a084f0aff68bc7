"""The arm as last heard: bus connection, newest batch, faults."""

import logging
from collections.abc import Callable, Collection
from typing import Any

from armlink.arm_file import ArmFile
from armlink.loop.messages import Batch
from calib.daemon.state.events import EventLog

LONGEST_PAUSE = 1.0
"""A joint that is silent for longer is a fault, and a longer pause in the samples begins a new recording [s]: ten
batches."""
FAULT_EVENTS_AN_HOUR = 20
"""Further faults within the hour go to the process's log only, so that a loose plug does not fill the journal."""

JUDGED_CYCLES = 10_000
"""The host's lateness is judged after so many cycles: 99.9 % of fewer hang on a single one."""

log = logging.getLogger("armlink.daemon")


class ArmState:
    """Holds what the bus loop reports of bus and joints; turns its faults into events."""

    def __init__(self, arm: ArmFile, events: EventLog, monotonic: Callable[[], float]) -> None:
        self._arm, self._names, self._events, self._monotonic = arm, arm.joint_names, events, monotonic
        self.connected: bool | None = None
        """Whether the joints answer; None until the bus loop has reported for the first time."""
        self.fault = ""
        """Why not, in one line."""
        self.uncalibrated: tuple[str, ...] = ()
        """Joints that the host is to calibrate and has no record for."""
        self.batch: Batch | None = None
        """The newest samples."""
        self._heard_at = -float("inf")
        self._fault_times: list[float] = []
        self._told_late = False

    @property
    def late(self) -> float:
        """Time since the newest batch, or since the bus came back [s]; 0 before the first batch."""
        return 0.0 if self.batch is None else max(self._monotonic() - self._heard_at, 0.0)

    @property
    def silent(self) -> str:
        """The joint that has sent nothing for too long, in words; empty if all send."""
        if self.batch is None:
            return ""
        late = self.late if self.connected else 0.0
        ages = [float(age) + late for age in self.batch.age]
        worst = max(range(len(ages)), key=ages.__getitem__)
        if ages[worst] <= LONGEST_PAUSE:
            return ""
        return f"{self._names[worst]}: no reading has come for {ages[worst]:.1f} s"

    def heard(self, batch: Batch) -> None:
        """Take samples and the emergencies among them."""
        self.batch, self._heard_at = batch, self._monotonic()
        for event in batch.emergencies:
            name = self._names[event.joint]
            self._report("fault", name, f"{name}: {event.text}", dict(event.evidence))

    def calibrated(self, joints: Collection[str]) -> None:
        self.uncalibrated = tuple(name for name in self.uncalibrated if name not in joints)

    def tick(self) -> None:
        """Report once per connection that the host is nearly too late for the arm."""
        stats = None if self.batch is None else self.batch.stats
        if stats is None or self._told_late or stats.cycles < JUDGED_CYCLES:
            return
        warning = stats.lateness.near(self._arm.require_link().deadline, self._arm.argument)
        if warning:
            self._told_late = True
            self._report("late", None, warning, {"late_ms": stats.lateness.in_ms()})

    def up(self) -> None:
        self._told_late = False
        back = self.connected is False
        self.connected, self.fault, self._heard_at = True, "", self._monotonic()
        if back:
            self._report("recovered", None, "the bus is back", {})

    def down(self, reason: str) -> None:
        """The bus or a joint has failed."""
        was, self.connected = self.connected, False
        changed, self.fault = reason != self.fault, reason
        if was is not False:
            self._report("fault", None, reason, {})
        elif changed:
            log.warning(reason)

    def _report(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> None:
        now = self._monotonic()
        self._fault_times = [t for t in self._fault_times if now - t < 3600.0]
        if len(self._fault_times) >= FAULT_EVENTS_AN_HOUR:
            log.warning(text)
            return
        self._fault_times.append(now)
        self._events.say(kind, joint, text, evidence)
