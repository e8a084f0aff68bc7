"""The service: wiring between bus loop, observer, journal, recalibration and view. One thread, no waiting."""

import logging
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from armlink.arm_file import ArmFile
from armlink.canopen import emcy
from calib.daemon.loop.loop_messages import Batch, Down, Message, Progress, Reply, Up
from calib.daemon.observer_feed import Watcher
from calib.daemon.pose_tours import Tours
from calib.daemon.recalibration_workflow import Recalibrations
from calib.daemon.service_hooks import Jobs
from calib.daemon.settings import DaemonSection
from calib.daemon.state.active_records import InForce
from calib.daemon.state.journal import Journal
from calib.daemon.state.persistence import Keeping
from calib.daemon.state.recordings import Recordings
from calib.daemon.view.api_models import EventItem, EventRecord, State
from calib.daemon.view.event_text import clean, one_alarm_a_joint, told
from calib.daemon.view.fan_out import Hub
from calib.install.journaled_write import Controllers
from calib.observer.events import Event
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore

CLOCK_JUMP = 2.0
"""A wall clock that moves by so much more or less than the monotonic one was set [s]."""
FAULT_EVENTS_AN_HOUR = 20
STALE = 1.0
"""A joint that is silent for longer is a fault [s]."""

log = logging.getLogger("armlink.daemon")


class Port(Protocol):
    """The way to the bus loop."""

    @property
    def controllers(self) -> Controllers:
        """Reads and writes 2100h; waits, so that it is for jobs."""
        ...

    def sweep(self, poses: int, seed: int) -> Reply | None:
        """Ask for a tour of poses; the reply comes as a message where it is not returned."""
        ...


@dataclass(frozen=True)
class Around:
    """What the service is given from outside."""

    monotonic: Callable[[], float]
    wall: Callable[[], datetime]
    """With zone."""
    run: Jobs
    port: Port


