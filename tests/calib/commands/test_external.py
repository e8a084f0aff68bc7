"""`armlink external` on recordings of an arm with a model file alone, and of one with records."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet
import pytest

from armlink.arm_file import load_arm
from armlink.cli import run
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from calib.external.arm_model import averaged_samples
from calib.records.records import GravityRecord, matrix, provenance
from calib.records.store import RecordStore
from gcomp.arm.load import inertial_torque, load_model, place_chain
from gcomp.gravity.torque import gravity_torque

LINK = (
    "<body pos='{0} 0 0'><joint name='{1}' axis='0 1 {2}'/>"
    "<inertial pos='0.2 0.02 0.05' mass='{3}' diaginertia='0.02 0.03 0.02'/>"
)
MODEL = f"""<mujoco><worldbody>{LINK.format(0, "j1", 0.5, 2)}{LINK.format(0.4, "j2", 0, 1.5)}
{LINK.format(0.3, "j3", -1, 1)}</body></body></body></worldbody></mujoco>"""
SECONDS = 40.0


def friction_side(q: np.ndarray) -> np.ndarray:
    """Direction of friction, which turns round over 10 mrad."""
    side = np.zeros_like(q)
    for row in range(1, len(q)):
        side[row] = np.clip(side[row - 1] + (q[row] - q[row - 1]) / 0.005, -1.0, 1.0)
    return side


def recording(model: Path, seed: int, push: float = 0.0) -> Recording:
    """Of swinging joints with friction; a push on the second joint from 20 to 21 s."""
    random, t = np.random.default_rng(seed), np.arange(0.0, SECONDS, 0.02)
    placed = place_chain(model)
    pace, phase = random.uniform(0.5, 1.5, (2, 3)), random.uniform(0, 6, (2, 3))
    angle = t[:, None, None] * pace + phase
    q, v, a = 0.6 * np.sin(angle), 0.6 * pace * np.cos(angle), -0.6 * pace**2 * np.sin(angle)
    q, v, a = (each.sum(axis=1) for each in (q, v, a))
    torque = inertial_torque(placed, q, v, a) + gravity_torque(placed.arm.arm, placed.arm.beta, q)
    torque += 0.4 * friction_side(q) + 0.02 * random.normal(size=q.shape)
    torque -= np.outer((t >= 20.0) & (t < 21.0), [0.0, push, 0.0])
    return Recording(t=t, position=q, velocity=v, motor_torque=torque)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("external")
    (folder / "arm.xml").write_text(MODEL)
    for name, seed, push in (
        ("free_1", 1, 0.0),
        ("free_2", 4, 0.0),
        ("free_3", 5, 0.0),
        ("free_4", 6, 0.0),
        ("quiet", 2, 0.0),
        ("pushed", 3, 8.0),
    ):
        save_recording(recording(folder / "arm.xml", seed, push), folder / f"{name}.csv")
    rows = (folder / "quiet.csv").read_text().splitlines(keepends=True)
    (folder / "short.csv").write_text("".join(rows[:40]))
    return folder


def test_a_push_is_found_and_free_motion_is_quiet(workplace, capsys):
    words = ["external", "arm.xml", "quiet.csv", "pushed.csv", "--out", "out.csv"]
    words += [word for k in range(1, 5) for word in ("--baseline", f"free_{k}.csv")]
    with pytest.MonkeyPatch.context() as here:
        here.chdir(workplace)
        assert run([*words, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["channel"] == "motor_torque"
    assert answer["baseline_s"] == pytest.approx(4 * SECONDS, abs=4.0)
    quiet, pushed = answer["recordings"]
    assert quiet["events"] == []
    assert [event["kind"] for event in pushed["events"]] == ["contact"]
    assert pushed["events"][0]["t"] == pytest.approx(20.1, abs=0.2)
    assert pushed["events"][0]["link"] != "j1"
    with (workplace / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    middle = [row for row in rows[len(rows) // 2 :] if 20.5 < float(row["t"]) < 20.9]
    told = np.array([float(row["tau_ext_2"]) for row in middle])
    assert told == pytest.approx(8.0, abs=1.5)


def test_joints_of_a_recording_are_found_by_their_names(workplace, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    plain = recording(Path("arm.xml"), 3, 8.0)
    channels = {name: getattr(plain, name)[:, ::-1] for name in ("position", "velocity", "motor_torque")}
    save_recording(Recording(t=plain.t, names=("j3", "j2", "j1"), **channels), tmp_path / "turned.mcap")
    words = ["external", "arm.xml", "pushed.csv", str(tmp_path / "turned.mcap"), "--baseline", "free_1.csv"]
    assert run([*words, "--json", "-"]) == 0
    one, other = json.loads(capsys.readouterr().out)["recordings"]
    assert other["rms"] == pytest.approx(one["rms"], rel=1e-3)


def lerobot(folder: Path, episodes: list[Recording]) -> None:
    """A data set of 30 rows a second, with efforts."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    described = {"observation.state": {"names": ["j1.pos", "j2.pos", "j3.pos"]}, "observation.effort": {"shape": [3]}}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": described}))
    columns: dict[str, list[Any]] = {name: [] for name in ("episode_index", "timestamp", "action", *described)}
    for number, each in enumerate(episodes):
        t = np.arange(0.0, each.t[-1], 1 / 30)
        columns["timestamp"] += t.tolist()
        columns["episode_index"] += [number] * len(t)
        for names, values in (
            (("observation.state", "action"), each.position),
            (("observation.effort",), each.motor_torque),
        ):
            rows = np.stack([np.interp(t, each.t, column) for column in values.T], axis=1).tolist()
            for name in names:
                columns[name] += rows
    pa_parquet.write_table(pa.table(columns), folder / "data" / "file-000.parquet")


