"""The service: makes the daemon's parts, connects them, and routes the bus loop's messages. One thread, no waiting.

Each part holds its own state and calls only parts further down:

    ActiveRecords          records in force, and whether the controllers hold them
    ObserverFeed           one observer against one pair of records
    RecalibrationWorkflow  proposals, decisions, writes, the check after a write
    ExternalTorque         what neither arm nor friction explains, and contacts
    DailyDiagnosis         the day's busiest minute, diagnosed by a process of its own; what wears
    PoseTours, ObserverStorage, ArmState, LiveWindow, Recordings, BusiestMinute
    BusJobs                work that waits for bus or record store, one job at a time
    EventLog               events to the journal, the stream's Hub and the process's log
    Journal                what waits for the disk, and the file; Configuration and Environment are given

What touches a disk, a database or the bus, or takes long, goes aside by way of Environment.
"""

import logging
from importlib.metadata import version
from pathlib import Path

from armlink.arm_file import ArmFile
from armlink.loop.kept_arm import KeptMessage
from armlink.loop.messages import Batch, Down, Progress, Stopped, Up
from calib.daemon.environment import CLOSING_SECONDS, BusJobs, Environment
from calib.daemon.observation.active_records import ActiveRecords
from calib.daemon.observation.daily_diagnosis import DailyDiagnosis
from calib.daemon.observation.external_torque import ExternalTorque
from calib.daemon.observation.observation import ObserverFeed, ObserverStorage
from calib.daemon.observation.pose_tours import PoseTours
from calib.daemon.observation.recalibration_workflow import RecalibrationWorkflow
from calib.daemon.settings import Configuration, DaemonSection
from calib.daemon.state.arm_state import ArmState, BusiestMinute, LiveWindow, Recordings
from calib.daemon.state.events import EventLog, describe, one_alarm_a_joint
from calib.daemon.state.journal import Journal
from calib.daemon.view import Hub, State
from calib.observer.decision import DriftFinding, Event
from calib.observer.recalibrator import Recalibrator
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore

FLUSH_SECONDS = 25.0
"""Time that the disk has at the end for what is not written yet [s]: one fsync of 10 s under way, one more."""

log = logging.getLogger("armlink.daemon")


