"""No number of a record that can be of no working arm is ever in force; what was in force before stays so."""

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import fake_controllers
import pytest
import sqlalchemy as sa
from fake_controllers import Controllers
from made_records import ARM, activate_by_hand, arm_file, calibration, gravity

from armlink.cli import run
from armlink.errors import BadInput, Refused
from calib.install.journaled_write import install
from calib.install.plausibility import Admitted
from calib.records.bounds import CLOCK_TOLERANCE, require_sound
from calib.records.database import StoreFault
from calib.records.records import CalibrationRecord, Discrepancy, GravityRecord, MotorTorque, parse_record
from calib.records.store import RecordStore, calibrations_in_force

AnyRecord = CalibrationRecord | GravityRecord


@pytest.fixture
def store(tmp_path: Path) -> RecordStore:
    return RecordStore(str(tmp_path / "records.db"))


def full() -> CalibrationRecord:
    """A sound calibration with every key that one can have."""
    motor = MotorTorque(
        coulomb=(0.4, 0.01),
        load=(0.1, 0.01),
        viscous=(2.0, 0.1),
        asymmetry=(0.1, 0.05),
        temperature=31.0,
        gain_per_kelvin=(-0.002, 1e-4),
    )
    doubt = Discrepancy(level=0.12, level_std=0.02, length=0.8)
    first, *others = calibration().joints
    update = {"motor": motor, "discrepancy": doubt, "residual_std": 0.1}
    return calibration().model_copy(update={"joints": (first.model_copy(update=update), *others)})


