"""The daemon's one event loop: bus process, timers, signals, systemd and the web, wired together; nothing else."""

import asyncio
import importlib
import logging
import signal
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import ArmlinkError, BadInput
from armlink.link.types import Calibration
from calib.daemon.loop.loop_messages import Down
from calib.daemon.loop.loop_process import ChildHost
from calib.daemon.notify import Notifier, watchdog_seconds
from calib.daemon.options import Options
from calib.daemon.service import Around, Service
from calib.daemon.view.service_view import ServiceView
from calib.install.journaled_write import Controllers
from calib.records.store import RecordStore

T = TypeVar("T")
SNAPSHOT_SECONDS = 0.1
SILENT_SECONDS = 15.0
"""A bus process that has said nothing for so long hangs: it is killed and begun anew."""
BEGIN_SECONDS = 30.0
"""A new bus process may take so long to say its first word."""
log = logging.getLogger("armlink.daemon")


class Daemon:
    """Everything that lives as long as the process does."""

    def __init__(self, options: Options, arm: ArmFile, host: ChildHost, state: Path) -> None:
        self.options, self.arm, self.host = options, arm, host
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        self._heard = time.monotonic() + BEGIN_SECONDS
        self._notify, self._watchdog = Notifier(), watchdog_seconds()
        self._tasks: set[asyncio.Future[Any]] = set()
        around = Around(time.monotonic, lambda: datetime.now(UTC), self._job, self)
        settings = options.settings(arm)
        self.service = Service(arm, settings, options.listen_only, state, RecordStore(options.store), around)
        self.view = ServiceView(self.service)
        self._why = "stopped"

    # ---- the service's way to the bus (Port), whichever process it is

    @property
    def controllers(self) -> Controllers:
        """This, whose calls go to the bus process of the moment."""
        return self

    def read_calibration(self, joint: int) -> Calibration:
        """See LoopControllers."""
        return self.host.controllers.read_calibration(joint)

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """See LoopControllers."""
        return self.host.controllers.write_calibration(joint, calibration, store)

    def sweep(self, poses: int, seed: int) -> Any:
        """See ChildHost."""
        return self.host.sweep(poses, seed)

    # ---- life

    async def run(self) -> None:
        """Until SIGTERM or SIGINT; leaves the joints safe."""
        for number, act in {
            signal.SIGTERM: lambda: self._end("SIGTERM"),
            signal.SIGINT: lambda: self._end("SIGINT"),
            signal.SIGHUP: self._reload,
            signal.SIGUSR1: lambda: self.service.tours.request("asked for by signal"),
        }.items():
            self._loop.add_signal_handler(number, act)
        self._loop.add_reader(self.host.fileno(), self._messages)
        web = asyncio.create_task(self._serve())
        timer = asyncio.create_task(self._timer())
        ended = asyncio.create_task(self._ended.wait())
        self._notify("READY=1", "STATUS=starting")
        try:
            await asyncio.wait({web, timer, ended}, return_when=asyncio.FIRST_COMPLETED)
            for ending in (web, timer):
                if ending.done():
                    ending.result()
        finally:
            self._notify("STOPPING=1")
            self._loop.remove_reader(self.host.fileno())
            self.host.close()
            for task in (web, timer, ended):
                task.cancel()
            await asyncio.gather(web, timer, ended, return_exceptions=True)
            self.service.close(self._why)

    async def _serve(self) -> None:
        """API and page; what they need is loaded aside, while the arm is observed already."""
        server = await asyncio.to_thread(importlib.import_module, "calib.daemon.web.server")
        given = self.options
        await server.serve(self.view, socket=given.socket, tcp=given.tcp, token=given.token)

    def _end(self, why: str) -> None:
        self._why = why
        self._ended.set()

    async def _timer(self) -> None:
        """Snapshots, the service's second, the watchdog, and a look after the bus process."""
        ticked, kept_alive, said = 0.0, 0.0, ""
        due = time.monotonic()
        while True:
            now = time.monotonic()
            self.view.publish()
            status = f"STATUS={self.service.state} {self.service.fault or self.service.detail}".strip()
            if status != said:
                said = status
                self._notify(status)
            if now - ticked >= 1.0:
                ticked = now
                self.service.tick()
                if now - self._heard > SILENT_SECONDS:
                    self._restart("the bus loop's process hangs")
            if self._watchdog is not None and now - kept_alive >= self._watchdog / 3:
                kept_alive = now
                self._notify("WATCHDOG=1")
            due = max(due + SNAPSHOT_SECONDS, now)
            await asyncio.sleep(due - now)

    def _messages(self) -> None:
        try:
            messages = self.host.pump()
        except EOFError as error:
            self._restart(str(error))
            return
        self._heard = time.monotonic()
        for message in messages:
            self.service.take(message)

    def _restart(self, why: str) -> None:
        """Begin the bus process anew; until then its joints are held by their own deadlines."""
        log.error(why)
        self._loop.remove_reader(self.host.fileno())
        self.host.close()
        self.service.take(Down(why))
        self.host = ChildHost(self.options.loop(self.arm))
        self._heard = time.monotonic() + BEGIN_SECONDS
        self._loop.add_reader(self.host.fileno(), self._messages)

    def _reload(self) -> None:
        """SIGHUP: the arm file and the records anew; a file that cannot be used changes nothing."""
        self._notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            arm = load_arm(self.options.arm)
            if arm.name != self.arm.name or arm.serial != self.arm.serial or arm.kinematics != self.arm.kinematics:
                raise BadInput(f"{arm.path}: another arm, serial or kinematics: restart the daemon for that")
        except (ArmlinkError, OSError) as error:
            self.service.say("refused", None, f"configuration not reloaded: {error}", {})
        else:
            bus_changed = arm.link != self.arm.link or self.options.settings(arm).work != self.service.settings.work
            self.arm = arm
            self.service.reload(arm, self.options.settings(arm))
            if bus_changed:
                self._restart("the arm file's link section or the work has changed")
        self._notify("READY=1")

    def _job(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Run work that waits for the bus in a thread; its outcome comes back on this loop."""

        def back(future: asyncio.Future[T]) -> None:
            self._tasks.discard(future)
            if future.cancelled():
                return
            error = future.exception()
            self.service.guard(lambda: done(error if isinstance(error, Exception) else future.result()))

        future = self._loop.run_in_executor(None, work)
        self._tasks.add(future)
        future.add_done_callback(back)


def run_daemon(options: Options, arm: ArmFile, state: Path, host: ChildHost) -> None:
    """Run until told to stop, with a bus process that is there already; it has ended when this returns."""

    async def main() -> None:
        try:
            daemon = Daemon(options, arm, host, state)
        except BaseException:
            host.close()
            raise
        await daemon.run()

    asyncio.run(main())
