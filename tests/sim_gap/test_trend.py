"""One arm's recordings, one a day: the new one is diagnosed, and what changes is told, by command and by the daemon."""

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import wrong_arms
from typer.testing import CliRunner

from armlink.arm_file import load_arm
from armlink.recording.mcap import save_mcap
from calib.daemon.environment import Environment
from calib.daemon.observation.daily_diagnosis import DailyDiagnosis
from calib.daemon.settings import Configuration, DaemonSection, DiagnosisSettings
from sim_gap.commands.gap import app

START = datetime(2026, 11, 1, tzinfo=UTC)
WORN = 2.0
"""Of the friction of joint_2, which was 1 N·m [N·m]."""


def answer(friction: float) -> dict[str, Any]:
    """The parts of an answer that a trend follows."""
    value = {"value": friction, "ci95": [friction - 0.02, friction + 0.02], "unit": "N·m"}
    parameters = {"joint_2": {"torque": value}}
    return {"verdict": "explained", "causes": [{"effect": "friction.coulomb", "parameters": parameters}], "minor": []}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Fourteen days of answers, the last six of a worn joint, without their recordings; and a model."""
    random = np.random.default_rng(1)
    made = tmp_path / "diagnosis"
    made.mkdir()
    with (made / "answers.jsonl").open("w") as stream:
        for day in range(14):
            one = answer(random.normal(WORN if day > 7 else 1.0, 0.01))
            case = f"diagnosis/{START + timedelta(days=day):%Y%m%dT%H%M%SZ}.mcap"
            stream.write(json.dumps({"case": case, "answer": one}) + "\n")
    mujoco.mj_saveLastXML(str(tmp_path / "sim.xml"), wrong_arms.model())
    return made


def worn(path: Path) -> None:
    wrong = wrong_arms.Wrong(coulomb=np.array([0.0, WORN, 0.0]))
    save_mcap(wrong_arms.record(wrong_arms.model(), wrong, 1, seconds=20.0, rate=50.0), path)


class WornMinute:
    """In place of what the daemon has heard: always the same minute."""

    def take(self, least: float) -> "WornMinute":
        return self

    def write(self, path: Path, names: tuple[str, ...]) -> None:
        worn(path)


def test_by_command(folder: Path) -> None:
    worn(folder / "20261115T000000Z.mcap")
    out = folder / "trend.json"
    arguments = ["trend", str(folder), "--sim", str(folder.parent / "sim.xml"), "--json", str(out)]
    assert CliRunner().invoke(app, arguments, standalone_mode=False).return_value == 0
    told = json.loads(out.read_text())
    assert told["schema"] == "armlink.gap-trend/1"
    assert told["newest"]["case"] == "20261115T000000Z.mcap"
    assert "friction.coulomb" in [cause["effect"] for cause in told["newest"]["answer"]["causes"]]
    (change,) = told["trends"]
    assert (change["effect"], change["joint"], change["parameter"]) == ("friction.coulomb", "joint_2", "torque")
    assert change["now"] == pytest.approx(WORN, rel=0.05)
    lines = (folder / "answers.jsonl").read_text().splitlines()
    assert CliRunner().invoke(app, arguments, standalone_mode=False).return_value == 0
    assert (folder / "answers.jsonl").read_text().splitlines() == lines


@pytest.mark.long
def test_the_newest_is_that_of_the_latest_date(folder: Path) -> None:
    for name in ("a-2026-11-17.mcap", "b-2026-11-16.mcap"):
        worn(folder / name)
    out = folder / "trend.json"
    arguments = ["trend", str(folder), "--sim", str(folder.parent / "sim.xml"), "--json", str(out)]
    assert CliRunner().invoke(app, arguments, standalone_mode=False).return_value == 0
    assert json.loads(out.read_text())["newest"]["case"] == "a-2026-11-17.mcap"


@pytest.mark.long
def test_by_the_daemon(folder: Path) -> None:
    """What wears is an event, once."""
    said: list[tuple[Any, ...]] = []

    class Events:
        def say(self, *event: Any) -> None:
            said.append(event)

    def at_once(work: Any, done: Any) -> None:
        done(work())

    now = [START + timedelta(days=14)]
    settings = DaemonSection(diagnosis=DiagnosisSettings(sim=str(folder.parent / "sim.xml")))
    events, nothing = Events(), None
    daily = DailyDiagnosis(
        Configuration(load_arm("sarcos"), settings, listen_only=True),
        Environment(lambda: (now[0] - START).total_seconds(), lambda: now[0], at_once, nothing, at_once, at_once),  # type: ignore[arg-type]
        events,  # type: ignore[arg-type]
        WornMinute(),  # type: ignore[arg-type]
        folder,
    )
    for day in range(2):
        now[0] += timedelta(hours=24)
        end = time.monotonic() + 300.0
        while len([event for event in said if event[0] == "diagnosis"]) <= day and time.monotonic() < end:
            daily.tick()
            time.sleep(0.05)
    assert [event[:2] for event in said] == [("diagnosis", None), ("wear", "joint_2"), ("diagnosis", None)]
    assert "friction.coulomb went from 1" in said[1][2]
    assert said[1][3]["noticed"]
