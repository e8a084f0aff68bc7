"""The diagnosis of the arm's own recordings once a day, and the trend of its friction, ripple, play and gains.

`armlink gap trend` does it in a process of its own, at low priority and the first to be killed if memory is short: this
package knows nothing of simulation models. The minute of the day in which the arm moved most is diagnosed.
"""

import contextlib
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import Future
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.daemon.aside import NICE
from calib.daemon.environment import Environment
from calib.daemon.settings import Configuration
from calib.daemon.state.arm_state import BusiestMinute, Minute
from calib.daemon.state.events import EventLog

MOST_RECORDINGS = 7
"""Number of diagnosed recordings that are kept to look at: those of a week."""
LONGEST = 1800.0
"""A diagnosis that takes longer is ended [s]."""
TOLD, FOUND = "trend.json", "trend.new.json"
"""Changes that were told, and those of the diagnosis under way."""
STAMP = "%Y%m%dT%H%M%SZ"
"""Names of the recordings."""
UNFINISHED = "unfinished"
"""Name of the recording while it is written."""
FIRST_TO_KILL = "1000"
"""The process's oom_score_adj."""

Said = tuple[str, str | None, str, dict[str, Any]]
"""An event: kind, joint, text, evidence."""


class DailyDiagnosis:
    """Starts a thread for each diagnosis (`_diagnose`), and tells its answer and what changes."""

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
        now = environment.wall()
        newest = max((_date(path) for path in directory.glob("*.mcap")), default=now)
        self._last = environment.monotonic() - max(0.0, (now - newest).total_seconds())
        self._failure = ""
        self._under_way: Future[list[Said]] | None = None
        self._process: subprocess.Popen[str] | None = None
        self._closed = threading.Event()

    def tick(self) -> None:
        """Start a diagnosis if a day has passed and the arm has moved; say what came of one."""
        if self._under_way is not None:
            if self._under_way.done():
                answer, self._under_way = self._under_way, None
                for event in answer.result():
                    self._events.say(*event)
            return
        settings, now = self._configuration.settings.diagnosis, self._environment.monotonic()
        if not settings.enabled or now - self._last < 3600.0 * settings.hours:
            return
        minute = self._busiest.take(settings.travel)
        if minute is None:
            return
        self._last = now
        self._under_way = answer = Future[list[Said]]()

        def work() -> None:  # a daemon's thread: a disk that hangs keeps nobody from ending
            try:
                answer.set_result(self._diagnose(minute))
            except BaseException as error:
                answer.set_exception(error)

        threading.Thread(target=work, name="diagnosis", daemon=True).start()

    def close(self) -> None:
        """End a diagnosis under way; it is made again with the next recording."""
        self._closed.set()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _diagnose(self, minute: Minute) -> list[Said]:
        """Write the recording, diagnose it, and return the events that say what came of it."""
        folder, arm = self._directory, self._configuration.arm.path
        sim = self._configuration.settings.diagnosis.sim
        model = arm.parent / sim if sim else arm
        command = [sys.executable, "-m", "armlink.cli", "gap", "trend", str(folder), "--sim", str(model)]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            minute.write(folder / UNFINISHED, self._configuration.names)
            (folder / UNFINISHED).replace(folder / f"{self._environment.wall():{STAMP}}.mcap")
            for old in sorted(folder.glob("*.mcap"))[:-MOST_RECORDINGS]:
                old.unlink(missing_ok=True)
            (folder / FOUND).unlink(missing_ok=True)  # that of a diagnosis that was ended
            return self._run([*command, "--json", str(folder / FOUND)])
        except OSError as error:
            return self._failed(str(error))

    def _run(self, command: list[str]) -> list[Said]:
        if self._closed.is_set():
            return []
        self._process = process = subprocess.Popen(
            command,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if self._closed.is_set():  # meanwhile
            process.kill()
        with contextlib.suppress(OSError):  # it may have ended, or the system may not permit it
            os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(FIRST_TO_KILL)
        try:
            said = process.communicate(timeout=LONGEST)[1].strip().splitlines()
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return self._failed(f"it took longer than {LONGEST / 60:.0f} min")
        try:
            answer = json.loads((self._directory / FOUND).read_text())
        except (OSError, ValueError):
            return self._failed(
                said[-1].removeprefix("armlink: ") if said else f"it ended with status {process.returncode}"
            )
        events = self._told(answer)
        (self._directory / FOUND).replace(self._directory / TOLD)
        return events

    def _told(self, found: dict[str, Any]) -> list[Said]:
        """The answer of the day, and the changes that were not told yet."""
        answer = found["newest"]["answer"]
        if "error" in answer:
            return self._failed(answer["error"])
        self._failure = ""
        causes = ", ".join(f"{cause['effect']} of {' and '.join(cause['joints'])}" for cause in answer["causes"])
        text = f"diagnosis of the day: {answer['verdict'].replace('_', ' ')}" + (f": {causes}" if causes else "")
        evidence = {"recording": found["newest"]["case"], "causes": answer["causes"]}
        events: list[Said] = [("diagnosis", None, text, evidence)]
        told = {_key(trend) for trend in _trends(self._directory / TOLD)}
        for trend in found["trends"]:
            if _key(trend) not in told:
                change = f"{trend['before']:.3g} to {trend['now']:.3g} {trend['unit']}"
                text = f"{trend['joint']}: wear: {trend['parameter']} of {trend['effect']} went from {change}"
                events.append(("wear", trend["joint"], f"{text} since {trend['since']}", trend))
        return events

    def _failed(self, why: str) -> list[Said]:
        """Why there is no diagnosis, said once for the same reason."""
        before, self._failure = self._failure, why
        return [] if why == before else [("diagnosis", None, f"there is no diagnosis of the day: {why}", {})]


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
