"""The diagnosis of the day: which recording, when, in a process of its own, and what is said."""

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fast_daemon import FastDaemon
from same_thread import Immediate

from armlink.arm_file import load_arm
from armlink.link.types import Stats
from armlink.loop.messages import CHANNELS, Batch
from armlink.recording.files import load_recording
from calib.daemon.environment import Environment
from calib.daemon.observation import daily_diagnosis
from calib.daemon.observation.daily_diagnosis import DailyDiagnosis
from calib.daemon.settings import Configuration, DaemonSection, DiagnosisSettings
from calib.daemon.state.arm_state import BusiestMinute, Minute

PATIENCE = 3600.0
"""A process of low priority is given this time on a busy machine [s]."""


class Bench:
    """A diagnosis with its own clock and events."""

    def __init__(self, directory: Path, sim: str = "absent.xml") -> None:
        self.time, self.said = datetime(2026, 11, 1, tzinfo=UTC), list[tuple[str, str | None, str, dict[str, Any]]]()
        settings = DaemonSection(diagnosis=DiagnosisSettings(sim=sim))
        configuration = Configuration(load_arm("sarcos"), settings, listen_only=True)
        nothing: Any = None
        begun, self.set_by = self.time, timedelta()
        environment = Environment(
            lambda: (self.time - begun).total_seconds(),
            lambda: self.time + self.set_by,
            nothing,
            nothing,
            Immediate(),
            nothing,
        )
        self.busiest, self.joints, self.now = BusiestMinute(250.0), len(configuration.names), 0.0
        self.daily = DailyDiagnosis(configuration, environment, self, self.busiest, directory)  # type: ignore[arg-type]

    def work(self, travel: float) -> None:
        """A minute in which the first joint goes `travel` [rad]."""
        for seconds, angle in ((60.0, 0.0), (0.1, travel)):
            t = self.now + np.arange(0.0, seconds, 0.004)
            position = np.zeros((len(t), self.joints))
            position[:, 0] = angle
            channels = dict.fromkeys(CHANNELS, position)
            self.busiest.append(Batch(t, channels, np.zeros(self.joints, int), np.zeros(self.joints), Stats()))
            self.now = t[-1] + 0.004

    def due(self) -> None:
        """A day later, until the process has begun, or nothing is under way."""
        self.time += timedelta(hours=24)
        before, end = self.daily._process, time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.daily.tick()
            if self.daily._under_way is None or self.daily._process is not before:
                return
            time.sleep(0.01)

    def say(self, *event: Any) -> None:
        self.said.append(event)

    def day(self) -> None:
        """A day later, until something was said or the time is over."""
        before, end = len(self.said), time.monotonic() + PATIENCE
        self.time += timedelta(hours=24)
        while len(self.said) == before and time.monotonic() < end:
            self.daily.tick()
            if self.daily._under_way is None:
                return
            time.sleep(0.02)