def numbers(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all numbers of a record, as it is in JSON."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield from numbers(value, (*path, key))
    if isinstance(content, float):
        yield path


def changed(record: AnyRecord, path: tuple[Any, ...], value: Any) -> AnyRecord:
    """The record as somebody would write it who knows how ids are made."""
    content = record.model_dump(mode="json")
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return parse_record(content, "made")


SOUND: list[AnyRecord] = [full(), gravity()]
ALL = [(record, path) for record in SOUND for path in numbers(json.loads(record.model_dump_json()))]


def test_sound_records_pass() -> None:
    for record in SOUND:
        assert require_sound(record, ARM, datetime.now(UTC)) is record
    assert len(ALL) == 49


@pytest.mark.parametrize("value", [1e308, -1e308])
@pytest.mark.parametrize(
    ("record", "path"), ALL, ids=lambda given: str(given) if isinstance(given, tuple) else given.kind
)
def test_every_number_has_a_bound(record: AnyRecord, path: tuple[Any, ...], value: float) -> None:
    with pytest.raises((Refused, BadInput)) as error:
        require_sound(changed(record, path, value), ARM)
    assert "\n" not in str(error.value)


WRONG = [
    (
        calibration(),
        ("joints", 0, "position_gain"),
        1e6,
        "shoulder: position_gain is 1e\\+06; working arms have 0.5 to 2",
    ),
    (calibration(), ("joints", 0, "gain"), -1.0, "shoulder: gain is -1; working arms have 0.5 to 2"),
    (calibration(), ("joints", 1, "position_offset"), 7.0, "elbow: position_offset is 7 rad"),
    (calibration(), ("covariance", 0, 0), -1e-6, "variance of shoulder.gain is -1e-06"),
    (gravity(), ("beta", 1), 1e308, "shoulder: y of the mass moment is 1e\\+308 kg·m"),
    (calibration(), ("created",), "2200-01-01T00:00:00Z", "created is 2200-01-01, expected 1984 to 2106"),
    (gravity(), ("created",), "1601-01-01T00:00:00Z", "created is 1601-01-01"),
]


@pytest.mark.parametrize(("record", "path", "value", "said"), WRONG)
def test_a_record_of_no_working_arm_is_neither_imported_nor_made_current_nor_taken(
    store: RecordStore, tmp_path: Path, record: AnyRecord, path: tuple[Any, ...], value: Any, said: str
) -> None:
    wrong = changed(record, path, value)
    (tmp_path / "wrong.yaml").write_text(wrong.to_yaml())
    with pytest.raises(Refused, match=said):
        store.import_yaml(tmp_path / "wrong.yaml", ARM)
    assert store.history(ARM) == []
    sound = store.put(record, ARM, by="ann", reason="sweep")
    with pytest.raises(Refused, match=said):
        store.put(wrong, ARM, by="ann", reason="sweep")
    assert store.current(type(record), ARM) == store.get(sound)
    activate_by_hand(store, wrong)  # as an armlink without bounds did
    with pytest.raises(Refused, match=said):
        store.current(type(record), ARM)
    store.rollback(ARM, to=sound, by="ann")
    with pytest.raises(Refused, match=said):
        store.rollback(ARM, to=wrong.id, by="ann")
    assert store.current(type(record), ARM) == record


def test_a_record_of_no_working_arm_is_not_written_to_controllers(tmp_path: Path) -> None:
    store, controllers = RecordStore(str(tmp_path / "records.db")), Controllers()
    wrong = changed(fake_controllers.record(), ("created",), "2200-01-01T00:00:00Z")
    assert isinstance(wrong, CalibrationRecord)
    with pytest.raises(Refused, match="created is 2200"):
        install(Admitted(wrong, fake_controllers.ARM, "none"), store, controllers, by="ann", reason="x", check=None)
    assert controllers.held == Controllers().held
    assert store.writes(fake_controllers.ARM) == []


def test_a_calibration_of_no_working_arm_is_not_in_force_in_the_host(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    store = RecordStore()
    record = fake_controllers.record()
    store.put(record, fake_controllers.ARM, by="ann", reason="sweep")
    assert calibrations_in_force(fake_controllers.ARM)[0] is not None
    activate_by_hand(store, changed(record, ("joints", 0, "offset"), 51.0))
    with pytest.raises(Refused, match="shoulder: offset is 51 N·m; working arms have -50 to 50"):
        calibrations_in_force(fake_controllers.ARM)


def test_the_store_that_a_command_names_holds_for_what_the_host_keeps(tmp_path: Path) -> None:
    """`--store`: the link that the command opens takes its calibrations from there, too."""
    store = RecordStore(other := str(tmp_path / "other.db"))
    store.put(fake_controllers.record(), fake_controllers.ARM, by="ann", reason="sweep")
    assert run(["history", "sarcos", "--store", other]) == 0
    assert calibrations_in_force(fake_controllers.ARM)[0] is not None


def test_mass_moments_are_bounded_by_what_the_drives_can_carry() -> None:
    content = gravity().model_dump() | {"beta": (70.0, 0.0, 0.0, 0.0)}
    record = GravityRecord.model_validate(content)
    require_sound(record, ARM)  # the arm file has no drives
    with pytest.raises(Refused, match="x of the mass moment is 70 kg·m; working arms have -61"):
        require_sound(record, fake_controllers.ARM)  # 60 N·m


def test_a_record_of_the_future_does_not_become_current_and_one_in_force_stays_when_the_clock_is_set_back() -> None:
    now = datetime(2026, 11, 28, tzinfo=UTC)
    for ahead, sound in ((timedelta(), True), (CLOCK_TOLERANCE, True), (CLOCK_TOLERANCE + timedelta(hours=1), False)):
        record = calibration().model_copy(update={"created": now + ahead})
        require_sound(record, ARM)
        if sound:
            require_sound(record, ARM, now)
        else:
            with pytest.raises(
                Refused, match=r"was created on 2026-11-29 03:00 UTC, but the clock of this machine says"
            ):
                require_sound(record, ARM, now)


def test_a_record_of_other_joints_is_refused() -> None:
    (first, _) = calibration().joints
    record = calibration().model_copy(update={"joints": (first,), "covariance_of": (), "covariance": ()})
    with pytest.raises(Refused, match="it has 1 joints, but the arm has 2"):
        require_sound(record, arm_file())


def test_a_row_that_was_changed_in_the_database_is_not_taken(store: RecordStore) -> None:
    first = store.put(calibration(), ARM, by="ann", reason="sweep")
    with sa.create_engine(store.url).begin() as connection:
        connection.execute(sa.text("DROP TRIGGER records_no_update"))
        connection.execute(sa.text("UPDATE records SET body = replace(body, '1.02', '1.12')"))
    with pytest.raises(StoreFault, match=f"record {first} was changed"):
        store.current(CalibrationRecord, ARM)