def test_a_lerobot_data_set_gets_observations(workplace, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    lerobot(tmp_path / "set", [recording(Path("arm.xml"), 2), recording(Path("arm.xml"), 3, 8.0)])
    free = [word for k in range(1, 5) for word in ("--baseline", f"free_{k}.csv")]
    words = ["external", "arm.xml", str(tmp_path / "set"), *free, "--out", str(tmp_path / "keys.parquet")]
    assert run(words) == 0
    table = pa_parquet.read_table(tmp_path / "keys.parquet")
    rows = pa_parquet.read_table(tmp_path / "set" / "data" / "file-000.parquet")
    assert table["episode_index"].to_pylist() == rows["episode_index"].to_pylist()
    t, episode = np.array(table["timestamp"]), np.array(table["episode_index"])
    assert t == pytest.approx(np.array(rows["timestamp"]), abs=1e-5)
    torque = np.array(table["observation.external_torque"].to_pylist())
    assert np.isfinite(torque[t > 0.1]).all()
    middle = (t > 20.5) & (t < 20.9)
    assert torque[middle & (episode == 1), 1] == pytest.approx(8.0, abs=1.5)
    assert np.abs(torque[middle & (episode == 0), 1]).max() < 0.2
    wrench = np.array(table["observation.external_wrench"].to_pylist())
    assert wrench.shape == (len(t), 6)


def test_what_is_learned_is_kept_in_a_file(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    assert (
        run(["external", "arm.xml", "--baseline", "free_1.csv", "--learned", "kept.npz", "--false-alarms", "2/h"]) == 0
    )
    assert "kept.npz is written: it holds 39 s of work without contact" in capsys.readouterr().out
    answers = []
    for words in ("--baseline free_1.csv", "--learned kept.npz"):
        capsys.readouterr()
        assert run(["external", "arm.xml", "quiet.csv", *words.split(), "--json", "-"]) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]
    assert run(["external", "arm.xml", "quiet.csv", "--learned", "quiet.csv"]) == 2
    assert "quiet.csv: is not a file that --learned has written" in capsys.readouterr().err


def test_a_model_file_alone_is_not_called_records(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    assert run(["external", "arm.xml", "quiet.csv", "--out", "alone.csv"]) == 0
    said = capsys.readouterr()
    assert "follow from the model alone" in said.err
    assert "alone.csv is written" in said.out


def test_records_alone_bound_what_they_know(workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    joints = [
        {"name": name, "node": node, "rated_torque": 20.0, "max_torque": 15.0}
        for node, name in enumerate(("j1", "j2", "j3"), start=1)
    ]
    Path("arm.yaml").write_text(
        json.dumps({"name": "bench", "serial": "1", "kinematics": {"model": "arm.xml"}, "link": {"joints": joints}})
    )
    arm, model = load_arm("arm.yaml"), load_model(Path("arm.xml"))
    covariance = matrix(1e-6 * np.eye(6))
    gravity = GravityRecord(
        **provenance(arm), names=model.arm.names, beta=tuple(model.beta.tolist()), covariance=covariance,
        identifiable=(True,) * 6, gravity=tuple(model.arm.gravity.tolist()),
    )  # fmt: skip
    RecordStore("records.db").put(gravity, arm, "test", "test")
    words = ["external", "arm.yaml", "quiet.csv", "--store", "records.db", "--picture", "felt.svg", "--json", "-"]
    assert run(words) == 0
    out = capsys.readouterr()
    answer = json.loads(out.out)
    assert answer["baseline_s"] == 0.0
    assert "follow from the records alone" in out.err
    assert Path("felt.svg").read_text().startswith("<svg")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("arm.xml", "--picture"),
        ("arm.xml quiet.csv --false-alarms often", "--false-alarms often"),
        ("arm.xml quiet.csv --frame j9", "one of the joints j1, j2, j3"),
        ("arm.xml quiet.csv --frame j2,1", "JOINT,X,Y,Z"),
        ("arm.xml quiet.csv --out out.txt", "out.txt"),
        (
            "arm.xml --picture felt.svg --baseline free_1.csv --out out.csv",
            "--out out.csv: this option needs recordings",
        ),
        ("arm.xml short.csv --baseline free_1.csv", "short.csv: it has no 1 s without missing rows"),
        ("arm.xml quiet.csv --baseline short.csv", "--baseline: no recording has 1 s without missing rows"),
        ("none.xml quiet.csv", "none.xml"),
    ],
)
def test_bad_input_is_one_line(workplace, monkeypatch, capsys, words, said):
    monkeypatch.chdir(workplace)
    assert run(["external", *words.split()]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("step", [0.00395, 0.004, 0.00405])
def test_as_many_samples_are_averaged_by_clocks_that_are_a_little_apart(step):
    """Live rows and recordings of one arm have the same noise."""
    assert averaged_samples(step * np.arange(50.0), 125.0) == 2