def in_place_of_a_diagnosis(program: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that answers at once; a diagnosis takes seconds to start."""
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o700)
    monkeypatch.setattr(daily_diagnosis, "sys", SimpleNamespace(executable=str(program)))


@pytest.fixture
def without_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = "echo 'armlink: no model file absent.xml' >&2\nexit 2"
    in_place_of_a_diagnosis(tmp_path / "program", script, monkeypatch)


def test_the_minute_with_the_most_motion_is_taken_once_a_day(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    for travel in (25.0, 80.0, 60.0, 0.0):
        bench.work(travel)
    bench.daily.tick()
    assert not (tmp_path / "diagnosis").exists()
    bench.due()
    bench.daily.close()
    (kept,) = (tmp_path / "diagnosis").glob("*")
    assert kept.name == "20261102T000000Z.mcap"
    found = load_recording(kept)
    assert found.position[-1, 0] == 80.0
    assert len(found.t) == 15_025
    assert found.t[0] == 0.0
    np.testing.assert_allclose(np.diff(found.t), 0.004, atol=1e-8)
    time_before = bench.daily._last
    bench.due()
    assert bench.daily._last == time_before, "each minute is diagnosed once"


def test_a_wall_clock_that_is_set_brings_no_diagnosis_and_puts_none_off(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.work(25.0)
    bench.set_by = timedelta(days=3)
    bench.daily.tick()
    assert bench.daily._under_way is None
    assert not (tmp_path / "diagnosis").exists()
    bench.set_by = timedelta(days=-3)
    bench.due()
    bench.daily.close()
    assert len(list((tmp_path / "diagnosis").glob("*.mcap"))) == 1


def test_a_pause_ends_a_minute(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    for _ in range(2):
        bench.work(20.0)
        bench.now += 5.0
    minute = bench.busiest.take(0.0)
    assert minute is not None
    assert minute.travel == 20.0


def test_a_fast_bus_is_thinned() -> None:
    fast = BusiestMinute(1000.0)
    t = np.arange(0.0, 60.1, 0.001)
    channels = dict.fromkeys(CHANNELS, np.zeros((len(t), 2)))
    fast.append(Batch(t, channels, np.zeros(2, int), np.zeros(2), Stats()))
    minute = fast.take(0.0)
    assert minute is not None
    assert len(minute.parts[0][0]) == len(t) / 4


def test_a_day_without_motion_has_none(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.work(1.0)
    bench.day()
    assert bench.said == []


def test_why_there_is_none_is_said_once(tmp_path: Path, without_model: None) -> None:
    bench = Bench(tmp_path / "diagnosis")
    for _ in range(2):
        bench.work(30.0)
        bench.day()
    ((kind, joint, text, _),) = bench.said
    assert (kind, joint) == ("diagnosis", None)
    assert text.startswith("there is no diagnosis of the day: no model file ")
    assert "\n" not in text


def test_the_answer_of_one_that_was_ended_is_not_that_of_the_next(tmp_path: Path, without_model: None) -> None:
    bench, folder = Bench(tmp_path / "diagnosis"), tmp_path / "diagnosis"
    folder.mkdir()
    left = {"newest": {"case": "old", "answer": {"verdict": "no_gap", "causes": []}}, "trends": []}
    (folder / "trend.new.json").write_text(json.dumps(left))
    bench.work(30.0)
    bench.day()
    assert "no model file" in bench.said[0][2]


def test_a_directory_that_cannot_be_written_is_no_end_of_the_daemon(tmp_path: Path, without_model: None) -> None:
    (tmp_path / "diagnosis").write_text("a file")
    bench = Bench(tmp_path / "diagnosis")
    bench.work(30.0)
    bench.day()
    assert "diagnosis" in bench.said[0][2]
    (tmp_path / "diagnosis").unlink()
    bench.work(30.0)
    bench.day()
    assert "no model file" in bench.said[1][2]


def test_a_recording_half_written_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(self: Minute, path: Path, names: tuple[str, ...]) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(Minute, "write", half)
    bench = Bench(tmp_path / "diagnosis")
    bench.work(30.0)
    bench.day()
    assert "no space left" in bench.said[0][2]
    assert not list((tmp_path / "diagnosis").glob("*.mcap"))


def test_after_the_end_none_begins(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.work(30.0)
    bench.daily.close()
    bench.due()
    assert bench.daily._process is None


def test_closing_ends_the_process(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "diagnosis")
    bench.work(30.0)
    bench.due()
    process = bench.daily._process
    assert process is not None
    bench.daily.close()
    assert process.poll() is not None


def test_one_that_takes_too_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_place_of_a_diagnosis(tmp_path / "program", "exec sleep 3600", monkeypatch)
    monkeypatch.setattr(daily_diagnosis, "LONGEST", 0.6)
    bench = Bench(tmp_path / "diagnosis")
    bench.work(30.0)
    bench.day()
    assert "took longer than 0 min" in bench.said[0][2]
    process = bench.daily._process
    assert process is not None
    assert process.poll() is not None


def test_the_causes_are_said_each_day_and_wear_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cause = {"effect": "friction.coulomb", "joints": ["joint_1", "joint_2"]}
    trend: dict[str, Any] = {"effect": "friction.coulomb", "joint": "joint_2", "parameter": "torque", "unit": "N·m"}
    trend |= {"before": 0.5, "now": 0.75, "since": "2026-10-01"}
    newest = {"case": "20261102T000000Z", "answer": {"verdict": "no_gap", "causes": [cause]}}
    (tmp_path / "answer").write_text(json.dumps({"newest": newest, "trends": [trend]}))
    script = f'for last; do :; done\ncp {tmp_path / "answer"} "$last"'
    in_place_of_a_diagnosis(tmp_path / "program", script, monkeypatch)
    bench = Bench(tmp_path / "diagnosis")
    for _ in range(2):
        bench.work(30.0)
        bench.day()
    text = "diagnosis of the day: no gap: friction.coulomb of joint_1 and joint_2"
    said = ("diagnosis", None, text, {"recording": "20261102T000000Z", "causes": [cause]})
    wear = "joint_2: wear: torque of friction.coulomb went from 0.5 to 0.75 N·m since 2026-10-01"
    assert bench.said == [said, ("wear", "joint_2", wear, trend), said]


@pytest.mark.long
def test_the_service_diagnoses_what_it_has_recorded(tmp_path: Path) -> None:
    """Its recordings of the arm at work, against the arm file's own masses, after its day of three minutes."""
    settings = DaemonSection.model_validate({"diagnosis": {"hours": 0.05}})
    planar = Path(__file__).parents[3] / "examples" / "planar3.yaml"
    daemon = FastDaemon(tmp_path, 1, settings, str(planar))
    daemon.run(300)
    end = time.monotonic() + PATIENCE
    while not daemon.of_kind("diagnosis") and time.monotonic() < end:
        time.sleep(0.1)
        daemon.service.tick()
    (said,) = daemon.of_kind("diagnosis")
    assert said.text.startswith("diagnosis of the day: "), said.text
