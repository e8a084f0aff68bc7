"""A daemon whose dependencies fail at chosen calls: record store, journal, disk of the recordings."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from fast_daemon import FastDaemon

from armlink.recording.mcap import RecordingWriter
from calib.daemon.settings import DaemonSection

DEPENDENCIES = ("store", "journal", "disk")
OF_FAULTS = ("fault", "recovered", "started")
"""Kinds of events that say of the failures themselves."""


class Failing:
    """Counts the calls of each dependency, and fails those that `fails(dependency, count)` names."""

    def __init__(self, fails: Callable[[str, int], bool]) -> None:
        self.fails, self.calls, self.failed = fails, dict.fromkeys(DEPENDENCIES, 0), 0

    def call(self, dependency: str, error: type[Exception]) -> None:
        self.calls[dependency] += 1
        if self.fails(dependency, self.calls[dependency]):
            self.failed += 1
            raise error(f"{dependency} failed")

    def attach(self, daemon: FastDaemon, patch: Any) -> None:
        """From now on the daemon's calls go through here."""
        journal, append = daemon.service.journal, RecordingWriter.append

        @sa.event.listens_for(daemon.store._engine, "do_execute")
        def execute(*_: object) -> None:
            self.call("store", sqlite3.OperationalError)

        def write(writer: RecordingWriter, *row: Any) -> None:
            self.call("disk", OSError)
            append(writer, *row)

        journal._db = FailingDatabase(journal._db, self)
        patch.setattr(RecordingWriter, "append", write)


class FailingDatabase:
    """An SQLite connection whose statements may fail."""

    def __init__(self, db: sqlite3.Connection, failing: Failing) -> None:
        self._db, self._failing = db, failing

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        self._failing.call("journal", sqlite3.OperationalError)
        return self._db.execute(*statement)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._db, name)


def watched_drift(folder: Path, fails: Callable[[str, int], bool], patch: Any) -> tuple[FastDaemon, Failing]:
    """Two minutes in which joint 3 drifts and is recalibrated, while calls fail; then half a minute of none."""
    section = DaemonSection.model_validate({"policy": "apply", "recording": {"rate": 1.0}})
    daemon, failing = FastDaemon(folder, 1, section), Failing(fails)
    failing.attach(daemon, patch)
    daemon.run(40)
    daemon.fast.gain[2] *= 1.03
    daemon.fast.offset[2] += 0.3
    daemon.run(80)
    failing.fails = lambda dependency, count: False
    daemon.run(30)
    return daemon, failing


def events(daemon: FastDaemon) -> list[tuple[str, str | None]]:
    """Kind and joint of every event kept, those of the failures apart."""
    kept = daemon.view.events(limit=100_000)
    return sorted((event.kind, event.joint or "") for event in kept if event.kind not in OF_FAULTS)
