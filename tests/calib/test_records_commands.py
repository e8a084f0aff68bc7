"""`armlink history` and `armlink rollback`, as a shell sees them."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from armlink.armfile import load_arm
from armlink.cli import run
from calib.records import CalibrationRecord, JointCalibration, provenance
from calib.store import RecordStore


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


def test_history_shows_one_record_as_yaml_that_can_be_imported(kept, capsys, tmp_path) -> None:
    path, first, _ = kept
    assert run(["history", "sarcos", "--store", path, "--record", first]) == 0
    (tmp_path / "record.yaml").write_text(capsys.readouterr().out)
    other = RecordStore(str(tmp_path / "other.db"))
    assert other.import_yaml(tmp_path / "record.yaml", load_arm("sarcos")) == first


def test_rollback_makes_the_old_record_current(kept, capsys) -> None:
    path, first, second = kept
    assert run(["rollback", "sarcos", "--to", first, "--store", path]) == 0
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
    assert "written to 7 controllers" in capsys.readouterr().err
    assert run(["rollback", "sarcos", "--to", second, "--store", path, "--apply", "--bus", "socketcan:no_such_bus"]) > 1
    assert [line.record for line in RecordStore(path).activations(load_arm("sarcos"))] == [first, second, first]
