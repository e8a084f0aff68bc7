"""The script of the documentation rolls the exported files out: to what the answer reports."""

import json
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, record

from armlink.recording.files import load_recording, save_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.export import write_model

PAGE = Path(__file__).parents[3] / "docs" / "diagnosing-a-gap.md"
SECONDS = 20
ARMS = {
    "friction": Wrong(coulomb=np.full(3, 0.6), load=np.array([0.0, 0.3, 0.0]), ripple=np.array([0.0, 0.0, 0.5])),
    "zero": Wrong(coulomb=0.4, load=np.array([0.0, 0.3, 0.0]), position_offset=np.array([0.0, 0.15, 0.0])),
}


def script() -> str:
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (found,) = [block for block in blocks if "roll_out(" in block]
    return found


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ARMS)
def test_the_reported_roll_out_is_that_of_the_exported_files(tmp_path, name):
    (tmp_path / "arm.xml").write_text(THREE)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    for seed, file in enumerate(("slow", "other"), start=1):
        made = record(model, ARMS[name], seed=seed, seconds=SECONDS, rate=50.0, noise=0.002, channels=("tau_motor",))
        save_recording(made, tmp_path / f"{file}.csv")
    train, other = (load_recording(tmp_path / f"{file}.csv") for file in ("slow", "other"))
    answer = diagnose(tmp_path / "arm.xml", [train], [other])
    write_model(answer.internals.model, answer.internals.estimate, tmp_path / "closed.xml")
    reported = json.loads(json.dumps(answer.to_json()))["rollout"]["after"]
    twice = script() + "print(roll_out(model, Effects(model), recording.t, recording.position, recording.motor_torque))"
    printed, again = (each.strip() + "]" for each in _run(tmp_path, twice).split("]")[:2])
    assert again == printed, "the model's friction is as it was before"
    assert np.fromstring(printed.strip().strip("[]"), sep=" ") == pytest.approx(reported, rel=0.02)
    assert np.all(answer.rollout.after < 0.5 * answer.rollout.before.max())


@pytest.mark.long
def test_the_module_needs_nothing_of_this_package(tmp_path):
    (tmp_path / "arm.xml").write_text(THREE)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    wrong = Wrong(coulomb=np.full(3, 0.6), load=np.array([0.0, 0.3, 0.0]))
    train = record(model, wrong, seed=1, seconds=SECONDS, rate=50.0, noise=0.002, channels=("tau_motor",))
    answer = diagnose(tmp_path / "arm.xml", [train])
    assert write_model(answer.internals.model, answer.internals.estimate, tmp_path / "closed.xml")
    packages = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")
    absent = "".join(f"sys.modules[{each!r}] = None\n" for each in packages)
    _run(tmp_path, f"import sys\n{absent}import closed_effects\nprint(closed_effects.MODEL)")


def _run(folder: Path, source: str) -> str:
    done = subprocess.run([sys.executable, "-c", source], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
