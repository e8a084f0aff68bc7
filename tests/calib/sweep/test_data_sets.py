"""Data sets that are fitted together: none twice, an early end is said, folders of one name stay apart."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from sweep_arms import random_arm, synthetic_pass

from armlink.arm_file import ArmFile
from armlink.cli import run
from armlink.errors import BadInput
from calib.dataset import MANIFEST, DataWriter, Manifest, PlanLine, data_sets, labels, load_data
from calib.fit.sensor_fit import fit_sensors
from calib.plan.sweep_plan import plan_sweep
from sim_bus.truth import Truth

ARM = random_arm(1, 3)


def written(folder: Path, readings: int | None = None, planned: bool = True, arm: ArmFile = ARM, seed: int = 0) -> Path:
    """The first readings of a pass without load, as the sweep writes them."""
    data = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(seed))
    assert data.plan is not None
    with DataWriter(folder, Manifest.of(arm, 0.0)) as writer:
        if planned:
            writer.append(PlanLine(plan=data.plan, resolution=(1e-4,) * 3))
        for reading in data.readings[:readings]:
            writer.append(reading)
    return folder


def test_a_whole_data_set_is_taken_without_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (data,) = data_sets([written(tmp_path / "set")])
    assert data.complete
    assert data_sets([data]) == [data]
    assert not caplog.text


def test_the_same_readings_twice_are_refused(tmp_path: Path) -> None:
    first = written(tmp_path / "first")
    shutil.copytree(first, tmp_path / "copy")
    for other in (first, tmp_path / "copy"):
        with pytest.raises(BadInput, match=rf"{other} has the same readings as {first}, .*give one of the two"):
            data_sets([first, other])


def test_a_sweep_that_was_ended_early_says_where(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = written(tmp_path / "set", 14)
    (data,) = data_sets([folder])
    assert len(data.readings) == 14
    assert data.plan is not None
    last = data.plan.sweeps[0].name
    assert f"{folder} ended before the end of sweep {last}: the fit uses the readings so far" in caplog.text
    assert caplog.text.endswith(f"to continue: armlink sweep {data.manifest.arm_file} --out {folder} --resume\n")
    caplog.clear()
    data_sets([written(tmp_path / "scout", 2, planned=False)])
    assert "ended before its first sweep" in caplog.text


@pytest.mark.sample(3)
@pytest.mark.parametrize("readings", [1, 2, 5, 12, 25])
def test_whatever_is_there_is_fitted(readings: int, tmp_path: Path) -> None:
    """As typed while the sweep still runs."""
    fit = fit_sensors(ARM, data_sets([written(tmp_path / "set", readings)]))
    assert all((name, "gain") in fit.reasons for name in ARM.joint_names)


def test_the_command_refuses_twins_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(written(tmp_path / "set"))
    assert run(["calibrate", folder, folder, "--store", str(tmp_path / "records.db")]) == 2
    assert capsys.readouterr().err == (
        f"armlink: {folder} has the same readings as {folder}, which would count twice: give one of the two\n"
    )


def test_folders_of_one_name_stay_apart(tmp_path: Path) -> None:
    """Their sweeps are two series each, and the record names both."""
    folders = [written(tmp_path / day / "bare", seed=seed) for seed, day in enumerate(("monday", "tuesday"))]
    fit = fit_sensors(ARM, data_sets(folders))
    assert list(fit.sources) == labels(folders) == [str(folder) for folder in folders]
    assert len(fit.rows.sweeps) == 2 * len({reading.sweep for reading in data_sets(folders)[0].readings})


def test_the_folder_that_one_stands_in_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert labels([Path()]) == [tmp_path.name]


@pytest.mark.parametrize("content", ["[" * 100_000, "{", "[1]", '{"schema": "armlink.sweep/1"}'])
def test_a_manifest_that_is_none_is_refused_in_one_line(content: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(content)
    with pytest.raises(BadInput, match=MANIFEST) as refused:
        load_data(tmp_path)
    assert "\n" not in str(refused.value)
