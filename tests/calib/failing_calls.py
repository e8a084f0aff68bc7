"""A daemon whose dependencies fail at chosen calls: record store, journal, disk of the recordings, pipe, notify socket.

The daemon is the real one, from the event loop's turns down; clock, arm, bus process and systemd's socket are ours.
"""

import asyncio
import errno
import pickle
import re
import socket
import sqlite3
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import sqlalchemy as sa
from fast_daemon import FastDaemon
from same_thread import Immediate

from armlink.channel import Channel, Closed
from armlink.errors import BusFault
from armlink.link.types import Calibration
from armlink.loop.kept_arm import BatchMaker, KeptArm, KeptMessage
from armlink.loop.messages import Call, LoopAnswer, Progress, RunController, Up
from armlink.recording.mcap import RecordingWriter
from calib.daemon import main_loop
from calib.daemon.main_loop import Daemon
from calib.daemon.settings import DaemonSection, Options
from calib.daemon.state.events import EventLog
from calib.daemon.view import State

DEPENDENCIES = ("store", "journal", "disk", "pipe", "notify")
OF_FAULTS = ("fault", "recovered", "started", "refused", "roll-back")
"""Kinds of events that say of the failures themselves."""
RIGHT_AGAIN = 5.0
"""State and status are right this long after the last failure [s]."""
WATCHDOG = 10.0
HEARD_AGAIN = 1.0
"""A sign of life is there this long after systemd's socket failed last, however long it failed [s]."""
RECORD = re.compile(r"record [0-9a-f]{8}")
STEP = 0.1
"""Between two turns of the event loop [s]."""


class Failing:
    """Counts the calls of each dependency, and fails those that `fails(dependency, count)` names."""

    def __init__(self, fails: Callable[[str, int], bool]) -> None:
        self.fails, self.calls, self.failed = fails, dict.fromkeys(DEPENDENCIES, 0), dict.fromkeys(DEPENDENCIES, 0)
        self.active, self.newly = False, False

    def call(self, dependency: str, error: Callable[[str], Exception]) -> None:
        if not self.active:
            return
        self.calls[dependency] += 1
        if self.fails(dependency, self.calls[dependency]):
            self.failed[dependency] += 1
            self.newly = True
            raise error(f"{dependency} failed")


def broken(text: str) -> OSError:
    return OSError(errno.EIO, text)


class FailingDatabase:
    """An SQLite connection whose statements may fail."""

    def __init__(self, db: sqlite3.Connection, failing: Failing) -> None:
        self._db, self._failing = db, failing

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        self._failing.call("journal", sqlite3.OperationalError)
        return self._db.execute(*statement)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._db, name)


class FailingSocket:
    """The service's end of the pipe."""

    def __init__(self, end: socket.socket, failing: Failing) -> None:
        self._end, self._failing = end, failing

    def send(self, content: Any) -> int:
        self._failing.call("pipe", broken)
        return self._end.send(content)

    def recv(self, size: int) -> bytes:
        self._failing.call("pipe", broken)
        return self._end.recv(size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._end, name)


class NotifySocket:
    """Systemd's socket."""

    def __init__(self, failing: Failing, heard: list[bytes]) -> None:
        self._failing, self._heard = failing, heard

    def __enter__(self) -> "NotifySocket":
        self._failing.call("notify", broken)
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def sendto(self, content: bytes, address: str) -> None:
        self._failing.call("notify", broken)
        self._heard.append(content)


class OtherCommit:
    """A database that does `at_commit` before a transaction ends; else it is the real one."""

    def __init__(self, real: sqlite3.Connection) -> None:
        self.real = real

    def at_commit(self) -> None:
        raise NotImplementedError

    def execute(self, statement: str, *values: Any) -> object:
        if statement == "COMMIT":
            self.at_commit()
        return self.real.execute(statement, *values)

    def __getattr__(self, name: str) -> object:
        return getattr(self.real, name)


