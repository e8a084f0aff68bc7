"""A fleet's recordings on a cluster of real worker processes: every answer once, whatever dies on the way."""

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
import wrong_arms
from distributed import Client
from distributed.security import Security
from typer.testing import CliRunner

from armlink.errors import BadInput
from armlink.recording.files import load_recording, save_recording
from sim_gap.commands.gap import app
from sim_gap.fleet import Answers, Case, CaseOptions, cluster, diagnose_case, diagnose_fleet, find_cases, open_to_all


def write_case(folder: Path, name: str, wrong: wrong_arms.Wrong) -> None:
    place = folder / name
    place.mkdir(parents=True)
    nominal = wrong_arms.model()
    mujoco.mj_saveLastXML(str(place / "sim.xml"), nominal)
    for seed, recording in enumerate(("train.parquet", "heldout.csv")):
        save_recording(wrong_arms.record(nominal, wrong, seed, seconds=20.0, rate=50.0), place / recording)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for number in range(2):
        write_case(folder, f"arm_a/run_{number}", wrong_arms.Wrong(coulomb=0.5 + 0.1 * number))
    write_case(folder, "arm_b/run_0", wrong_arms.Wrong())
    (folder / "arm_b" / "run_0" / "heldout.csv").write_text("t,q_1\n0,1\n", encoding="utf-8")
    return folder


def test_cases_are_folders_with_a_model_and_recordings(fleet: Path, tmp_path: Path) -> None:
    cases = find_cases(fleet)
    assert [case.name for case in cases] == ["arm_a/run_0", "arm_a/run_1", "arm_b/run_0"]
    assert cases[0].sim.name == "sim.xml"
    assert [path.name for path in (*cases[0].train, *cases[0].heldout)] == ["train.parquet", "heldout.csv"]
    with pytest.raises(BadInput, match="contains no case"):
        find_cases(tmp_path)
    with pytest.raises(BadInput, match="no such folder"):
        find_cases(tmp_path / "absent")


def test_recordings_of_one_folder_share_a_model(fleet: Path, tmp_path: Path) -> None:
    place = fleet / "arm_a" / "run_0"
    for number in range(2):
        (tmp_path / f"run_{number}.parquet").write_bytes((place / "train.parquet").read_bytes())
    cases = find_cases(tmp_path, place / "sim.xml")
    assert [(case.name, case.sim, case.heldout) for case in cases] == [
        ("run_0.parquet", place / "sim.xml", ()),
        ("run_1.parquet", place / "sim.xml", ()),
    ]


def test_a_case_that_cannot_be_diagnosed_says_why_in_one_line(fleet: Path) -> None:
    answer = diagnose_case(find_cases(fleet)[2])
    assert list(answer) == ["error"]
    assert "heldout.csv" in answer["error"]


@contextlib.contextmanager
def in_this_process(scheduler: str | None, workers: int) -> Iterator[Client]:
    """A cluster whose worker is a thread."""
    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        yield client


@pytest.mark.parametrize("cluster", [in_this_process, pytest.param(cluster, marks=pytest.mark.long)])
def test_the_command_gathers_a_table_by_arm_and_effect_and_goes_on_where_it_stopped(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: Callable[..., object]
) -> None:
    monkeypatch.setattr("sim_gap.fleet.cluster", cluster)
    out, table, answers = (str(tmp_path / name) for name in ("answers.jsonl", "table.parquet", "answers.json"))
    arguments = ["diagnose-fleet", str(fleet), "--out", out, "--table", table, "--json", answers, "--workers", "1"]
    result = CliRunner().invoke(app, arguments, standalone_mode=False)
    assert result.exception is None
    assert result.return_value == 1  # one case could not be read
    rows = pq.read_table(table).to_pylist()
    assert {(row["arm"], row["effect"]) for row in rows if row["case"].startswith("arm_a")} == {
        ("arm_a", "friction.coulomb")
    }
    assert [row["verdict"] for row in rows if row["arm"] == "arm_b"] == ["failed"]
    kept = json.loads(Path(answers).read_text(encoding="utf-8"))["answers"]
    assert kept["arm_a/run_1"]["schema"] == "armlink.gap/2"
    whole = Path(out).read_bytes()
    Path(out).write_bytes(whole[:-40])  # as a kill leaves it
    again = CliRunner().invoke(app, arguments, standalone_mode=False)
    assert "2 of 3 cases are done already" in " ".join(again.stderr.split())
    assert len(Answers(Path(out)).found) == 3


