"""The arm as heard: connection, newest batch, faults; the last minutes and the busiest one in memory; recordings."""

import logging
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.loop.messages import BATCH_SECONDS, Batch
from armlink.recording.mcap import RecordingWriter
from calib.daemon.environment import Worker
from calib.daemon.settings import Configuration, RecordingSettings
from calib.daemon.state.events import EventLog

LONGEST_PAUSE = 10 * BATCH_SECONDS
"""A joint that is silent for longer is a fault, and a longer pause in the samples begins a new recording [s]."""
FAULT_EVENTS_AN_HOUR = 20
"""Further faults within the hour go to the process's log only, so that a loose plug does not fill the journal."""

JUDGED_CYCLES = 10_000
"""The host's lateness is judged after so many cycles: 99.9 % of fewer hang on a single one."""

log = logging.getLogger("armlink.daemon")


class ArmState:
    """Holds what the bus loop reports of bus and joints; turns its faults into events."""

    def __init__(self, arm: ArmFile, events: EventLog, monotonic: Callable[[], float]) -> None:
        self._arm, self._names, self._events, self._monotonic = arm, arm.joint_names, events, monotonic
        self.connected: bool | None = None
        """Whether the joints answer; None until the bus loop has reported for the first time."""
        self.fault = ""
        """Why not, in one line."""
        self.uncalibrated: tuple[str, ...] = ()
        """Joints that the host is to calibrate and has no record for."""
        self.batch: Batch | None = None
        """The newest samples."""
        self._heard_at = -float("inf")
        self._fault_times: list[float] = []
        self._told_late = False

    @property
    def late(self) -> float:
        """Time since the newest batch, or since the bus came back [s]; 0 before the first batch."""
        return 0.0 if self.batch is None else max(self._monotonic() - self._heard_at, 0.0)

    @property
    def silent(self) -> str:
        """The joint that has sent nothing for too long, in words; empty if all send."""
        if self.batch is None:
            return ""
        late = self.late if self.connected else 0.0
        ages = [float(age) + late for age in self.batch.age]
        worst = max(range(len(ages)), key=ages.__getitem__)
        if ages[worst] <= LONGEST_PAUSE:
            return ""
        return f"{self._names[worst]}: no reading has come for {ages[worst]:.1f} s"

    def heard(self, batch: Batch) -> None:
        """Take samples and the emergencies among them."""
        self.batch, self._heard_at = batch, self._monotonic()
        for event in batch.emergencies:
            name = self._names[event.joint]
            self._report("fault", name, f"{name}: {event.text}", dict(event.evidence))

    def calibrated(self, joints: Collection[str]) -> None:
        self.uncalibrated = tuple(name for name in self.uncalibrated if name not in joints)

    def tick(self) -> None:
        """Report once per connection that the host is nearly too late for the arm."""
        stats = None if self.batch is None else self.batch.stats
        if stats is None or self._told_late or stats.cycles < JUDGED_CYCLES:
            return
        warning = stats.lateness.near(self._arm.require_link().deadline, self._arm.argument)
        if warning:
            self._told_late = True
            self._report("late", None, warning, {"late_ms": stats.lateness.in_ms()})

    def up(self) -> None:
        self._told_late = False
        back = self.connected is False
        self.connected, self.fault, self._heard_at = True, "", self._monotonic()
        if back:
            self._report("recovered", None, "the bus is back", {})

    def down(self, reason: str) -> None:
        """The bus or a joint has failed."""
        was, self.connected = self.connected, False
        changed, self.fault = reason != self.fault, reason
        if was is not False:
            self._report("fault", None, reason, {})
        elif changed:
            log.warning(reason)

    def _report(self, kind: str, joint: str | None, text: str, evidence: dict[str, Any]) -> None:
        now = self._monotonic()
        self._fault_times = [t for t in self._fault_times if now - t < 3600.0]
        if len(self._fault_times) >= FAULT_EVENTS_AN_HOUR:
            log.warning(text)
            return
        self._fault_times.append(now)
        self._events.say(kind, joint, text, evidence)


WINDOW_SECONDS = 600.0
"""Older readings are dropped [s]."""
READ = ("position", "torque")
"""Channels that are kept as the bus loop reports them."""


