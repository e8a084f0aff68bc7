"""`armlink history` and `armlink rollback`, as a shell sees them."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.cli import run
from calib.records.records import CalibrationRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore


@pytest.fixture
def kept(tmp_path: Path) -> tuple[str, str, str]:
    """Path of a store with two records of sarcos, the second current; their ids."""
    arm, path = load_arm("sarcos"), str(tmp_path / "records.db")
    store, ids = RecordStore(path), []
    for day, gain in ((20, 1.0), (21, 1.1)):
        joints = tuple(
            JointCalibration(name=name, gain=gain, offset=0.0, position_gain=1.0, position_offset=0.0)
            for name in arm.joint_names
        )
        when = datetime(2026, 11, day, tzinfo=UTC)
        record = CalibrationRecord(**provenance(arm, created=when), joints=joints, parent=ids[-1] if ids else None)
        ids.append(store.put(record, arm, by="ann", reason="sweep"))
    return path, ids[0], ids[1]


def test_history_lists_records_and_log(kept, capsys) -> None:
    path, first, second = kept
    assert run(["history", "sarcos", "--store", path, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [(row["id"], row["current"], row["parent"]) for row in answer["records"]] == [
        (first, False, None),
        (second, True, first),
    ]
    assert [line["record"] for line in answer["activations"]] == [first, second]


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_every_line_of_history_says_which_record(kept, capsys, monkeypatch, columns) -> None:
    """Also where the table is cut: the mark of the current one is no name of a row. Below, a time may name a row."""
    monkeypatch.setenv("COLUMNS", str(columns))
    path, first, second = kept
    assert run(["history", "sarcos", "--store", path]) == 0
    listed = capsys.readouterr().out.partition("Current records")[0]
    rows = [line for line in listed.splitlines() if line.startswith("│")]
    assert len(rows) >= 2
    assert all(first in row or second in row for row in rows)


def test_history_shows_one_record_as_yaml_that_can_be_imported(kept, capsys, tmp_path) -> None:
    path, first, _ = kept
    assert run(["history", "sarcos", "--store", path, "--record", first]) == 0
    (tmp_path / "record.yaml").write_text(capsys.readouterr().out)
    other = RecordStore(str(tmp_path / "other.db"))
    assert other.import_yaml(tmp_path / "record.yaml", load_arm("sarcos")) == first


def test_rollback_makes_the_old_record_current(kept, capsys) -> None:
    path, first, second = kept
    assert run(["rollback", "sarcos", "--to", first, "--store", path]) == 0
    capsys.readouterr()
    assert run(["history", "sarcos", "--store", path, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [row["id"] for row in answer["records"] if row["current"]] == [first]
    assert [line["record"] for line in answer["activations"]] == [first, second, first]


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["rollback", "sarcos", "--to", "deadbeef"], 1, "no record deadbeef"),
        (["history", "nowhere"], 2, "no arm file nowhere"),
        (["history", "sarcos", "--record", "deadbeef"], 1, "no record deadbeef"),
    ],
)
def test_what_cannot_be_done_is_one_line(kept, capsys, arguments, status, said) -> None:
    assert run([*arguments, "--store", kept[0]]) == status
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_a_store_that_is_no_database_is_one_line(capsys, tmp_path) -> None:
    (tmp_path / "records.db").write_text("not a database, but long enough to have been taken for one" * 20)
    assert run(["history", "sarcos", "--store", str(tmp_path / "records.db")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_rollback_with_apply_writes_the_controllers_first(kept, capsys) -> None:
    """On the simulated arm's own bus; where no controller answers, the log stays as it was."""
    path, first, second = kept
    assert run(["rollback", "sarcos", "--to", first, "--store", path, "--apply"]) == 0
    said = capsys.readouterr().out
    assert "written to 7 drives" in said
    assert "a roll-back has one check" in said
    assert RecordStore(path).writes(load_arm("sarcos"))[0].body["gates"].startswith("roll-back: only the distance")
    assert run(["rollback", "sarcos", "--to", second, "--store", path, "--apply", "--bus", "socketcan:no_such_bus"]) > 1
    assert [line.record for line in RecordStore(path).activations(load_arm("sarcos"))] == [first, second, first]


def test_rollback_knows_the_joints_that_it_is_told_of(kept, capsys) -> None:
    path, first, _ = kept
    assert run(["rollback", "sarcos", "--to", first, "--store", path, "--apply", "--replaced", "joint_9"]) == 2
    assert "--replaced joint_9: there is no such joint" in capsys.readouterr().err


def with_spread(record: CalibrationRecord, gain_std: float) -> CalibrationRecord:
    names = tuple(f"{joint.name}.gain" for joint in record.joints)
    return record.model_copy(update={"covariance_of": names, "covariance": matrix(np.eye(len(names)) * gain_std**2)})


def test_diff_counts_changes_in_standard_deviations(kept, capsys) -> None:
    """Gains 1.0 ± 0.003 and 1.1 ± 0.004: 0.1 is twenty of √(0.003² + 0.004²)."""
    path, first, second = kept
    store, arm = RecordStore(path), load_arm("sarcos")
    a, b = (store.add(with_spread(store.get(each), std)) for each, std in ((first, 0.003), (second, 0.004)))
    assert run(["diff", a, b, "--store", path, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["before"]["id"], answer["after"]["id"]) == (a, b)
    gains = [row for row in answer["changes"] if row["parameter"] == "gain"]
    assert [row["joint"] for row in gains] == list(arm.joint_names)
    assert [row["change"] for row in gains] == [pytest.approx(0.1)] * 7
    assert [row["deviations"] for row in gains] == [pytest.approx(20.0)] * 7
    offsets = [row for row in answer["changes"] if row["parameter"] == "offset"]
    assert [(row["change"], row["deviations"]) for row in offsets] == [(0.0, None)] * 7


def test_diff_takes_yaml_files_and_refuses_what_has_nothing_common(kept, capsys, tmp_path) -> None:
    path, first, second = kept
    old = RecordStore(path).get(first)
    (tmp_path / "old.yaml").write_text(old.to_yaml())
    assert run(["diff", str(tmp_path / "old.yaml"), second, "--store", path, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["before"]["id"] == first
    (tmp_path / "other.yaml").write_text(old.model_copy(update={"serial": "X-2"}).to_yaml())
    assert run(["diff", str(tmp_path / "other.yaml"), second, "--store", path]) == 1
    assert "serial X-2 and" in capsys.readouterr().err


def test_history_imports_a_record_and_says_who_made_it_current(kept, capsys, tmp_path) -> None:
    path, first, _ = kept
    (tmp_path / "record.yaml").write_text(RecordStore(path).get(first).to_yaml())
    other = str(tmp_path / "other.db")
    arguments = ["history", "sarcos", "--store", other, "--import", str(tmp_path / "record.yaml")]
    assert run([*arguments, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [(row["id"], row["current"]) for row in answer["records"]] == [(first, False)]
    assert run([*arguments, "--activate", "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["records"][0]["current"]
    assert answer["activations"][0]["reason"] == "imported from record.yaml"
    assert answer["activations"][0]["by"]
    assert run(["history", "sarcos", "--store", other, "--activate"]) == 2