def test_recordings_in_degrees_are_followed_with_the_options_of_a_diagnosis(fleet: Path, tmp_path: Path) -> None:
    recording = load_recording(fleet / "arm_a" / "run_0" / "train.parquet")
    save_recording(
        replace(recording, position=np.degrees(recording.position), velocity=None), tmp_path / "2026-10-02.parquet"
    )
    command = ["trend", str(tmp_path), "--sim", str(fleet / "arm_a" / "run_0" / "sim.xml"), "--json", "-"]
    units = ["--units", "q=deg"]
    first = CliRunner().invoke(app, [*command, *units], standalone_mode=False)
    assert json.loads(first.stdout)["newest"]["answer"]["causes"][0]["effect"] == "friction.coulomb"
    assert "1 recording: at least 13 recordings are needed to find a change" in " ".join(first.stderr.split())
    (line,) = (tmp_path / "answers.jsonl").read_text(encoding="utf-8").splitlines()
    assert set(json.loads(line)["options"]["units"]) == {"q"}
    (tmp_path / "2026-10-02.parquet").write_bytes(b"")  # it is diagnosed, and need not be read again
    again = CliRunner().invoke(app, [*command, *units], standalone_mode=False)
    assert again.stdout == first.stdout
    other = CliRunner().invoke(app, command, standalone_mode=False)
    assert "1 answer was made with other options" in " ".join(other.stderr.split())
    assert "error" in json.loads(other.stdout)["newest"]["answer"]


def test_gains_that_are_not_numbers_are_refused_before_any_case() -> None:
    with pytest.raises(BadInput, match="--gains kp=stiff: expected"):
        CaseOptions(gains="kp=stiff")


def sleeper(case: Case, _options: object) -> dict[str, object]:
    """Dies with its worker the first time, recorded by a file."""
    if not case.sim.exists():
        case.sim.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"verdict": "no_gap", "causes": []}


@pytest.mark.long
def test_a_worker_killed_in_the_middle_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each first worker that takes a case is killed (SIGKILL) before it answers."""
    monkeypatch.setattr("sim_gap.fleet.diagnose_case", sleeper)
    cases = [Case(f"case_{k}", tmp_path / f"taken_{k}", ()) for k in range(2)]
    with cluster(None, 1) as client:
        answers = dict(diagnose_fleet(cases, client))
    assert set(answers) == {"case_0", "case_1"}
    assert all(answer == {"verdict": "no_gap", "causes": []} for answer in answers.values())


def test_nobody_else_can_run_code_through_the_scheduler() -> None:
    """Neither without TLS nor with keys of one's own."""
    with cluster(None, 1) as client:
        address = client.scheduler.address
        assert address.startswith("tls://")
        assert client.submit(sum, [1, 2]).result() == 3
        with pytest.raises(OSError, match=r"(?i)timed out|closed|connect"):
            Client(address.replace("tls://", "tcp://"), timeout=1, set_as_default=False)
        with pytest.raises(OSError, match=r"(?i)timed out|certificate|ssl|connect"):
            Client(address, timeout=1, security=Security.temporary(), set_as_default=False)


def test_a_scheduler_without_tls_is_said() -> None:
    assert "can run code" in open_to_all("tcp://192.0.2.1:8786")
    assert "can run code" in open_to_all("192.0.2.1:8786")
    assert not open_to_all("tls://192.0.2.1:8786")
    assert not open_to_all(None)


def test_no_scheduler_at_an_address_is_one_line() -> None:
    result = CliRunner().invoke(app, ["diagnose-fleet", "/nowhere"], standalone_mode=False)
    assert isinstance(result.exception, BadInput)


def test_a_file_of_something_else_is_not_added_to(tmp_path: Path) -> None:
    other = tmp_path / "notes.json"
    other.write_text('{"mine": 1}\n', encoding="utf-8")
    with pytest.raises(BadInput, match="line 1 is not a result of diagnose-fleet"):
        Answers(other)
    assert other.read_text(encoding="utf-8") == '{"mine": 1}\n'


@pytest.mark.parametrize(
    "answer",
    [
        "7",
        '{"causes": 1.5}',
        '{"causes": ["x"]}',
        '{"causes": [{"effect": "friction.coulomb", "joints": [{}], "parameters": {}}]}',
        '{"causes": [{"effect": "friction.coulomb", "parameters": {"a": {"torque": {"value": "x", "unit": "N·m"}}}}]}',
        '{"causes": [{"effect": "friction.coulomb", "parameters": {"a": {"torque": {"value": 1' + "0" * 400 + ","
        ' "unit": "N·m"}}}}]}',
        '{"watched": [{"effect": "friction.coulomb"}]}',
    ],
)
def test_a_line_that_is_no_answer_is_refused_before_anything_is_diagnosed(tmp_path: Path, answer: str) -> None:
    path = tmp_path / "answers.jsonl"
    path.write_text(f'{{"case": "a/2026-11-22", "answer": {answer}}}\n', encoding="utf-8")
    with pytest.raises(BadInput, match="line 1 is not a result of diagnose-fleet"):
        Answers(path)


@pytest.mark.parametrize("torn", ["[" * 100_000, '{"case": "a", "ans', ""])
def test_a_torn_line_is_ignored(tmp_path: Path, torn: str) -> None:
    (tmp_path / "answers.jsonl").write_text(torn, encoding="utf-8")
    assert Answers(tmp_path / "answers.jsonl").found == {}
