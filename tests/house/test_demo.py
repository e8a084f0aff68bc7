"""`armlink demo` as a user runs it: the whole job in its own process, its figures, its report seen in a browser."""

import json
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow
SEED = 3
SECTIONS = (
    *("In short", "Sensor calibration", "Sweeps", "Gravity model", "Drift"),
    *("Verdict and causes", "Gap before and after", "The causes one by one", "Residuals"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    command = [sys.executable, "-m", "armlink.cli", "demo", "--seed", str(SEED), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout == ""
    for step in ("sweeping", "reference mass", "verifying", "drift", "gap"):
        assert step in done.stderr, f"says nothing of {step}"
    return out


@pytest.fixture(scope="module")
def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def test_sensors_are_found(summary):
    sensors = summary["sensors"]
    gain, offset = sensors["gain"], sensors["offset"]
    for joint in range(7):
        allowed = 0.01 if joint == 6 else 0.005
        assert abs(gain["estimated"][joint] / gain["true"][joint] - 1) < allowed, f"gain of joint_{joint + 1}"
        assert abs(offset["estimated"][joint] - offset["true"][joint]) < 0.05, f"offset of joint_{joint + 1}"
    inside = [
        low <= true <= high
        for each in sensors.values()
        for true, (low, high) in zip(each["true"], each["ci95"], strict=True)
    ]
    assert sum(inside) >= len(inside) - 5  # of 21 intervals, more than 5 miss once in 2000 runs


def test_the_gravity_model_is_true(summary):
    gravity = summary["gravity"]
    assert gravity["poses"] >= 200
    for rms, largest in zip(gravity["rms_error"], gravity["max_torque"], strict=True):
        assert rms < 0.005 * largest


def test_the_drift_is_seen_and_put_right(summary):
    drift = summary["drift"]
    assert drift["recalibrated"]
    assert drift["detected_after_s"] > 0
    assert abs(drift["gain_error_after"]) < 0.01
    assert abs(drift["offset_error_after"]) < 0.1


def test_the_gap_is_friction_and_closes(summary):
    gap = summary["gap"]
    assert gap["schema"] == "armlink.gap/2"
    assert gap["causes"][0]["effect"].startswith("friction.")
    heldout = gap["gap"]["heldout"]
    assert all(after < before for before, after in zip(heldout["before"], heldout["after"], strict=True))


def test_frames_travelled(summary):
    bus = summary["bus"]
    assert bus["rate_hz"] == pytest.approx(250)
    assert bus["frames"] > 15 * 250 * summary["sim_s"]
    assert 0.3 < bus["load"] < 0.6


def test_the_report_needs_nothing_from_elsewhere(folder):
    page = (folder / "report.html").read_text()
    assert not re.findall(r"<(?:script|img|link|iframe)[^>]+(?:src|href)=[\"'](?!data:|#)[^\"']+", page)


def test_the_report_is_seen_in_a_browser(folder, look):
    seen = look(folder / "report.html", height=7000)
    assert seen.console == ()
    assert seen.colours() > 50
    for section in SECTIONS:
        assert re.search(rf"<h2[^>]*>[^<]*{section}", seen.document), section
    assert seen.document.count('class="main-svg"') >= 10
    assert len(re.findall(r"joint_3", seen.document)) >= 5