class Service:
    """`take` a message of the bus loop; `tick` once a second or more often. All else is asked through `ServiceView`."""

    def __init__(
        self,
        arm: ArmFile,
        settings: DaemonSection,
        listen_only: bool,
        directory: Path,
        store: RecordStore,
        environment: Environment,
    ) -> None:
        """Continue from the state directory; raises BadInput if that cannot be used."""
        monotonic, wall = environment.monotonic, environment.wall
        self.configuration = Configuration(arm, settings, listen_only)
        self.environment, self.directory, self._store = environment, directory, store
        self.started = monotonic()
        disk = environment.disk
        self.journal = Journal(directory / "journal.db", monotonic, disk)
        self.hub = Hub()
        self.events = EventLog(self.journal, self.hub, monotonic, wall)
        self.jobs = BusJobs(environment.run)
        self.arm_state = ArmState(arm, self.events, monotonic)
        self.window = LiveWindow(len(arm.joint_names))
        self.busiest = BusiestMinute(arm.require_link().rate)
        self.recordings = Recordings(directory / "recordings", self.configuration, disk)
        self.report: Path | None = None
        """The newest report in the state directory, as of the last tick."""
        self._looks_for_report = False
        self.diagnosis = DailyDiagnosis(
            self.configuration, environment, self.events, self.busiest, directory / "diagnosis"
        )
        self.external = ExternalTorque(
            self.configuration, environment, directory / "external.npz", self.events, self.hub
        )
        self.storage = ObserverStorage(self.journal, environment)
        self.recalibrations = RecalibrationWorkflow(
            self.configuration, store, self.arm_state, self.journal, self.events, self.jobs, monotonic
        )
        self.tours = PoseTours(self.configuration, self.events, environment, lambda: self.state)
        parts = self.configuration, environment, store, self.arm_state, self.events, self.jobs, self.recalibrations
        self.records = ActiveRecords(*parts, self._observe)
        text = f"armlink {version('armlink')} for {arm.name} {arm.serial}"
        self.events.say("started", None, text, {"policy": settings.policy})
        self._say_set_aside()
        self.records.load()

    @property
    def state(self) -> State:
        connected = self.arm_state.connected
        if self.jobs.busy:
            return State.RECALIBRATING
        if connected is None or (connected and self.records.feed is None):
            return State.STARTING
        if not connected or self.arm_state.silent:
            return State.FAULT
        return State.OBSERVING if self.tours.progress is None else State.SWEEPING

    @property
    def trouble(self) -> str:
        """Fault of the service itself, the arm apart: of its journal or its record store; empty if there is none."""
        return self.journal.trouble or self.records.store_fault

    def take(self, message: KeptMessage) -> None:
        if isinstance(message, Batch):
            self.arm_state.heard(message)
            self.window.append(message)
            self.recordings.append(message)
            if self.configuration.settings.diagnosis.enabled:
                self.busiest.append(message)
            self.tours.heard(message)
            if self.records.feed is not None:
                self._feed(self.records.feed, message)
        elif isinstance(message, Up):
            self.arm_state.up()
            self.arm_state.uncalibrated = message.uncalibrated
            self.tours.up()
            self.records.held(message.held)
        elif isinstance(message, Down):
            self.tours.stopped()
            self.arm_state.down(message.reason)
        elif isinstance(message, Progress):
            self.tours.advanced(message)
        elif isinstance(message, Stopped):
            self.tours.refused(str(message.error))

    def tick(self) -> None:
        self.journal.probe()
        self._say_set_aside()
        for part in (self.events, self.arm_state, self.records, self.recalibrations, self.tours, self.diagnosis):
            part.tick()
        self.storage.tick(self.records.feed)
        if not self._looks_for_report:
            self._looks_for_report = True
            self.environment.disk(lambda: _newest_report(self.directory), self._report_found)

    def reload(self, arm: ArmFile, settings: DaemonSection) -> None:
        """Use another configuration of the same arm from now on; the observer's state is kept.

        Where an observer cannot be made with it, that error is raised and the configuration before stays in use.
        """
        configuration = self.configuration
        before = configuration.arm, configuration.settings
        configuration.arm, configuration.settings = arm, settings
        try:
            if settings.observer != before[1].observer:
                self._renew()
        except Exception:
            configuration.arm, configuration.settings = before
            raise
        self.events.say("configuration", None, "the configuration was reloaded", {"policy": settings.policy})
        self.records.load()
        if self.records.feed is not None:
            self.external.renew(self.records.feed.calibration, self.records.feed.gravity)

    def save(self, history: bool = False) -> None:
        if self.records.feed is not None:
            self.storage.save(self.records.feed, history)

    def close(self, why: str) -> None:
        """Save everything and end, within FLUSH_SECONDS and CLOSING_SECONDS: what is not on disk by then is lost."""
        self.save()
        self.events.say("stopped", None, why, {})
        self.recordings.close()
        disk = self.environment.disk
        written = disk.drain(FLUSH_SECONDS)
        if self.journal.waiting:
            log.error(
                f"the daemon ends, and {self.journal.waiting} entries are not in the journal: {self.journal.trouble}"
            )
        self.diagnosis.close()
        if written:
            disk(self.journal.close, lambda outcome: None)
            disk.drain(CLOSING_SECONDS)

    def _say_set_aside(self) -> None:
        aside, self.journal.set_aside = self.journal.set_aside, ""
        if aside:
            text = f"the journal was damaged: it was moved to {aside}, and a new, empty journal was begun"
            self.events.say("fault", None, text, {"file": aside})

    def _report_found(self, found: Path | Exception | None) -> None:
        self._looks_for_report = False
        if isinstance(found, Exception):
            raise found
        self.report = found

    def _renew(self) -> None:
        self.save()
        self.records.renew()

    def _feed(self, feed: ObserverFeed, batch: Batch) -> None:
        """Give samples to all that observes them, unless the calibration changes under these readings."""
        samples = feed.decimate(batch)
        if self.jobs.busy:
            self.external.interrupt()
            return
        self.external.take(batch, feed)
        events = feed.observe(samples, batch.temperature, self.events.now())
        if events:
            self._report(feed, events)
        self.recalibrations.watch(samples, feed.observer.held)

    def _report(self, feed: ObserverFeed, events: list[Event]) -> None:
        """Keep events and estimates together, then act on the findings."""
        described = [(event, *describe(event)) for event in one_alarm_a_joint(events)]
        with self.journal.transaction():
            for event, kind, text, evidence in described:
                self.events.say(kind, event.joint, text, evidence)
            self.storage.save(feed, history=True)
        for event, kind, _, _ in described:
            if event.kind == "verdict":
                self.recalibrations.explained(kind, event.joint)
        for event in events:
            if event.finding is not None:
                self.recalibrations.found(event.finding)
            elif event.kind == "undecided":
                self.tours.wish("the readings so far cannot decide on the cause")

    def _observe(self, calibration: CalibrationRecord, gravity: GravityRecord) -> ObserverFeed:
        """The observer against these records, continued from the saved state if that fits; raises Refused."""
        configuration, before = self.configuration, self.records.feed
        arm = configuration.arm
        feed = ObserverFeed(arm, calibration, gravity, configuration.settings.observer)
        recalibrator = Recalibrator(arm, self.environment.port.controllers, self._store, calibration)

        def installed(record: CalibrationRecord, finding: DriftFinding) -> None:
            feed.install(record, finding)
            self.storage.save(feed, history=True)

        self.storage.restore(feed, self.recalibrations.begin(recalibrator, installed))
        if before is not None:
            feed.last_accepted = before.last_accepted
        self.external.renew(feed.calibration, feed.gravity)
        return feed


def _newest_report(directory: Path) -> Path | None:
    try:
        reports = [path for path in directory.glob("*.html") if path.is_file()]
        return max(reports, key=lambda path: path.stat().st_mtime, default=None)
    except OSError:  # removed meanwhile, or the disk fails
        return None
