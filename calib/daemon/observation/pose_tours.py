"""Motion of an arm that the daemon drives: tours of poses over the joints' whole range, and ordinary work.

A tour is made by schedule, on request, or if watching cannot decide; it has as many poses as the observer's longest
window.
"""

from collections.abc import Callable

import numpy as np

from armlink.loop.messages import Batch, Progress
from calib.arm.kinematics import gcomp_arm
from calib.daemon.environment import Environment
from calib.daemon.settings import Configuration
from calib.daemon.state.events import EventLog
from calib.daemon.view import State
from calib.motion.trajectory import RandomMotion
from calib.observer.config import LONGEST_WINDOW
from gcomp.arrays import Array

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
        self._seed = int(environment.wall().timestamp())
        self._here: Array | None = None
        """Newest target positions (n,) [rad]; None until there are some since the bus is open."""
        self.progress: Progress | None = None
        """Of the tour under way."""

    def request(self, why: str) -> None:
        """Begin a tour, so that the observer gets enough poses."""
        state = self._state()
        if self._configuration.listen_only or state is not State.OBSERVING:
            reason = "the daemon only listens" if self._configuration.listen_only else f"the daemon is {state}"
            self._events.say("refused", None, f"the sweep ({why}) was not begun: {reason}", {})
            return
        self.progress, self._last = Progress(0, LONGEST_WINDOW), self._environment.monotonic()
        self._events.say("sweep", None, f"sweeping {LONGEST_WINDOW} poses: {why}", {"poses": LONGEST_WINDOW})
        self._move(LONGEST_WINDOW, int(self._last))

    def up(self) -> None:
        self._here = None

    def heard(self, batch: Batch) -> None:
        """Note where the arm is, and begin to work where it is to and the bus has been opened."""
        begins, self._here = self._here is None, batch.channels["position_command"][-1]
        if begins and self._configuration.settings.work and not self._configuration.listen_only:
            self._move(0, self._seed)

    def _move(self, poses: int, seed: int) -> None:
        arm, section = gcomp_arm(self._configuration.arm), self._configuration.arm.require_link()
        speed = np.array([joint.max_velocity for joint in section.joints])
        here = self._here if self._here is not None else np.full(arm.n, np.nan)
        work = self._configuration.settings.work
        self._environment.port.move(
            RandomMotion(here, arm.lower, arm.upper, speed, 1.0 / section.rate, seed, poses, work)
        )

    def wish(self, why: str) -> None:
        """Begin a tour if the configuration lets the daemon decide on one."""
        allowed = self._configuration.settings.sweep_when_undecided and not self._configuration.listen_only
        if allowed and self._environment.monotonic() - self._last > TOUR_INTERVAL:
            self.request(why)

    def tick(self) -> None:
        hours = self._configuration.settings.sweep_every_hours
        if hours is None or self._configuration.listen_only or self._state() is not State.OBSERVING:
            return
        now = self._environment.monotonic()
        if self._last == -float("inf"):
            self._last = now
        if now - self._last >= hours * 3600.0:
            self.request(f"every {hours:g} h")

    def advanced(self, progress: Progress) -> None:
        self.progress = progress
        if progress.done >= progress.total:
            self.progress = None
            self._events.say("sweep", None, f"sweep of {progress.total} poses is done", {"poses": progress.total})

    def refused(self, error: str) -> None:
        """The bus loop could not begin or finish the tour."""
        if self.progress is not None:
            self.progress = None
            self._events.say("refused", None, f"sweep: {error}", {})

    def stopped(self) -> None:
        self.progress = None