class LiveWindow:
    """One row per batch, ten times a second; rows are never changed once they are kept."""

    def __init__(self, n: int) -> None:
        self._unknown = np.full(n, np.nan)
        self._rows: deque[tuple[float, tuple[Array, ...]]] = deque()

    def append(self, batch: Batch) -> None:
        """Keep the newest sample of a batch, and the temperatures with it."""
        t = float(batch.t[-1])
        if self._rows and t <= self._rows[-1][0]:
            self._rows.clear()
        temperature = self._unknown if batch.temperature is None else batch.temperature
        self._rows.append((t, (*(batch.channels[name][-1].copy() for name in READ), temperature)))
        while self._rows[0][0] < t - WINDOW_SECONDS:
            self._rows.popleft()

    def rows(self, seconds: float, most: int) -> tuple[Array, dict[str, Array]]:
        """Times (K,) [s], monotonic, and channels (K, n) of the last `seconds`, thinned evenly to at most `most`.

        Channels are `position` [rad], `torque` as sent [N·m] and `temperature` [°C]; NaN if missing.
        """
        first = self._rows[-1][0] - seconds if self._rows else 0.0
        kept = [row for row in self._rows if row[0] >= first]
        step = max(1, -(-len(kept) // most))
        kept = kept[::-1][::step][::-1]  # the newest is always among them
        n = len(self._unknown)
        values = np.array([row[1] for row in kept]).reshape(len(kept), len(READ) + 1, n)
        channels = {name: values[:, k] for k, name in enumerate((*READ, "temperature"))}
        return np.array([row[0] for row in kept]), channels


ROW_RATE = 250.0
"""Rows are thinned to about this rate if the bus is faster [Hz]."""


Rows = tuple[Array, dict[str, NDArray[np.float32]]]
"""Times (K,) [s], and channels (K, n)."""


@dataclass(frozen=True)
class Minute:
    """Rows at the full rate."""

    travel: float
    """Path of all joints together [rad]."""
    parts: tuple[Rows, ...]

    def write(self, path: Path, names: tuple[str, ...]) -> None:
        """Write an MCAP recording; raises OSError."""
        begun = self.parts[0][0][0]
        with RecordingWriter(path, names) as writer:
            for t, channels in self.parts:
                for k, at in enumerate((t - begun).tolist()):
                    writer.append(at, {name: values[k] for name, values in channels.items()})


class BusiestMinute:
    """Takes all samples, and keeps the minute with the most motion since it was asked last."""

    def __init__(self, rate: float) -> None:
        """For samples at `rate` [Hz]."""
        self._stride = max(1, round(rate / ROW_RATE))
        self._parts: list[Rows] = []
        self._travel = 0.0
        self._at: Array | None = None
        self._best: Minute | None = None

    def append(self, batch: Batch) -> None:
        t = batch.t[:: self._stride].copy()
        if self._parts and not 0.0 <= t[0] - self._parts[-1][0][-1] <= LONGEST_PAUSE:
            self._end()
        self._parts.append((t, {name: x[:: self._stride].astype(np.float32) for name, x in batch.channels.items()}))
        at = batch.channels["position"][-1]
        if self._at is not None:
            self._travel += float(np.nansum(np.abs(at - self._at)))
        self._at = at
        if t[-1] - self._parts[0][0][0] >= 60.0:
            self._end()

    def take(self, least: float) -> Minute | None:
        """The busiest minute if its path is `least` [rad] or more; the search begins again then."""
        found = self._best
        if found is None or found.travel < least:
            return None
        self._best = None
        return found

    def _end(self) -> None:
        if self._best is None or self._travel > self._best.travel:
            self._best = Minute(self._travel, tuple(self._parts))
        self._parts, self._travel, self._at = [], 0.0, None


RETRY_SECONDS = 60.0
"""After a failure nothing is written for this time [s]."""
MOST_WAITING = round(30 / BATCH_SECONDS)
"""Batches that wait for the disk: those of 30 s; further ones are left out."""


class Recordings:
    """Writes samples at the configured rate; a disk that is full or fails is logged and never stops the daemon.

    Files are numbered, because the clock that stamps their names may be set back. `_write` and what it calls are for
    the thread that `run` gives work to.
    """

    def __init__(self, directory: Path, configuration: Configuration, run: Worker) -> None:
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
