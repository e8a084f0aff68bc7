"""The diagnosis of the arm's own recordings once a day, and the trend of its friction, ripple, play and gains.

`armlink gap trend` does it in a process of its own, at low priority and the first to be killed if memory is short: this
package knows nothing of simulation models. The minute of the day in which the arm moved most is diagnosed.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.daemon.aside import NICE
from calib.daemon.environment import Environment
from calib.daemon.settings import Configuration, DiagnosisSettings
from calib.daemon.state.arm_state import BusiestMinute
from calib.daemon.state.events import EventLog

MOST_RECORDINGS = 7
"""Number of diagnosed recordings that are kept to look at: those of a week."""
LONGEST = 1800.0
"""A diagnosis that takes longer is ended [s]."""
TOLD, FOUND = "trend.json", "trend.new.json"
"""Changes that were told, and those of the diagnosis under way."""
STAMP = "%Y%m%dT%H%M%SZ"
"""Names of the recordings."""
UNFINISHED, WRITTEN = "unfinished", object()
"""Name of the recording while it is written; the sign that it is whole."""
FIRST_TO_KILL = "1000"
"""The process's oom_score_adj."""


class DailyDiagnosis:
    """Writes the recording, starts the process, tells its answer and what changes; `_go_on` and what it calls are for
    the disk's thread."""

    def __init__(
        self,
        configuration: Configuration,
        environment: Environment,
        events: EventLog,
        busiest: BusiestMinute,
        directory: Path,
    ) -> None:
        """Recordings and answers are kept in `directory`, which is made with the first one."""
        self._configuration, self._environment, self._events = configuration, environment, events
        self._busiest, self._directory = busiest, directory
        self._writing: Iterator[None] | None = None
        self._process: subprocess.Popen[str] | None = None
        now = environment.wall()
        newest = max((_date(path) for path in directory.glob("*.mcap")), default=now)
        self._begun = self._last = environment.monotonic() - max(0.0, (now - newest).total_seconds())
        self._failure = ""
        self._under_way = False
        self._told: list[tuple[str, str | None, str, dict[str, Any]]] = []
        """Events of the step under way."""

    @property
    def _settings(self) -> DiagnosisSettings:
        return self._configuration.settings.diagnosis

    def tick(self) -> None:
        """Write the recording and start the diagnosis if it is due, or tell what came of it."""
        if self._under_way:
            return
        now = self._environment.monotonic()
        if self._process is None and self._writing is None:
            self._writing = self._due(now)
        if self._process is not None or self._writing is not None:
            self._under_way = True
            self._environment.disk(lambda: self._go_on(now), self._went_on)

    def close(self) -> None:
        """End a diagnosis under way; it is made again with the next recording."""
        self._writing = None
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()

    def _go_on(self, now: float) -> None:
        if self._process is not None:
            self._ended(now)
        elif self._writing is not None:
            self._write_on(self._writing)

    def _went_on(self, outcome: Exception | None) -> None:
        self._under_way = False
        told, self._told = self._told, []
        for event in told:
            self._events.say(*event)
        if outcome is not None:
            raise outcome

    def _due(self, now: float) -> Iterator[None] | None:
        """The writing of the busiest minute, if a day has passed and the arm has moved."""
        settings = self._settings
        if not settings.enabled or now - self._last < 3600.0 * settings.hours:
            return None
        minute = self._busiest.take(settings.travel)
        if minute is None:
            return None
        self._last = now
        return minute.write(self._directory / UNFINISHED, self._configuration.names)

    def _write_on(self, writing: Iterator[None]) -> None:
        """Write another part; after the last one, begin."""
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            if next(writing, WRITTEN) is WRITTEN:
                self._writing = None
                self._start()
        except OSError as error:
            self._writing = None
            self._failed(str(error))

    def _start(self) -> None:
        now = self._environment.wall()
        (self._directory / UNFINISHED).replace(self._directory / f"{now:{STAMP}}.mcap")
        for old in sorted(self._directory.glob("*.mcap"))[:-MOST_RECORDINGS]:
            old.unlink(missing_ok=True)
        arm = self._configuration.arm.path
        model = arm.parent / self._settings.sim if self._settings.sim else arm
        command = [sys.executable, "-m", "armlink.cli", "gap", "trend", str(self._directory), "--sim", str(model)]
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._begun = self._environment.monotonic()
        (self._directory / FOUND).unlink(missing_ok=True)  # of a diagnosis that was ended: it is no answer of this one
        self._process = subprocess.Popen(
            [*command, "--json", str(self._directory / FOUND)],
            env={**os.environ, **threads},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        with contextlib.suppress(OSError):  # it may have ended, or the system may not permit it
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICE)
            Path(f"/proc/{self._process.pid}/oom_score_adj").write_text(FIRST_TO_KILL)

    def _ended(self, now: float) -> None:
        assert self._process is not None
        if self._process.poll() is None:
            if now - self._begun > LONGEST:
                self.close()
                self._failed(f"it took longer than {LONGEST / 60:.0f} min")
            return
        process, self._process = self._process, None
        said = process.communicate()[1].strip().splitlines()
        try:
            answer = json.loads((self._directory / FOUND).read_text())
        except (OSError, ValueError):
            self._failed(said[-1].removeprefix("armlink: ") if said else f"it ended with status {process.returncode}")
            return
        self._tell(answer)
        (self._directory / FOUND).replace(self._directory / TOLD)

    def _tell(self, found: dict[str, Any]) -> None:
        """The answer of the day, and the changes that were not told yet."""
        answer = found["newest"]["answer"]
        if "error" in answer:
            self._failed(answer["error"])
            return
        self._failure = ""
        causes = ", ".join(f"{cause['effect']} of {' and '.join(cause['joints'])}" for cause in answer["causes"])
        text = f"diagnosis of the day: {answer['verdict'].replace('_', ' ')}" + (f": {causes}" if causes else "")
        evidence = {"recording": found["newest"]["case"], "causes": answer["causes"]}
        self._told.append(("diagnosis", None, text, evidence))
        told = {_key(trend) for trend in _trends(self._directory / TOLD)}
        for trend in found["trends"]:
            if _key(trend) not in told:
                change = f"{trend['before']:.3g} to {trend['now']:.3g} {trend['unit']}"
                text = f"{trend['joint']}: wear: {trend['parameter']} of {trend['effect']} went from {change}"
                self._told.append(("wear", trend["joint"], f"{text} since {trend['since']}", trend))

    def _failed(self, why: str) -> None:
        """Say why there is no diagnosis, once for the same reason."""
        if why != self._failure:
            self._told.append(("diagnosis", None, f"there is no diagnosis of the day: {why}", {}))
        self._failure = why


def _date(recording: Path) -> datetime:
    try:
        return datetime.strptime(f"{recording.stem}+0000", f"{STAMP}%z")
    except ValueError:
        return datetime.min.replace(tzinfo=UTC)


def _trends(path: Path) -> list[dict[str, Any]]:
    try:
        return list(json.loads(path.read_text())["trends"])
    except (OSError, ValueError, KeyError):
        return []


def _key(trend: dict[str, Any]) -> tuple[str, str, str]:
    return trend["effect"], trend["joint"], trend["parameter"]