class BusProcess(KeptArm):
    """The bus process without a process: its end of the pipe is served by the arm, in this thread."""

    def __init__(self, arm: "FailingDaemon") -> None:
        ours, theirs = socket.socketpair()
        for end in (ours, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        self._process = SimpleNamespace(wait=lambda: None, poll=lambda: 0, kill=lambda: None, pid=0)  # type: ignore[assignment]
        self._channel = Channel(FailingSocket(ours, arm.failing))  # type: ignore[arg-type]
        self._waiting: dict[int, Future[LoopAnswer]] = {}
        self._sending, self._batches = threading.Lock(), BatchMaker()
        self._arm, self._far, self._kept = arm, Channel(theirs), list[KeptMessage]()
        self.say(Up(arm.held()))

    def say(self, message: KeptMessage) -> None:
        """To the service."""
        try:
            self._far.put(message)
            self._far.flush()
        except Closed:
            return

    def serve(self) -> None:
        """What the service has asked."""
        try:
            for call in self._far.receive():
                if isinstance(call, RunController):
                    self._arm.move(pickle.loads(call.controller))
                else:
                    self.say(self._arm.answer(call))
        except Closed:
            return

    def pump(self) -> list[KeptMessage]:
        kept, self._kept = self._kept, []
        return kept + super().pump()

    def ask(self, call: Call) -> LoopAnswer:
        """As the process would, only that nobody has to wait."""
        answer: Future[LoopAnswer] = Future()
        self._waiting[call.id] = answer
        if self._send(call):
            self.serve()
            try:
                self._kept += super().pump()
            except EOFError as ended:
                return LoopAnswer(call.id, error=BusFault(str(ended)))
        return answer.result(0) if answer.done() else LoopAnswer(call.id, error=BusFault("no answer"))


class FailingDaemon(FastDaemon):
    """`run(seconds)` by turns of the event loop; `failing` fails calls, `wrong` is what was not as it should be."""

    def __init__(self, folder: Path, fails: Callable[[str, int], bool], patch: Any) -> None:
        self.failing, self.heard, self.wrong, self.said = Failing(fails), list[bytes](), list[str](), set[Any]()
        self._patch, self._failed_at, self._alive_at, self._judged_at = patch, -np.inf, 0.0, 0.0
        self._deaf, self._deaf_at = 0, -np.inf
        super().__init__(folder, 1, DaemonSection.model_validate({"policy": "apply", "recording": {"rate": 1.0}}))

    def start(self, up: bool = True) -> None:
        self._surround()
        options = Options(
            "sarcos", self.directory / "api.sock", policy="apply", store=str(self.directory / "records.db")
        )
        settings = self.settings
        self._patch.setattr(Options, "settings", lambda *_: settings)
        self.daemon = Daemon(options, self.arm, BusProcess(self), self.directory / "state")
        self.service, self.view = self.daemon.service, self.daemon.view
        self.store = self.service._store
        self._attach()
        self.failing.active = True

    def _surround(self) -> None:
        """Clock, event loop, threads, processes and systemd of the main loop."""
        now = SimpleNamespace(now=lambda zone: self.wall())
        patch, nothing = self._patch, lambda *_: None
        patch.setattr(main_loop, "time", SimpleNamespace(monotonic=self.now))
        patch.setattr(main_loop, "datetime", now)
        readers = SimpleNamespace(add_reader=nothing, remove_reader=nothing)
        patch.setattr(main_loop, "asyncio", SimpleNamespace(get_running_loop=lambda: readers, Event=asyncio.Event))
        patch.setattr(main_loop, "Worker", lambda *_: Immediate())
        patch.setattr(Options, "keep", lambda options, arm: BusProcess(self))
        patch.setattr(main_loop, "watchdog_seconds", lambda: WATCHDOG)
        patch.setenv("NOTIFY_SOCKET", "systemd")
        kinds = {name: getattr(socket, name) for name in ("AF_UNIX", "SOCK_DGRAM", "SOCK_NONBLOCK")}
        patch.setattr(
            main_loop, "socket", SimpleNamespace(socket=lambda *_: NotifySocket(self.failing, self.heard), **kinds)
        )

    def _attach(self) -> None:
        """From now on calls of store, journal and disk go through here, and what is said is noted."""
        failing, patch, engine = self.failing, self._patch, self.store._engine
        commit, logged, daemon = engine.dialect.do_commit, EventLog._logged, self

        @sa.event.listens_for(engine, "do_execute")
        def execute(*_: object) -> None:
            failing.call("store", sqlite3.OperationalError)

        def do_commit(connection: Any) -> None:
            failing.call("store", sqlite3.OperationalError)
            commit(connection)

        def called(method: str) -> None:
            unbroken = getattr(RecordingWriter, method)

            def call(writer: RecordingWriter, *given: Any) -> Any:
                failing.call("disk", broken)
                return unbroken(writer, *given)

            patch.setattr(RecordingWriter, method, call)

        def note(log: EventLog, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> Any:
            said = logged(log, kind, joint, text, evidence)
            daemon.said.add((said["kind"], said["joint"], said["text"]))
            return said

        patch.setattr(engine.dialect, "do_commit", do_commit)
        for method in ("__init__", "append", "__exit__"):
            called(method)
        patch.setattr(EventLog, "_logged", note)
        self.service.journal._db = FailingDatabase(self.service.journal._db, failing)  # type: ignore[assignment]

    def answer(self, call: Call) -> LoopAnswer:
        """What the bus process answers."""
        act: Callable[..., Calibration] = getattr(self, str(call.what))
        return LoopAnswer(call.id, act(*call.args))

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let the arm work for so long; a turn of the loop for each tenth of a second."""
        for t, position, torque in self.fast.samples(seconds):
            pieces = max(1, round((t[-1] - t[0]) / STEP))
            for part in np.array_split(np.arange(len(t)), pieces):
                self._process.say(self.batch(t[part] + self.clock_shift, position[part], torque[part]))
                self._process.serve()
                self._clock = float(t[part[-1]])
                self._turn()
            if self.touring:
                self.touring -= 1
                if not self.touring:
                    self.fast.job = self.job_after
                self._process.say(Progress(60 - self.touring, 60))
            if until():
                break
        self._clock = self.fast.t

    _clock = 0.0

    def now(self) -> float:
        return self._clock + self.clock_shift

    @property
    def _process(self) -> BusProcess:
        process = self.daemon.process
        assert isinstance(process, BusProcess)
        return process

    def _turn(self) -> None:
        now = self.now()
        self.daemon._messages()
        self.daemon._turn(now, stood_still=0.0)
        if self.failing.newly:
            self.failing.newly, self._failed_at = False, now
        if now - max(self._failed_at, self._judged_at - RIGHT_AGAIN + 1.0) > RIGHT_AGAIN:
            self.failing.active, self._judged_at = False, now
            self._judge(now)
            self.failing.active = True
        if any(b"WATCHDOG=1" in each for each in self.heard):
            self._alive_at = now
        self.heard.clear()
        if self.failing.failed["notify"] > self._deaf:
            self._deaf, self._deaf_at = self.failing.failed["notify"], now
        if now - self._alive_at > WATCHDOG and now - self._deaf_at > HEARD_AGAIN:
            self.wrong.append(f"{now:.1f} s: no sign of life for {now - self._alive_at:.1f} s")

    def _judge(self, now: float) -> None:
        """The state that a service shows of which nothing has failed for a while."""
        status = self.view.status()
        if status.detail or status.state not in (State.OBSERVING, State.SWEEPING):
            self.wrong.append(f"{now:.1f} s: {status.state} {status.detail}, last failure at {self._failed_at:.1f} s")
        kept = self.store.current(type(self.service.records.feed.calibration), self.arm)  # type: ignore[union-attr]
        if kept is None or status.records.calibration != kept.id:
            self.wrong.append(
                f"{now:.1f} s: record {status.records.calibration} in force, the store has {kept and kept.id}"
            )

    def lost(self) -> list[Any]:
        """Events that were said and are not in the journal.

        One that belongs to a proposal which could not be kept is said again with the next one, of another record; a
        proposal itself may also give way to a newer one of its joint.
        """

        def known_by(kind: str, joint: str | None, text: str) -> tuple[str, str | None, str]:
            return kind, joint, "" if kind == "proposal" else RECORD.sub("", text)

        kept = {known_by(event.kind, event.joint, event.text) for event in self.view.events(limit=1_000_000)}
        return sorted(map(str, {known_by(*said) for said in self.said} - kept))


def watched_drift(folder: Path, fails: Callable[[str, int], bool], patch: Any) -> FailingDaemon:
    """Two minutes in which joint 3 drifts and is recalibrated, while calls fail; then a minute of none."""
    daemon = FailingDaemon(folder, fails, patch)
    daemon.run(40)
    daemon.drift()
    daemon.run(80)
    daemon.failing.fails = lambda dependency, count: False
    daemon.run(60)
    return daemon


def events(daemon: FastDaemon) -> list[tuple[str, str | None]]:
    """Kind and joint of every event kept, those of the failures apart."""
    kept = daemon.view.events(limit=100_000)
    return sorted((event.kind, event.joint or "") for event in kept if event.kind not in OF_FAULTS)
