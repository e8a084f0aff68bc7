"""The daemon's event loop: connects bus process, timers, signals, systemd and web server to the service.

systemd is told by sd_notify: ready, reloading, stopping, alive, one line of status.
"""

import asyncio
import importlib
import logging
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import ArmlinkError, BadInput
from armlink.link.ends import EndCause
from armlink.link.types import Controller, Tell
from armlink.loop.cycle_process import RemoteControllers
from armlink.loop.kept_arm import KeptArm
from armlink.loop.messages import BATCH_SECONDS, Down, LoopAnswer, Told
from armlink.loop.realtime import Realtime
from armlink.termination import Presses, end_logger
from calib.daemon.aside import in_process
from calib.daemon.environment import CLOSING_SECONDS, Environment, Worker
from calib.daemon.logs import log_in_thread
from calib.daemon.service import Service
from calib.daemon.service_view import ServiceView
from calib.daemon.settings import DaemonSection, Options
from calib.records.store import RecordStore


class Notifier:
    """Sends to the socket of NOTIFY_SOCKET, where a leading @ means an abstract one; does nothing if there is none."""

    def __init__(self) -> None:
        given = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + given[1:] if given.startswith("@") else given
        self._waiting: dict[str, str] = {}
        """Messages that the socket has not taken, in order, by the name of their first assignment."""

    def __call__(self, *lines: str) -> None:
        """Send assignments such as READY=1; what the socket does not take now is sent by a later `flush`, in order.

        A message that begins with the same name replaces one that still waits.
        """
        name = lines[0].partition("=")[0]
        self._waiting.pop(name, None)
        self._waiting[name] = "\n".join(lines)
        self.flush()

    def flush(self) -> None:
        if not self._address:
            self._waiting.clear()
        if not self._waiting:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                for name, message in list(self._waiting.items()):
                    sender.sendto(message.encode(), self._address)
                    del self._waiting[name]
        except OSError:
            return


def watchdog_seconds() -> float | None:
    """Longest time between two WATCHDOG=1 that systemd accepts [s]; None if it has no watchdog on this process."""
    given, of = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not given.isdigit() or int(given) == 0 or (of and of != str(os.getpid())):
        return None
    return int(given) * 1e-6


SILENT_SECONDS = 15.0
"""A bus process that sends nothing for this time hangs: it is killed and started again [s]."""
BEGIN_SECONDS = 2 * SILENT_SECONDS
"""Time for a new bus process to send its first message [s]."""
PAUSE_SECONDS = 2.0
"""A timer of this process that is later than this says nothing of the bus process [s]."""
AGAIN_SECONDS = 5.0
"""Time to the next attempt where the system gives no process [s]."""
SIGN_OF_LIFE_SECONDS = 1.0
"""Between two signs of life to systemd, unless its watchdog wants them sooner [s]."""
SWITCH_SECONDS = 0.001
"""A thread at work (reading history, say) lets the event loop go on after this time; Python's default is five times
that, and an answer waits for it several times [s]."""
log = logging.getLogger("armlink.daemon")


