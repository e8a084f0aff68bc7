"""docs/no-torque-sensors.md: each of its commands in order, in lock-step on a short arm; then the same data in Python.

The bus is in each command's own process, so the arm is a new one every time. `make creepwalk` types the page in real
time on the simulated OpenArm, `armlink float` included, which needs the drives as the records were made for them.
"""

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import armlink
from armlink import cli

sys.path.append(str(Path(__file__).parent.parent / "campaigns"))
sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from creep_walk import PAGE
from docs_walk import left_out, lines_of
from soft_links import CREEP, JOINTS, SIM

DRIVE = {"family": "damiao", "model": "DM4340", "kp": 50, "kd": 5}
LIMITS = {"rated_torque": 9.0, "max_torque": 22.0}
ARM = {
    "name": "two",
    "serial": "DOCS",
    "kinematics": {
        "gravity": [9.80665, 0.0, 0.0],
        "joints": JOINTS,
    },
    "link": {
        "bus": {"interface": "armlink_sim", "channel": "my-openarm.yaml"},
        "rate": 50,
        "joints": [
            {"name": name, "drive": {**DRIVE, "id": place, "reply": place + 16}, **LIMITS}
            for place, name in enumerate(("upper", "fore"), start=1)
        ],
        "park": {"pose": [0.0, 0.0], "speed": 0.4},
    },
    "sweep": {"creep": CREEP},
    "sim": SIM,
}
PASSES = ("unloaded", "loaded", "unloaded-again")
NOT_HERE = ("armlink float", "armlink drives", "armlink sweep openarm --plan")
"""See above; blocks that tests/house/test_docs.py runs. The passes named dry… are those of the real arm once more."""


def here(line: str) -> str:
    """A line with the short arm, which stands ready, and whose mass hangs on it where the line says so."""
    line = line.replace("armlink new openarm --out my-openarm.yaml", "armlink new my-openarm.yaml --out copy.yaml")
    line = line.replace(" openarm ", " my-openarm.yaml ").replace("socketcan:can0", "armlink_sim:my-openarm.yaml")
    if line.startswith("armlink sweep") and "--plan" not in line and "--dry-run" not in line:
        line += " --dry-run"
    if "--out unloaded-again" in line:
        line += " --seed 1"  # another plan: the same arm in lock-step would give the same readings
    return f"{line} --yes" if line.startswith("armlink check") else line


@pytest.mark.long
def test_every_command_of_the_page_and_the_same_in_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    Path("my-openarm.yaml").write_text(yaml.safe_dump(ARM))
    for line in lines_of(PAGE):
        if left_out(line) or line.startswith(NOT_HERE) or " dry" in line:
            continue
        status = cli.run(shlex.split(here(line))[1:])
        said = capsys.readouterr()
        assert status == 0, f"{line}: {said.err}"
    report = Path("calibration.html").read_text()
    assert all(each in report for each in ("Creep sweeps", "upper", "fore", "Coulomb friction [N·m]"))
    copied = armlink.load_arm("copy.yaml")
    assert copied.serial == "DOCS"
    assert copied.require_link().bus.channel.endswith("my-openarm.yaml")

    sensors = armlink.calibrate(*PASSES)
    gravity = armlink.identify(*PASSES, sensors=sensors)
    assert np.isfinite(sensors.value("gain")).all()
    assert np.isnan(sensors.value("position_offset")[-1])
    low, high = sensors.ci95("coulomb")[0]
    assert 0 < low < high < 1.0
    assert armlink.verify("my-openarm.yaml", gravity, sensors, simulated=True, poses=3).passed
    with pytest.raises(armlink.ArmlinkError, match="store no calibration"):
        armlink.verify("my-openarm.yaml", gravity, simulated=True)
