"""Tours of poses over the joints' whole range: by schedule, on request, or if watching cannot decide."""

from collections.abc import Callable

from calib.daemon.environment import Environment
from calib.daemon.loop.loop_messages import Progress
from calib.daemon.settings import Configuration
from calib.daemon.state.event_log import EventLog
from calib.daemon.view.api_models import State

TOUR_POSES = 60
"""As many as the observer's longest window (`ObserverConfig.longest_window`)."""
TOUR_INTERVAL = 3600.0
"""Time between two tours that the daemon decides on itself [s]."""


class PoseTours:
    """Runs tours on the bus loop; only possible if the daemon drives the bus."""

    def __init__(
        self, configuration: Configuration, events: EventLog, environment: Environment, state: Callable[[], State]
    ) -> None:
        """`state`: what the daemon is doing; a tour begins while it observes."""
        self._configuration, self._events, self._environment = configuration, events, environment
        self._state = state
        self._last = -float("inf")
        self.progress: Progress | None = None
        """Of the tour under way."""

    def request(self, why: str) -> None:
        """Begin a tour, so that the observer gets enough poses."""
        state = self._state()
        if self._configuration.listen_only or state is not State.OBSERVING:
            reason = "the daemon only listens" if self._configuration.listen_only else f"the daemon is {state}"
            self._events.say("refused", None, f"the sweep ({why}) was not begun: {reason}", {})
            return
        self.progress, self._last = Progress(0, TOUR_POSES), self._environment.monotonic()
        self._events.say("sweep", None, f"sweeping {TOUR_POSES} poses: {why}", {"poses": TOUR_POSES})
        answer = self._environment.port.sweep(TOUR_POSES, int(self._last))
        if answer is not None and answer.error is not None:
            self.refused(str(answer.error))

    def wish(self, why: str) -> None:
        """Begin a tour if the configuration lets the daemon decide on one."""
        allowed = self._configuration.settings.sweep_when_undecided and not self._configuration.listen_only
        if allowed and self._environment.monotonic() - self._last > TOUR_INTERVAL:
            self.request(why)

    def tick(self) -> None:
        """Begin a tour if the schedule says so."""
        hours = self._configuration.settings.sweep_every_hours
        if hours is None or self._configuration.listen_only or self._state() is not State.OBSERVING:
            return
        now = self._environment.monotonic()
        if self._last == -float("inf"):
            self._last = now
        if now - self._last >= hours * 3600.0:
            self.request(f"every {hours:g} h")

    def advanced(self, progress: Progress) -> None:
        """The bus loop reports how far it is."""
        self.progress = progress
        if progress.done >= progress.total:
            self.progress = None
            self._events.say("sweep", None, f"sweep of {progress.total} poses is done", {"poses": progress.total})

    def refused(self, error: str) -> None:
        """The bus loop could not begin or finish the tour."""
        self.progress = None
        self._events.say("refused", None, f"sweep: {error}", {})

    def stopped(self) -> None:
        """The bus is gone, and the tour with it."""
        self.progress = None
