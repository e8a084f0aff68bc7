"""Answers of commands as JSON, and what they ask of the rest."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from calib.commands import float as float_command
from calib.commands.identify import _answer
from calib.sweep.sweep_pass import give_up


def test_a_gravity_model_is_told_with_its_record_and_uncertainty() -> None:
    fit = SimpleNamespace(
        names=("joint_1",),
        beta=np.array([1.0, 2.0]),
        std=np.array([0.1, 0.2]),
        identifiable=np.array([True, False]),
        recursive=None,
        residual_rms=np.array([0.3]),
    )
    assert _answer(fit, "0123abcd") == {
        "schema": "armlink.gravity/1",
        "record": "0123abcd",
        "joints": ["joint_1"],
        "beta": [1.0, 2.0],
        "std": [0.1, 0.2],
        "identifiable": [True, False],
        "recursive": None,
        "residual_rms": [0.3],
    }


def test_floating_is_told_with_the_arm_that_floated(monkeypatch) -> None:
    """Without an end it is asked for as an endless one."""
    arm = SimpleNamespace(name="test", joint_names=("joint_1",))
    lateness = SimpleNamespace(in_ms=lambda: {"p99": 0.1})
    link = SimpleNamespace(start=lambda: None, enable=lambda: None, stats=SimpleNamespace(lateness=lateness))
    asked, told = [], []

    @contextmanager
    def open_arm(arm_file: object, bus: str | None):
        assert arm_file is arm
        yield link

    def run_float(link: object, arm_file: object, beta: object, calibration: object, seconds: float) -> object:
        asked.append((arm_file, seconds))
        one = np.array([0.5])
        return SimpleNamespace(seconds=2.0, largest_torque=one, largest_speed=one, moved=one)

    monkeypatch.setattr("armlink.arm_file.load_arm", lambda name: arm)
    monkeypatch.setattr("armlink.loop.open.open_arm", open_arm)
    monkeypatch.setattr("calib.floating.run.run_float", run_float)
    monkeypatch.setattr("calib.commands.screen.warn_late", lambda arm_file, lateness: None)
    monkeypatch.setattr("armlink.commands.output.write_json", lambda path, answer: told.append(answer))
    monkeypatch.setattr(float_command, "_model", lambda arm_file, record, store: (None, None, "gravity record x"))
    float_command.hold_afloat("test", None, 0.0, None, None, None)
    assert asked == [(arm, float("inf"))]
    assert told[0]["joints"] == ["joint_1"]
    assert told[0]["late_ms"] == {"p99": 0.1}


def test_a_stall_is_given_up_unless_somebody_goes_on() -> None:
    assert give_up(None) is False
