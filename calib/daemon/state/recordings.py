"""The daemon's own recordings: MCAP files of some minutes each; the oldest are dropped when the quota is full."""

import logging
from datetime import UTC, datetime
from pathlib import Path

from armlink.recording.mcap import RecordingWriter
from calib.daemon.environment import RunAside
from calib.daemon.loop.loop_messages import Batch
from calib.daemon.settings import Configuration, RecordingSettings

log = logging.getLogger("armlink.daemon")
LONGEST_PAUSE = 1.0
"""A pause in the samples longer than this begins a new file [s]."""
RETRY_SECONDS = 60.0
"""After a failure nothing is written for this time [s]."""
MOST_WAITING = 300
"""Batches that wait for the disk: those of 30 s; further ones are left out."""


class Recordings:
    """Writes samples at the configured rate; a disk that is full or fails is logged and never stops the daemon.

    Files are numbered, because the clock that stamps their names may be set back. `_write` and what it calls are for
    the thread that `run` gives work to.
    """

    def __init__(self, directory: Path, configuration: Configuration, run: RunAside) -> None:
        """Files go to `directory`, which is made with the first one."""
        self._directory, self._configuration, self._run = directory, configuration, run
        self._waiting, self._full = 0, False
        self._writer: RecordingWriter | None = None
        self._begun = self._last = self._due = -float("inf")
        self._failed_at = -float("inf")

    @property
    def _settings(self) -> RecordingSettings:
        return self._configuration.settings.recording

    def append(self, batch: Batch) -> None:
        """Have the samples of a batch that are due written."""
        if not self._settings.enabled:
            return
        full, self._full = self._full, self._waiting >= MOST_WAITING
        if self._full:
            if not full:
                log.error("recordings: the disk is too slow, so samples are left out")
            return
        self._waiting += 1
        self._run(lambda: self._append(batch), self._done)

    def close(self) -> None:
        """End the file that is open, once it is written."""
        self._waiting += 1
        self._run(self._end, self._done)

    def _done(self, outcome: Exception | None) -> None:
        self._waiting -= 1
        if outcome is not None:
            raise outcome

    def _append(self, batch: Batch) -> None:
        if batch.t[-1] - self._failed_at < RETRY_SECONDS:
            return
        try:
            pause, age = batch.t[0] - self._last, batch.t[0] - self._begun
            old = self._writer is not None and age > self._settings.minutes * 60.0
            if old or not 0.0 <= pause <= LONGEST_PAUSE:
                self._rotate(float(batch.t[0]))
            self._write(batch)
        except OSError as error:
            log.error("recordings: %s", error)
            self._failed_at = float(batch.t[-1])
            self._end()
        self._last = float(batch.t[-1])

    def _end(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                writer.__exit__(None, None, None)
            except OSError as error:
                log.error("recordings: %s", error)

    def _write(self, batch: Batch) -> None:
        assert self._writer is not None
        for k, t in enumerate(batch.t.tolist()):
            if t < self._due:
                continue
            self._due = max(self._due + 1 / self._settings.rate, t + 0.5 / self._settings.rate)
            self._writer.append(t - self._begun, {name: values[k] for name, values in batch.channels.items()})

    def _rotate(self, t: float) -> None:
        self._end()
        self._directory.mkdir(parents=True, exist_ok=True)
        self._keep_quota()
        last = max((path.name for path in self._directory.glob("*.mcap")), default="0")
        number = int(last.partition("-")[0]) + 1 if last.partition("-")[0].isdigit() else 1
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        self._writer = RecordingWriter(self._directory / f"{number:08d}-{stamp}.mcap", self._configuration.names)
        self._begun = self._due = t

    def _keep_quota(self) -> None:
        """Drop the oldest files until the rest and one more of the largest size fit the quota."""
        files = sorted(self._directory.glob("*.mcap"), key=lambda path: path.name)
        sizes = [path.stat().st_size for path in files]
        room = self._settings.quota_mb * 1e6 - max(sizes, default=0)
        total = sum(sizes)
        for path, size in zip(files, sizes, strict=True):
            if total <= room:
                break
            path.unlink(missing_ok=True)
            total -= size
