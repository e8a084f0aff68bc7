"""Sweeps of the daemon: tours of poses all over the joints' range, by schedule, by request or where watching fails."""

from typing import TYPE_CHECKING

from calib.daemon.loop.loop_messages import Progress
from calib.daemon.view.api_models import State

if TYPE_CHECKING:
    from calib.daemon.service import Service

SWEEP_POSES = 60
SWEEP_REST = 3600.0
"""Time between two sweeps that the daemon decides on itself [s]."""


class Tours:
    """Only where the daemon drives the bus; `now` is how far the present one is."""

    def __init__(self, service: "Service") -> None:
        self._service = service
        self._last = -float("inf")
        self.now: Progress | None = None

    def request(self, why: str) -> None:
        """Begin a tour, so that the observer gets poses enough."""
        service = self._service
        if service.listen_only or service.state is not State.OBSERVING:
            reason = "it only listens" if service.listen_only else f"it is {service.state}"
            service.say("refused", None, f"no sweep ({why}): {reason}", {})
            return
        self.now, self._last = Progress(0, SWEEP_POSES), service.around.monotonic()
        service.say("sweep", None, f"sweeping {SWEEP_POSES} poses: {why}", {"poses": SWEEP_POSES})
        reply = service.around.port.sweep(SWEEP_POSES, int(self._last))
        if reply is not None and reply.error is not None:
            self.refused(reply.error)

    def wish(self, why: str) -> None:
        """Begin one where the configuration allows the daemon to decide so."""
        service = self._service
        allowed = service.settings.sweep_when_undecided and not service.listen_only
        if allowed and service.around.monotonic() - self._last > SWEEP_REST:
            self.request(why)

    def tick(self, now: float) -> None:
        """Begin one when the schedule says so."""
        hours = self._service.settings.sweep_every_hours
        if hours is None or self._service.listen_only or self._service.state is not State.OBSERVING:
            return
        if self._last == -float("inf"):
            self._last = now
        if now - self._last >= hours * 3600.0:
            self.request(f"every {hours:g} h")

    def progress(self, progress: Progress) -> None:
        """How far the bus loop is."""
        self.now = progress
        if progress.done >= progress.total:
            self.now = None
            self._service.say("sweep", None, f"sweep of {progress.total} poses is done", {"poses": progress.total})

    def refused(self, error: str) -> None:
        """The bus loop could not."""
        self.now = None
        self._service.say("refused", None, f"sweep: {error}", {})