class Service:
    """`take` a message of the bus loop; `tick` once a second or oftener. Everything else is asked through the view."""

    def __init__(
        self, arm: ArmFile, settings: DaemonSection, listen_only: bool, state: Path, store: RecordStore, around: Around
    ) -> None:
        """Go on from what `state` (a directory) holds; raises BadInput where that cannot be used."""
        self.arm, self.settings, self.listen_only, self.directory, self.store = arm, settings, listen_only, state, store
        self.around, self.version = around, version("armlink")
        self.names = arm.joint_names
        self.journal = Journal(state / "journal.db")
        self.hub = Hub()
        self.recordings = Recordings(state / "recordings", self.names, settings.recording)
        self.started = around.monotonic()
        self.batch: Batch | None = None
        self.batch_at = -float("inf")
        self.connected: bool | None = None
        self.fault = ""
        self.detail = self.trouble = ""
        self.watcher: Watcher | None = None
        self.recalibrations: Recalibrations | None = None
        self.calibration: CalibrationRecord | None = None
        self.gravity: GravityRecord | None = None
        self.accepted: dict[str, datetime] = {}
        self.keeping = Keeping(self)
        self._offset = around.wall().timestamp() - around.monotonic()
        self._fault_times: list[float] = []
        self.say("started", None, f"armlink {self.version} for {arm.name} {arm.serial}", {"policy": settings.policy})
        self.in_force = InForce(self)
        self.tours = Tours(self)
        self.in_force.load()

    # ---- state

    @property
    def state(self) -> State:
        """What the daemon is doing."""
        if self.recalibrations is not None and self.recalibrations.busy:
            return State.RECALIBRATING
        if self.connected is None or (self.connected and self.watcher is None):
            return State.STARTING
        if not self.connected or self.silent:
            return State.FAULT
        return State.SWEEPING if self.tours.now is not None else State.OBSERVING

    @property
    def report(self) -> Path | None:
        """The newest report in the state directory."""
        reports = [path for path in self.directory.glob("*.html") if path.is_file()]
        return max(reports, key=lambda path: path.stat().st_mtime, default=None)

    @property
    def silent(self) -> str:
        """The joint that has sent nothing for too long, in words; empty where all send."""
        if self.batch is None:
            return ""
        late = max(self.around.monotonic() - self.batch_at, 0.0) if self.connected else 0.0
        ages = [float(age) + late for age in self.batch.age]
        worst = max(range(len(ages)), key=ages.__getitem__)
        return f"{self.names[worst]}: no reading for {ages[worst]:.1f} s" if ages[worst] > STALE else ""

    def say(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> int:
        """Keep an event, tell the stream and the log; returns its id."""
        now, t = self.around.wall(), self.around.monotonic()
        text, evidence = " ".join(text.split()), clean(evidence)
        number = self.journal.add_event(now, t, kind, joint, text, evidence)
        self.trouble = ""
        record = EventRecord(id=number, time=now, t=t, kind=kind, joint=joint, text=text, evidence=evidence)
        self.hub.publish(EventItem(event=record))
        level = logging.WARNING if kind in ("fault", "refused", "alarm") else logging.INFO
        log.log(level, text, extra={"event": number, "kind": kind, "joint": joint})
        return number

    # ---- messages of the bus loop

    def take(self, message: Message) -> None:
        """One message of the bus loop; a disk that fails is logged, shown in the status, and does not stop anything."""
        self.guard(lambda: self._take(message))

    def guard(self, act: Callable[[], object]) -> None:
        """Do something that keeps things in the journal; a disk that fails does not stop anything."""
        try:
            act()
        except sqlite3.Error as error:
            self._trouble(error)

    def reload(self, arm: ArmFile, settings: DaemonSection) -> None:
        """Another configuration of the same arm: it holds from now on, what the observer has learnt stays."""
        before, self.arm, self.settings = self.settings, arm, settings
        self.recordings.settings = settings.recording
        if self.recalibrations is not None:
            self.recalibrations.settings = settings
        evidence = {"policy": settings.policy}
        self.guard(lambda: self.say("configuration", None, "configuration reloaded", evidence))
        if self.watcher is not None and settings.observer != before.observer:
            self.guard(self.in_force.observe_anew)
        self.guard(self.in_force.load)

    def _trouble(self, error: sqlite3.Error) -> None:
        if not self.trouble:
            log.error("journal: %s", error)
        self.trouble = f"the journal cannot be written: {error}"

    def _take(self, message: Message) -> None:
        if isinstance(message, Batch):
            self._batch(message)
        elif isinstance(message, Up):
            self._up(message)
        elif isinstance(message, Down):
            self._down(message.reason)
        elif isinstance(message, Progress):
            self.tours.progress(message)
        elif isinstance(message, Reply) and message.error is not None:
            self.tours.refused(message.error)

    def _batch(self, batch: Batch) -> None:
        self.batch, self.batch_at = batch, self.around.monotonic()
        for joint, code, register in batch.emergencies:
            if code:
                text = f"{self.names[joint]}: emergency {code:04X}h, {emcy.name_of(code)}"
                self._fault_event(self.names[joint], text, {"code": code, "register": register})
        self.recordings.append(batch)
        watcher, recalibrations = self.watcher, self.recalibrations
        if watcher is None or recalibrations is None:
            return
        samples = watcher.decimated(batch)
        if recalibrations.busy:
            return  # the calibration changes under these readings
        before = watcher.observer.estimate().accepted
        events = watcher.observe(samples)
        now = self.around.wall()
        for name, more in zip(self.names, watcher.observer.estimate().accepted > before, strict=True):
            if more:
                self.accepted[name] = now
        if events:
            self._events(events)
        recalibrations.watch(samples, watcher.observer.held)

    def _events(self, events: list[Event]) -> None:
        with self.journal.transaction():
            for event in one_alarm_a_joint(events):
                kind, text, evidence = told(event)
                self.say(kind, event.joint, text, evidence)
                if event.kind == "verdict" and self.recalibrations is not None:
                    self.recalibrations.explained(kind, event.joint)
            self.keeping.keep(history=True)
        assert self.recalibrations is not None
        for event in events:
            if event.finding is not None:
                self.recalibrations.found(event.finding)
            elif event.kind == "undecided":
                self.tours.wish("watching alone cannot decide")

    def _up(self, up: Up) -> None:
        back = self.connected is False
        self.connected, self.fault, self.batch_at = True, "", self.around.monotonic()
        if back:
            self._fault_event(None, "the bus is back", {}, kind="recovered")
        self.in_force.held(up.held)

    def _down(self, reason: str) -> None:
        was, self.connected, self.tours.now = self.connected, False, None
        changed, self.fault = reason != self.fault, reason
        if was is not False:
            self._fault_event(None, reason, {})
        elif changed:
            log.warning(reason)

    def _fault_event(self, joint: str | None, text: str, evidence: dict[str, Any], kind: str = "fault") -> None:
        """A fault or recovery as an event; one that comes and goes all the time goes to the log alone."""
        now = self.around.monotonic()
        self._fault_times = [t for t in self._fault_times if now - t < 3600.0]
        if len(self._fault_times) >= FAULT_EVENTS_AN_HOUR:
            log.warning(text)
            return
        self._fault_times.append(now)
        self.say(kind, joint, text, evidence)

    # ---- once a second

    def tick(self) -> None:
        """Whatever time alone asks for."""
        self.guard(self._tick)

    def _tick(self) -> None:
        now = self.around.monotonic()
        self._watch_clock(now)
        self.in_force.tick(now)
        self.tours.tick(now)
        self.keeping.tick(now)

    def close(self, why: str) -> None:
        """Keep everything and end."""
        try:
            self.keeping.keep()
            self.say("stopped", None, why, {})
        except sqlite3.Error as error:
            log.error("journal: %s", error)
        self.recordings.close()
        self.journal.close()

    def _watch_clock(self, now: float) -> None:
        before, self._offset = self._offset, self.around.wall().timestamp() - now
        jump = self._offset - before
        if abs(jump) > CLOCK_JUMP:
            self.say("clock", None, f"the wall clock was set by {jump:+.1f} s", {"seconds": jump})
