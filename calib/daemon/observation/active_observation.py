"""One observer and the recalibrations that follow from it, both against one pair of records."""

from collections.abc import Callable
from datetime import datetime

from calib.daemon.environment import BusJobs
from calib.daemon.loop.loop_messages import Batch
from calib.daemon.observation.observer_feed import ObserverFeed
from calib.daemon.observation.observer_storage import ObserverStorage
from calib.daemon.observation.recalibration_workflow import RecalibrationWorkflow
from calib.daemon.state.event_log import EventLog
from calib.daemon.state.journal import Journal
from calib.daemon.view.event_text import describe, one_alarm_a_joint
from calib.observer.events import Event


class ActiveObservation:
    """`handle` a batch of samples: to the observer, and what it finds to the event log and to recalibration."""

    def __init__(
        self,
        feed: ObserverFeed,
        recalibrations: RecalibrationWorkflow,
        storage: ObserverStorage,
        journal: Journal,
        events: EventLog,
        jobs: BusJobs,
        more_poses: Callable[[str], None],
    ) -> None:
        """`more_poses` asks for a tour of poses, with the reason, if the observer cannot decide."""
        self.feed, self.recalibrations = feed, recalibrations
        self._storage, self._journal, self._events = storage, journal, events
        self._jobs, self._more_poses = jobs, more_poses
        self.last_accepted: dict[str, datetime] = {}
        """Time of the newest row that went into each joint's estimate."""
        self._accepted = feed.observer.accepted

    def handle(self, batch: Batch) -> None:
        samples = self.feed.decimate(batch)
        if self._jobs.busy:
            return  # the calibration changes under these readings
        events = self.feed.observe(samples, batch.temperature)
        self._note_accepted()
        if events:
            self._report(events)
        self.recalibrations.watch(samples, self.feed.observer.held)

    def _note_accepted(self) -> None:
        accepted = self.feed.observer.accepted
        for name, more in zip(self.feed.names, accepted > self._accepted, strict=True):
            if more:
                self.last_accepted[name] = self._events.now()
        self._accepted = accepted

    def _report(self, events: list[Event]) -> None:
        """Keep events and estimates together, then act on the findings."""
        described = [(event, *describe(event)) for event in one_alarm_a_joint(events)]
        with self._journal.transaction():
            for event, kind, text, evidence in described:
                self._events.say(kind, event.joint, text, evidence)
            self._storage.save(self.feed, history=True)
        for event, kind, _, _ in described:
            if event.kind == "verdict":
                self.recalibrations.explained(kind, event.joint)
        for event in events:
            if event.finding is not None:
                self.recalibrations.found(event.finding)
            elif event.kind == "undecided":
                self._more_poses("observation alone cannot decide")
