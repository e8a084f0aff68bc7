"""Real SocketCAN, real time: a small arm is swept; in the long test with a mass too, and controllers are written."""

from pathlib import Path

import numpy as np
import pytest
from small_pair import MASS, SEED, armlink, describe, simulated

from armlink.arm_file import load_arm
from calib.dataset import load_data
from sim_bus.truth import Truth

pytestmark = [pytest.mark.vcan, pytest.mark.long]  # quick: sweeps in lock-step, `test_sweep_run.py`

BUS = "socketcan:vcan0"
OPTIONS = ("--bus", BUS, "--yes", "--keep-going", "5", "--no-check-stops")
LOWEST, HIGHEST = 25.0, 100.0
"""Rates that are tried [Hz]: one emulated processor makes the cycles, simulates the arm and does the job."""


def described(folder: Path) -> Path:
    """The arm at a rate that this machine keeps."""
    describe(folder, rate=HIGHEST)
    host = armlink(folder, "check", "pair.yaml", "--host", "--seconds", "2", ok=(0, 1))
    return describe(folder, rate=float(np.clip(host["holds_hz"], LOWEST, HIGHEST)))


def test_a_short_sweep_is_complete_and_true(tmp_path: Path) -> None:
    path = described(tmp_path)
    with simulated(tmp_path, BUS):
        armlink(tmp_path, "sweep", "pair.yaml", "--out", "unloaded", *OPTIONS)
    data, truth = load_data(tmp_path / "unloaded"), Truth.draw(load_arm(str(path)), SEED)
    assert data.complete
    at = np.array([reading.position for reading in data.readings]) * truth.position_gain
    assert np.all((at > [0.95, -0.65]) & (at < [2.25, 0.65])), "readings lie between the stops"
    found = armlink(tmp_path, "calibrate", "unloaded", "--store", "records.db")
    assert found["gain"]["estimated"] == [None, None], "without a mass there are ratios alone"


def test_sweep_to_apply(tmp_path: Path) -> None:
    path = described(tmp_path)
    with simulated(tmp_path, BUS) as (pipe, _):
        armlink(tmp_path, "sweep", "pair.yaml", "--out", "unloaded", *OPTIONS)
        pipe.write_text(f"mass {MASS}\n")
        armlink(tmp_path, "sweep", "pair.yaml", "--out", "loaded", "--reference-mass", str(MASS), *OPTIONS)
        pipe.write_text("mass 0\n")
        words = ("calibrate", "unloaded", "loaded", "--apply", "--bus", BUS, "--store", "records.db")
        found = armlink(tmp_path, *words, tries=5)
    assert found["applied"]
    truth = Truth.draw(load_arm(str(path)), SEED)
    gain, offset = (np.array(found[name]["estimated"]) for name in ("gain", "offset"))
    assert np.abs(gain / truth.gain - 1).max() < 0.005
    assert np.abs(offset - truth.offset).max() < 0.05
