"""Motion of an arm that the daemon drives: tours of poses over the joints' whole range, and ordinary work.

A tour is made by schedule, on request, or if watching cannot decide; it has as many poses as the observer's longest
window. Poses are chosen by a process of its own, by the shapes of the arm file's model, before anything moves.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import ArmlinkError
from armlink.loop.messages import Batch, Progress
from calib.daemon.environment import Environment
from calib.daemon.settings import Configuration
from calib.daemon.state.events import EventLog
from calib.daemon.view import State
from calib.motion.trajectory import PoseWalk, WorkMotion
from calib.observer.config import LONGEST_WINDOW
from calib.plan.planned_arm import PlannedArm
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
        self._here: Array | None = None
        """Newest target positions (n,) [rad]; None until there are some since the bus is open."""
        self._choice = 0
        """Number of the newest choice of poses; an older one comes too late."""
        self.progress: Progress | None = None
        """Of the tour under way, its choice of poses included."""

    @property
    def _works(self) -> bool:
        return self._configuration.settings.work and not self._configuration.listen_only

    def request(self, why: str) -> None:
        """Begin a tour, so that the observer gets enough poses."""
        here = self._here
        state = State.STARTING if here is None else self._state()
        if here is None or self._configuration.listen_only or state is not State.OBSERVING:
            reason = "the daemon only listens" if self._configuration.listen_only else f"the daemon is {state}"
            self._events.say("refused", None, f"the sweep ({why}) was not begun: {reason}", {})
            return
        self.progress, self._last = Progress(0, LONGEST_WINDOW), self._environment.monotonic()
        nowhere = np.empty((0, len(here)))
        self._walk(here, nowhere, nowhere)  # the arm rests until poses are chosen
        self._choose(here, LONGEST_WINDOW, f"the sweep ({why})")

    def up(self) -> None:
        self.stopped()
        self._here = None

    def heard(self, batch: Batch) -> None:
        """Note where the arm is, and begin to work where it is to and the bus has been opened."""
        begins, self._here = self._here is None, batch.channels["position_command"][-1]
        if begins and self._works:
            self._choose(self._here, 0, "work")

    def _choose(self, here: Array, poses: int, what: str) -> None:
        """Choose poses beside the service, then move, unless something else has been asked for meanwhile."""
        self._choice += 1
        number, seed = self._choice, int(self._environment.wall().timestamp())

        def chosen(outcome: tuple[Array, Array] | Exception) -> None:
            if number == self._choice:
                self._chosen(outcome, here, poses, what)

        arm = self._configuration.arm
        work = 3 * LONGEST_WINDOW if self._works else 0  # to and fro, beyond what the observer remembers
        self._environment.aside(partial(chosen_poses, arm, here, poses, work, seed), chosen)

    def _chosen(self, outcome: tuple[Array, Array] | Exception, here: Array, poses: int, what: str) -> None:
        if isinstance(outcome, ArmlinkError):
            self.progress = None
            self._events.say("refused", None, f"{what} was not begun: {outcome}", {})
        elif isinstance(outcome, Exception):
            raise outcome
        elif self._here is not None and (
            self._state() is State.RECALIBRATING or not np.array_equal(self._here, here)  # not at rest yet
        ):
            self._choose(self._here, poses, what)
        else:
            tour, work = outcome
            if poses:
                self.progress = Progress(0, len(tour))
                self._events.say("sweep", None, f"{what}: {len(tour)} poses", {"poses": len(tour)})
            self._walk(here, tour, work)

    def _walk(self, here: Array, tour: Array, work: Array) -> None:
        section = self._configuration.arm.require_link()
        speed = np.array([joint.max_velocity for joint in section.joints])
        self._environment.port.move(PoseWalk(here, tour, work, speed, 1.0 / section.rate))

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
        self._choice += 1


def chosen_poses(arm_file: ArmFile, here: Array, poses: int, work: int, seed: int) -> tuple[Array, Array]:
    """Poses of a tour (P, n) from `here` (n,), and of work from its end (W, n) [rad]; nothing touches on their ways.

    There are `poses` and `work` of them unless the arm reaches fewer. Raises as `reachable_poses`, and BadInput.
    """
    planned, random = PlannedArm(arm_file), np.random.default_rng([seed, 8])
    tour = planned.reachable_poses(poses, random, here)
    return tour, planned.reachable_poses(work, random, [here, *tour][-1], reach=WorkMotion.reach)
