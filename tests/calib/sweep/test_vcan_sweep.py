"""Real SocketCAN, real time: a small arm is swept without and with a mass, calibrated, and its controllers written."""

from pathlib import Path

import numpy as np
import pytest
from small_pair import MASS, SEED, armlink, describe, simulated

from armlink.arm_file import load_arm
from sim_bus.truth import Truth

pytestmark = [pytest.mark.vcan, pytest.mark.sweep]

BUS = "socketcan:vcan0"
LOWEST, HIGHEST = 25.0, 100.0
"""Rates that are tried [Hz]: one emulated processor makes the cycles, simulates the arm and does the job."""


def test_sweep_to_apply(tmp_path: Path) -> None:
    describe(tmp_path, rate=HIGHEST)
    host = armlink(tmp_path, "check", "pair.yaml", "--host", "--seconds", "2", ok=(0, 1))
    path = describe(tmp_path, rate=float(np.clip(host["holds_hz"], LOWEST, HIGHEST)))
    options = ("--bus", BUS, "--yes", "--keep-going", "5", "--no-check-stops")
    with simulated(tmp_path, BUS) as (pipe, _):
        armlink(tmp_path, "sweep", "pair.yaml", "--out", "unloaded", *options)
        pipe.write_text(f"mass {MASS}\n")
        armlink(tmp_path, "sweep", "pair.yaml", "--out", "loaded", "--reference-mass", str(MASS), *options)
        pipe.write_text("mass 0\n")
        words = ("calibrate", "unloaded", "loaded", "--apply", "--bus", BUS, "--store", "records.db")
        found = armlink(tmp_path, *words, tries=5)
    assert found["applied"]
    truth = Truth.draw(load_arm(str(path)), SEED)
    gain, offset = (np.array(found[name]["estimated"]) for name in ("gain", "offset"))
    assert np.abs(gain / truth.gain - 1).max() < 0.005
    assert np.abs(offset - truth.offset).max() < 0.05