class Daemon:
    """Connects the service to process, clock, signals and web server."""

    def __init__(self, options: Options, arm: ArmFile, process: KeptArm, state: Path) -> None:
        self.options, self.arm, self.process = options, arm, process
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        self._heard = time.monotonic() + BEGIN_SECONDS
        self._notify, self._watchdog = Notifier(), watchdog_seconds()
        port = _CurrentProcess(lambda: self.process)
        self._disk = Worker(self._loop, "disk")
        self._store, self._records_and_bus = RecordStore(options.store), Worker(self._loop, "records and bus")
        calculations = Worker(self._loop, "calculations", in_process)
        environment = Environment(
            time.monotonic, lambda: datetime.now(UTC), self._records_and_bus, port, self._disk, calculations
        )
        settings = options.settings(arm)
        self.service = Service(arm, settings, options.listen_only, state, self._store, environment)
        self.view = ServiceView(self.service)
        self._why = "stopped"
        self._ticked = self._kept_alive = -math.inf
        self._notified = ""
        self._presses = Presses()
        self._bus_ends, self._replacing = Worker(self._loop, "end of the bus process"), False
        """Waits for a bus process that brings its arm to the end; whether another one is to take its place."""

    async def run(self) -> None:
        """Run until SIGTERM, SIGINT or SIGQUIT; then the arm comes to its end (`armlink.link.ends`), however long that
        takes, and Ctrl-C pressed twice lets it go."""
        for number, act in {
            signal.SIGTERM: lambda: self._end("SIGTERM"),
            signal.SIGINT: lambda: self._end("SIGINT"),
            signal.SIGQUIT: lambda: self._end("SIGQUIT"),
            signal.SIGHUP: self._reload,
            signal.SIGUSR1: lambda: self.service.tours.request("asked for by signal"),
        }.items():
            self._loop.add_signal_handler(number, act)
        self._loop.add_reader(self.process.fileno(), self._messages)
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
            self._ended.set()
            self._notify("STOPPING=1")
            if self.process.fileno() >= 0:
                self._loop.remove_reader(self.process.fileno())
            closed, tell = self._loop.create_future(), self._ending()
            self._bus_ends(lambda: self.process.close(EndCause.INTERRUPTED, tell), closed.set_result)
            await closed
            for task in (web, timer, ended):
                task.cancel()
            await asyncio.gather(web, timer, ended, return_exceptions=True)
            self.service.close(self._why)
            self._records_and_bus(self._store.close, lambda outcome: None)
            self._records_and_bus.drain(CLOSING_SECONDS)

    async def _serve(self) -> None:
        """API and page; their modules are loaded in a thread, while the arm is observed already."""
        server = await asyncio.to_thread(importlib.import_module, "calib.daemon.web.server")
        given = self.options
        await server.serve(self.view, socket=given.socket, tcp=given.tcp, token=given.token)

    def _end(self, why: str) -> None:
        if self._ended.is_set():
            if why == "SIGINT":
                self._presses.press()
            return
        self._why = why
        self._ended.set()

    def _ending(self) -> Tell:
        """Takes the news, by the thread of `_bus_ends`, while the arm comes to its end: it goes to the log, and systemd
        waits."""
        say = end_logger(self.arm.name, self._presses)

        def tell(text: str) -> None:
            if text:
                lines = f"STATUS={text}", f"EXTEND_TIMEOUT_USEC={round(SILENT_SECONDS * 1e6)}"
                self._loop.call_soon_threadsafe(self._notify, *lines)
            say(text)

        return tell

    async def _timer(self) -> None:
        due = time.monotonic()
        while True:
            now = time.monotonic()
            self._turn(now, stood_still=now - due)
            due = max(due + BATCH_SECONDS, now)
            await asyncio.sleep(due - now)

    def _turn(self, now: float, stood_still: float) -> None:
        """Snapshots, the service's tick, the watchdog, and supervision of the bus process."""
        self._notify.flush()
        self.view.publish()
        why = self.service.trouble or self.service.arm_state.fault or self.service.records.detail
        status = f"STATUS={self.service.state} {why}".strip()
        if status != self._notified:
            self._notified = status
            self._notify(status)
        if now - self._ticked >= 1.0:
            self._ticked = now
            self.service.tick()
            self._judge(now, stood_still)
        if self._watchdog is not None and now - self._kept_alive >= min(SIGN_OF_LIFE_SECONDS, self._watchdog / 3):
            self._kept_alive = now
            self._notify("WATCHDOG=1")

    def _judge(self, now: float, stood_still: float) -> None:
        """Replace a bus process that hangs: not because this process itself stood still (stopped, say) [s], and none
        that brings its arm to the end, which `_bus_ends` sees to."""
        if stood_still > PAUSE_SECONDS or self._replacing or self._ended.is_set():
            self._heard = max(self._heard, now)
        if now - self._heard > SILENT_SECONDS:
            self._messages()  # what waits here is a sign of life too
        if now - self._heard > SILENT_SECONDS:
            self.process.kill()
            self._restart("the bus loop's process hangs")

    def _messages(self) -> None:
        try:
            messages = self.process.pump()
        except EOFError as error:
            self._restart(str(error))
            return
        if messages:
            self._heard = max(self._heard, time.monotonic())
        for message in messages:
            match message:
                case Told(text=text):
                    if text:
                        self._notify(f"STATUS={text}")
                case LoopAnswer(value=Realtime() as permitted):
                    log.info(f"bus process: {permitted}")
                case _:
                    self.service.take(message)

    def _restart(self, why: str) -> None:
        """Replace the bus process; it brings the arm to its end first, if it can."""
        if self._replacing:
            return
        self._replacing = True
        log.error(why)
        if self.process.fileno() >= 0:
            self._loop.remove_reader(self.process.fileno())
        self.service.take(Down(why))
        process, tell = self.process, end_logger(self.arm.name, self._presses)
        self._bus_ends(lambda: process.close(EndCause.FAILED, tell), self._replace)

    def _replace(self, outcome: Exception | None) -> None:
        self._replacing = False
        if self._ended.is_set():
            return
        try:
            self.process = self.options.keep(self.arm)
        except OSError as error:
            log.error(f"the bus process cannot be started: {error}")
            self._heard = time.monotonic() - SILENT_SECONDS + AGAIN_SECONDS
            return
        self._heard = time.monotonic() + BEGIN_SECONDS
        self._loop.add_reader(self.process.fileno(), self._messages)

    def _reload(self) -> None:
        """SIGHUP: read the arm file and the records again; a file that cannot be used whole changes nothing."""
        self._notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        self._disk(self._tried, self._reloaded)

    def _reloaded(self, read: tuple[ArmFile, DaemonSection] | Exception) -> None:
        try:
            before = self.service.configuration.settings
            if isinstance(read, Exception):
                raise read
            arm, settings = read
            self.service.reload(arm, settings)
        except (ArmlinkError, OSError, ValueError, ArithmeticError) as error:
            self.service.events.say("refused", None, f"the configuration was not reloaded: {error}", {})
        else:
            bus_changed = arm.link != self.arm.link or settings.work != before.work
            self.arm = arm
            if bus_changed:
                self._restart("the key `link` of the arm file or the work has changed")
        finally:
            self._notify("READY=1")

    def _tried(self) -> tuple[ArmFile, DaemonSection]:
        """Arm file and settings, with all that the bus process will need of them tried; raises BadInput, OSError."""
        from armlink.bus.open import resolve_bus  # for a reload alone: they take memory
        from armlink.link.joints.values import try_limits

        arm = load_arm(self.options.arm)
        changed = [key for key in ("name", "serial", "kinematics") if getattr(arm, key) != getattr(self.arm, key)]
        if changed:
            raise BadInput(f"{arm.path}: its {' and '.join(changed)} changed: restart the daemon to use this file")
        resolve_bus(self.options.bus, arm.require_link().bus)
        try_limits(arm)
        return arm, self.options.settings(arm)


class _CurrentProcess:
    """The service's `Port`: whichever bus process is the present one."""

    def __init__(self, process: Callable[[], KeptArm]) -> None:
        self.controllers = RemoteControllers(lambda call: process().ask(call))
        self._process = process

    def move(self, controller: Controller, /) -> None:
        self._process().move(controller)


def run_daemon(options: Options, arm: ArmFile, state: Path, process: KeptArm) -> None:
    """Run until a signal to stop, with a bus process already started; it has ended when this returns."""

    sys.setswitchinterval(SWITCH_SECONDS)
    log_in_thread()

    async def main() -> None:
        try:
            daemon = Daemon(options, arm, process, state)
        except BaseException:
            process.close()
            raise
        await daemon.run()

    asyncio.run(main())
