"""Records and their store: nothing is lost, nothing changes, nothing of another arm is taken."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa
import yaml
from made_records import ARM, arm_file, calibration, gravity
from pydantic import ValidationError

from armlink.errors import BadInput, Refused
from calib.records.database import default_url
from calib.records.records import (
    CalibrationRecord,
    Discrepancy,
    GravityRecord,
    JointCalibration,
    parse_record,
    provenance,
)
from calib.records.store import RecordStore


@pytest.fixture
def store(tmp_path: Path) -> RecordStore:
    return RecordStore(str(tmp_path / "state" / "records.db"))


def test_arrays_of_a_record_mark_what_is_unknown() -> None:
    record = calibration()
    assert record.values("offset").tolist() == [0.1, -0.2]
    assert math.isnan(record.values("gain")[1])
    assert record.values("gain", missing=1.0).tolist() == [1.02, 1.0]
    assert record.std("gain")[0] == pytest.approx(1e-3)
    assert math.isnan(record.std("gain")[1])
    assert record.std("offset")[1] == pytest.approx(2e-3)


def test_a_missing_value_needs_a_reason_and_a_reason_a_missing_value() -> None:
    values = {"name": "elbow", "gain": 1.0, "offset": 0.0, "position_gain": 1.0, "position_offset": 0.0}
    with pytest.raises(ValidationError, match="give a reason"):
        JointCalibration(**values | {"gain": None})
    with pytest.raises(ValidationError, match="give a reason"):
        JointCalibration(**values, not_identifiable={"gain": "because"})


def test_a_record_with_a_discrepancy_comes_back_and_one_without_keeps_its_content(store: RecordStore) -> None:
    plain = calibration()
    assert "discrepancy" not in plain.model_dump_json()
    assert plain.discrepancy("level").tolist() == [0.0, 0.0]
    doubt = Discrepancy(level=0.12, level_std=0.02, length=0.8)
    first = plain.joints[0].model_copy(update={"discrepancy": doubt})
    record = plain.model_copy(update={"joints": (first, *plain.joints[1:])})
    assert record.id != plain.id
    assert store.get(store.add(record)) == record
    assert parse_record(yaml.safe_load(record.to_yaml()), "yaml") == record
    assert record.discrepancy("length", missing=1.0).tolist() == [0.8, 1.0]


def test_records_of_one_second_are_listed_in_the_order_they_were_made(store: RecordStore) -> None:
    made = [calibration().model_copy(update=provenance(ARM)) for _ in range(20)]
    assert len({store.add(record) for record in made}) == 20
    assert [record.id for record in store.history(ARM)] == [record.id for record in made]


def test_sizes_are_checked() -> None:
    content = gravity().model_dump()
    with pytest.raises(ValidationError, match="expected 4 × 4"):
        GravityRecord.model_validate(content | {"covariance": ((1.0,),)})
    with pytest.raises(ValidationError, match="beta has 2 values, expected 4"):
        GravityRecord.model_validate(content | {"beta": (1.0, 2.0)})


def test_the_id_is_the_content_and_fits_32_bits() -> None:
    assert calibration().id == calibration().id
    assert calibration().id != calibration(gain=1.03).id
    assert 0 <= calibration().number < 2**32
    assert f"{calibration().number:08x}" == calibration().id


def test_a_kept_record_comes_back_equal(store: RecordStore) -> None:
    for record in (calibration(), gravity()):
        assert store.get(store.add(record)) == record
        assert store.add(record) == record.id
    assert store.history(ARM) == sorted([calibration(), gravity()], key=lambda record: record.id)


def test_nothing_is_current_until_activated_and_a_new_record_keeps_the_old(store: RecordStore) -> None:
    first = store.add(calibration())
    assert store.current(CalibrationRecord, ARM) is None
    store.activate(first, ARM, by="ann", reason="first sweep")
    second = store.put(calibration(1.05, parent=first), ARM, by="ann", reason="second sweep")
    assert store.current(CalibrationRecord, ARM) == calibration(1.05, parent=first)
    assert store.current(GravityRecord, ARM) is None
    assert {record.id for record in store.history(ARM)} == {first, second}


def test_rollback_is_an_append(store: RecordStore) -> None:
    first = store.put(calibration(), ARM, by="ann", reason="sweep")
    second = store.put(calibration(1.05), ARM, by="observer", reason="drift")
    store.rollback(ARM, to=first, by="ann")
    assert store.current(CalibrationRecord, ARM) == calibration()
    assert [line.record for line in store.activations(ARM)] == [first, second, first]
    assert [line.by for line in store.activations(ARM)] == ["ann", "observer", "ann"]


def test_rollback_goes_only_to_what_was_current(store: RecordStore) -> None:
    first = store.put(calibration(), ARM, by="ann", reason="sweep")
    never = store.add(calibration(1.05))
    with pytest.raises(Refused, match="never current"):
        store.rollback(ARM, to=never, by="ann")
    with pytest.raises(Refused, match="already"):
        store.rollback(ARM, to=first, by="ann")
    with pytest.raises(Refused, match="no record 00000000"):
        store.rollback(ARM, to="00000000", by="ann")


@pytest.mark.parametrize(
    ("other", "what"),
    [
        ({"name": "other"}, "arm is bench"),
        ({"serial": "8"}, "serial is 7"),
        ({"kinematics": {"joints": [{"name": "shoulder", "lower": -1, "upper": 1}]}}, "description is"),
    ],
)
def test_a_record_of_another_arm_is_refused(store: RecordStore, other: dict[str, object], what: str) -> None:
    with pytest.raises(Refused, match=what):
        store.put(calibration(), arm_file(**other), by="ann", reason="")
    assert store.activations(arm_file(**other)) == []


def test_the_current_record_of_a_changed_description_is_refused(store: RecordStore) -> None:
    store.put(calibration(), ARM, by="ann", reason="sweep")
    changed = arm_file(kinematics={"joints": [{"name": "shoulder", "lower": -1, "upper": 1}]})
    with pytest.raises(Refused, match="description"):
        store.current(CalibrationRecord, changed)


def test_a_record_of_another_schema_is_refused() -> None:
    with pytest.raises(Refused, match="schema version is 2"):
        calibration().model_copy(update={"schema_version": 2}).require(ARM)


def test_yaml_goes_out_and_comes_back(store: RecordStore, tmp_path: Path) -> None:
    (tmp_path / "record.yaml").write_text(calibration().to_yaml())
    assert store.get(store.import_yaml(tmp_path / "record.yaml", ARM)) == calibration()


def test_a_changed_yaml_is_refused_in_one_line(store: RecordStore, tmp_path: Path) -> None:
    path = tmp_path / "record.yaml"
    path.write_text(calibration().to_yaml().replace("1.02", "1.12"))
    with pytest.raises(BadInput, match="content was changed"):
        store.import_yaml(path, ARM)
    path.write_text("kind: sandwich")
    with pytest.raises(BadInput, match="expected calibration or gravity"):
        store.import_yaml(path, ARM)
    content = yaml.safe_load(calibration().to_yaml())
    content["joints"][0]["colour"] = "red"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(BadInput, match=r"joints\.0\.colour: unknown key"):
        store.import_yaml(path, ARM)


def test_the_database_itself_refuses_change_and_deletion(store: RecordStore) -> None:
    store.put(calibration(), ARM, by="ann", reason="sweep")
    engine = sa.create_engine(store.url)
    for statement in ("UPDATE records SET body = ''", "DELETE FROM records", "DELETE FROM activations"):
        with pytest.raises(sa.exc.DBAPIError, match="append-only"), engine.begin() as connection:
            connection.execute(sa.text(statement))
    assert store.current(CalibrationRecord, ARM) == calibration()


def test_two_open_stores_see_one_another(tmp_path: Path) -> None:
    one, two = (RecordStore(str(tmp_path / "records.db")) for _ in range(2))
    one.put(calibration(), ARM, by="ann", reason="sweep")
    two.put(calibration(1.05), ARM, by="bob", reason="sweep")
    assert one.current(CalibrationRecord, ARM) == two.current(CalibrationRecord, ARM) == calibration(1.05)


@pytest.mark.long
def test_a_process_killed_while_it_writes_leaves_whole_records(tmp_path: Path) -> None:
    """SIGKILL inside the transaction: the record before stands, the one begun is gone."""
    script = (
        "import os, signal, sys, made_records as t\n"
        "from calib.records.database import transaction\n"
        "from calib.records.database import RECORDS\n"
        "from calib.records.store import RecordStore\n"
        "store = RecordStore(sys.argv[1])\n"
        "store.put(t.calibration(), t.ARM, by='ann', reason='sweep')\n"
        "with transaction(store._engine) as connection:\n"
        "    record = t.calibration(1.05)\n"
        "    row = dict(id=record.id, kind=record.kind, arm='bench', serial='7', created='', body='half')\n"
        "    connection.execute(RECORDS.insert().values(row))\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = str(tmp_path / "records.db")
    done = subprocess.run([sys.executable, "-c", script, path], cwd=Path(__file__).parents[1], timeout=60, check=False)
    assert done.returncode == -9
    assert RecordStore(path).history(ARM) == [calibration()]


def test_a_store_that_cannot_be_opened_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for url in (str(tmp_path / "file" / "records.db"), "nonsense://x", "postgresql+nodriver://x"):
        with pytest.raises(BadInput, match="cannot be opened"):
            RecordStore(url)


def test_the_default_store_is_in_the_state_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_url() == f"sqlite:///{tmp_path}/armlink/records.db"
    assert RecordStore().history(ARM) == []


def test_parse_record_takes_only_mappings() -> None:
    with pytest.raises(BadInput, match="`kind` is"):
        parse_record(["calibration"], "x.yaml")


@pytest.mark.parametrize("kind", [["calibration"], {}, None, "other"])
def test_a_kind_that_is_none_is_refused_in_one_line(kind: object) -> None:
    from armlink.errors import BadInput
    from calib.records.records import parse_record

    with pytest.raises(BadInput, match="expected calibration or gravity"):
        parse_record({"kind": kind}, "record.yaml")
