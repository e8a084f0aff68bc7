"""The diagnosis of the day: which recording, when, in a process of its own, and what is said."""

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fast_daemon import FastDaemon

from armlink.arm_file import load_arm
from calib.daemon.environment import Environment
from calib.daemon.observing.daily_diagnosis import DailyDiagnosis
from calib.daemon.settings import Configuration, DaemonSection, DiagnosisSettings

SECONDS = 300.0
"""A process of low priority is given this time on a busy machine."""


class Bench:
    """A diagnosis with its own clock and events."""

    def __init__(self, directory: Path, sim: str = "absent.xml") -> None:
        self.time, self.said = datetime(2026, 11, 1, tzinfo=UTC), list[tuple[str, str | None, str, dict[str, Any]]]()
        settings = DaemonSection(diagnosis=DiagnosisSettings(sim=sim))
        configuration = Configuration(load_arm("sarcos"), settings, listen_only=True)
        nothing: Any = None
        environment = Environment(time.monotonic, lambda: self.time, nothing, nothing)
        self.daily = DailyDiagnosis(configuration, environment, self, directory)  # type: ignore[arg-type]

    def say(self, *event: Any) -> None:
        self.said.append(event)

    def day(self) -> None:
        """A day later, until something was said or the time is over."""
        before, end = len(self.said), time.monotonic() + SECONDS
        self.time += timedelta(hours=24)
        while len(self.said) == before and time.monotonic() < end:
            self.daily.tick()
            time.sleep(0.02)
            if self.daily._process is None:
                return


def recording(folder: Path, name: str) -> Path:
    path = folder / name
    path.write_bytes(name.encode())
    return path


def test_the_recording_with_the_most_motion_is_taken_once_a_day(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    for name, travel in (("little", 25.0), ("most", 80.0), ("less", 60.0), ("still", 0.0)):
        bench.daily.finished(recording(tmp_path, name), travel)
    bench.daily.tick()
    assert not (tmp_path / "diagnosis").exists()
    bench.time += timedelta(hours=24)
    bench.daily.tick()
    bench.daily.close()
    (kept,) = (tmp_path / "diagnosis").glob("*.mcap")
    assert kept.name == "20261102T000000Z.mcap"
    assert kept.read_bytes() == b"most"


def test_a_day_without_motion_has_none(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.daily.finished(recording(tmp_path, "still"), 1.0)
    bench.day()
    assert bench.said == []


def test_why_there_is_none_is_said_once(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    for _ in range(2):
        bench.daily.finished(recording(tmp_path, "any"), 30.0)
        bench.day()
    ((kind, joint, text, _),) = bench.said
    assert (kind, joint) == ("diagnosis", None)
    assert text.startswith("no diagnosis of the day: no model file ")
    assert "\n" not in text


def test_the_answer_of_one_that_was_ended_is_not_that_of_the_next(tmp_path: Path) -> None:
    bench, folder = Bench(tmp_path / "diagnosis"), tmp_path / "diagnosis"
    folder.mkdir()
    left = {"newest": {"case": "old", "answer": {"verdict": "no_gap", "causes": []}}, "trends": []}
    (folder / "trend.new.json").write_text(json.dumps(left))
    bench.daily.finished(recording(tmp_path, "any"), 30.0)
    bench.day()
    assert "no model file" in bench.said[0][2]


def test_a_recording_that_the_quota_took_is_no_end_of_the_daemon(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.daily.finished(tmp_path / "gone.mcap", 30.0)
    bench.day()
    assert "gone.mcap" in bench.said[0][2]


def test_closing_ends_the_process(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.daily.finished(recording(tmp_path, "any"), 30.0)
    bench.time += timedelta(hours=24)
    bench.daily.tick()
    process = bench.daily._process
    assert process is not None
    bench.daily.close()
    assert process.poll() is not None


def test_one_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.daily.finished(recording(tmp_path, "any"), 30.0)
    bench.time += timedelta(hours=24)
    bench.daily.tick()
    bench.time += timedelta(hours=1)
    bench.daily.tick()
    assert "took longer than 30 min" in bench.said[0][2]


@pytest.mark.slow
def test_the_service_diagnoses_what_it_has_recorded(tmp_path: Path) -> None:
    """Its recordings of the arm at work, against the arm file's own masses, after its day of three minutes."""
    settings = DaemonSection.model_validate({"recording": {"minutes": 1.0}, "diagnosis": {"hours": 0.05}})
    daemon = FastDaemon(tmp_path, 1, settings)
    daemon.run(300)
    end = time.monotonic() + SECONDS
    while not daemon.of_kind("diagnosis") and time.monotonic() < end:
        time.sleep(0.1)
        daemon.service.tick()
    (said,) = daemon.of_kind("diagnosis")
    assert said.text.startswith("diagnosis of the day: "), said.text
