"""From a finding to a record and to the controller: composed with what is installed, within bounds, never half done."""

import shutil
import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from fake_controllers import ARM, NAMES, Controllers, joint, record

from armlink.errors import BusFault, Refused
from armlink.torque_calibration import TorqueCalibration
from calib.install.journaled_write import recover
from calib.observer.decision import DriftFinding
from calib.observer.recalibrator import Checked, Recalibrator, recalibrated_record
from calib.records.database import StoreFault
from calib.records.records import CalibrationRecord, GravityRecord, matrix, provenance
from calib.records.store import RecordStore


def finding(gain: float = 1.03, offset: float = 0.3, at: int = 1, cause: str = "drift") -> DriftFinding:
    return DriftFinding(at, cause, gain, offset, np.array([[4e-8, -1e-8], [-1e-8, 1e-5]]), 40, 0.999)


def still_gravity() -> GravityRecord:
    """A gravity record of an arm without masses."""
    return GravityRecord(
        **provenance(ARM, created=datetime(2026, 11, 21, tzinfo=UTC)),
        names=NAMES,
        beta=(0.0,) * 4,
        covariance=matrix(np.zeros((4, 4))),
        identifiable=(True,) * 4,
        gravity=(0.0, 0.0, -9.81),
    )


def test_composition_makes_the_reading_right_again() -> None:
    """v = K τ + O drifts; the controller sends u = (v − o)/k; the finding has u = g τ + b; the new pair gives τ."""
    torque, (k, o) = np.array([-20.0, 0.0, 35.0]), (1.1, -0.4)
    sensor = 1.03 * k * torque + o + 0.33
    slope, constant = np.polyfit(torque, (sensor - o) / k, 1)
    new = TorqueCalibration(k, o).compose(finding(slope, constant).change)
    np.testing.assert_allclose(new.invert(sensor), torque, atol=1e-12)


def test_two_recalibrations_compose_to_the_whole_drift() -> None:
    once = TorqueCalibration(1.1, -0.4).compose(finding(1.03, 0.3).change)
    twice = once.compose(finding(1 / 1.03, -0.3 / 1.03).change)
    np.testing.assert_allclose((twice.gain, twice.offset), (1.1, -0.4), atol=1e-12)


def test_the_new_record_follows_from_the_old(store: RecordStore) -> None:
    new = recalibrated_record(record(), ARM, finding(), installed_gain=1.1, by="observer")
    assert new.parent == record().id
    assert new.joints[0] == record().joints[0]
    assert (new.joints[1].gain, new.joints[1].offset) == (1.1 * 1.03, -0.4 + 1.1 * 0.3)
    assert new.covariance_of == record().covariance_of


def test_its_covariance_is_that_of_both_by_monte_carlo() -> None:
    new = recalibrated_record(record(), ARM, finding(), installed_gain=1.1, by=None)
    random = np.random.default_rng(0)
    old = random.multivariate_normal((1.1, -0.4), np.diag([1e-6, 1e-4]), 200_000)
    change = random.multivariate_normal((1.03, 0.3), finding().covariance, 200_000)
    drawn = np.cov(old[:, 0] * change[:, 0], old[:, 1] + old[:, 0] * change[:, 1])
    np.testing.assert_allclose(np.array(new.covariance)[2:, 2:], drawn, rtol=0.02, atol=4e-8)
    np.testing.assert_array_equal(np.array(new.covariance)[:2, :2], np.array(record().covariance)[:2, :2])


def test_a_joint_without_gain_follows_its_offset_only() -> None:
    vertical = record(joints=(joint("shoulder", gain=None), joint("elbow")), covariance_of=(), covariance=())
    new = recalibrated_record(vertical, ARM, finding(1.0, 0.3, at=0, cause="offset"), installed_gain=1.0, by=None)
    assert (new.joints[0].gain, new.joints[0].offset) == (None, pytest.approx(-0.1))
    with pytest.raises(Refused, match="shoulder: record"):
        recalibrated_record(vertical, ARM, finding(at=0), installed_gain=1.0, by=None)


def test_apply_writes_record_and_controller(store: RecordStore) -> None:
    controllers = Controllers()
    done = Recalibrator(ARM, controllers, store).recalibrate(finding())
    assert store.current(CalibrationRecord, ARM) == done.record
    assert controllers.held[1].gain == pytest.approx(1.1 * 1.03, rel=1e-7)
    assert controllers.held[1].offset == pytest.approx(-0.4 + 0.33, rel=1e-6)
    assert controllers.held[1].record_id == done.record.number
    assert done.record.confirmed_by == "observer, policy apply"


def test_what_the_check_finds_worse_is_undone(store: RecordStore) -> None:
    """The old pair is back in the controller, the old record current, and the change is told as a finding."""
    controllers = Controllers()
    recalibrator = Recalibrator(ARM, controllers, store)
    recalibrator.recalibrate(finding(1.03, 0.3))
    outcome = recalibrator.undo(Checked("worse", 1, "elbow: RMS 0.9 N·m, 0.2 with the old gain"))
    assert outcome.record == recalibrator.record == store.current(CalibrationRecord, ARM) == record()
    assert (controllers.held[1].gain, controllers.held[1].record_id) == (pytest.approx(1.1), record().number)
    assert store.activations(ARM)[-1].reason.startswith("elbow: RMS 0.9")
    assert outcome.undo is not None
    old = TorqueCalibration(1.1 * 1.03, -0.4 + 1.1 * 0.3).compose(outcome.undo.change)
    np.testing.assert_allclose((old.gain, old.offset), (1.1, -0.4), atol=1e-6)
    with pytest.raises(Refused, match="is the first of this arm"):
        recalibrator.undo(Checked("worse", 1, "again"))


class Calls:
    """Fails one call of the record store or of a controller."""

    def __init__(self, store: RecordStore, controllers: Controllers) -> None:
        self.left, commit, dialect = -1, store._engine.dialect.do_commit, store._engine.dialect

        def do_commit(connection: object) -> None:
            self.count(sqlite3.OperationalError("store failed"))
            commit(connection)

        dialect.do_commit = do_commit  # type: ignore[method-assign,assignment]
        sa.event.listen(store._engine, "do_execute", lambda *_: self.count(sqlite3.OperationalError("store failed")))
        read, write = controllers.read_calibration, controllers.write_calibration
        controllers.read_calibration = lambda joint: self.count(BusFault("no answer")) or read(joint)  # type: ignore[method-assign]
        controllers.write_calibration = lambda *given: self.count(BusFault("no answer")) or write(*given)  # type: ignore[method-assign]

    def count(self, error: Exception) -> None:
        self.left -= 1
        if self.left == 0:
            raise error


@pytest.mark.sample(2)
@pytest.mark.parametrize("step", ["apply", "undo", "restore"])
def test_whichever_call_fails_it_and_the_store_agree_on_what_is_in_force(tmp_path: Path, step: str) -> None:
    """Nothing fails after the write that would make a record that is in force look refused, and be written twice."""
    begun = RecordStore(str(tmp_path / "begun.db"))
    for kept in (record(), still_gravity()):
        begun.put(kept, ARM, by="ann", reason="sweep")
    begun.close()
    failed, number = 0, 0
    while number == 0 or failed == number:
        number += 1
        shutil.copy(tmp_path / "begun.db", tmp_path / f"{number}.db")
        store, controllers = RecordStore(str(tmp_path / f"{number}.db")), Controllers()
        recalibrator = Recalibrator(ARM, controllers, store)
        proposed = recalibrator.propose(finding())
        if step == "undo":
            recalibrator.apply(proposed.record, 1, "ann")
        elif step == "restore":
            controllers.held = Controllers(gain=1.0, offset=0.0).held
        calls = Calls(store, controllers)
        calls.left, before = number, recalibrator.record
        acts = {
            "apply": lambda: recalibrator.apply(proposed.record, 1, "ann"),  # noqa: B023
            "undo": lambda: recalibrator.undo(Checked("worse", 1, "worse")),  # noqa: B023
            "restore": recalibrator.restore,
        }
        try:
            acts[step]()
        except (StoreFault, BusFault):
            failed += 1
            assert recalibrator.record == before
        calls.left = -1
        recover(ARM, store, controllers)
        assert store.current(CalibrationRecord, ARM) == recalibrator.record
        if step != "restore":
            assert controllers.held[1].gain == pytest.approx(recalibrator.record.joints[1].gain, rel=1e-6)
        store.close()
    assert failed > 10


def test_propose_keeps_the_record_and_touches_nothing(store: RecordStore) -> None:
    controllers = Controllers()
    done = Recalibrator(ARM, controllers, store).propose(finding())
    assert done.record.confirmed_by is None
    assert done.record in store.history(ARM)
    assert store.current(CalibrationRecord, ARM) == record()
    assert controllers.held == Controllers().held


def test_a_second_drift_is_relative_to_the_first_recalibration(store: RecordStore) -> None:
    controllers = Controllers()
    recalibrator = Recalibrator(ARM, controllers, store)
    first = recalibrator.recalibrate(finding(1.03, 0.3))
    second = recalibrator.recalibrate(finding(1.01, -0.1))
    assert second.record.parent == first.record.id
    assert second.gain == pytest.approx(1.1 * 1.03 * 1.01)
    assert [line.record for line in store.activations(ARM)] == [record().id, first.record.id, second.record.id]


@pytest.mark.parametrize(
    ("change", "what"),
    [(finding(1.2, 0.0), r"elbow: gain 1\.3200 is \+20\.0%"), (finding(1.0, 6.0), r"elbow: offset 6\.200 N·m")],
)
def test_an_implausible_change_is_refused(store: RecordStore, change: DriftFinding, what: str) -> None:
    controllers = Controllers()
    with pytest.raises(Refused, match=what):
        Recalibrator(ARM, controllers, store).recalibrate(change)
    assert controllers.held == Controllers().held
    assert store.history(ARM) == [record()]


def test_bounds_are_against_the_last_sweep_not_the_last_step(store: RecordStore) -> None:
    recalibrator = Recalibrator(ARM, Controllers(), store)
    recalibrator.recalibrate(finding(1.06, 0.0))
    again = Recalibrator(ARM, recalibrator._controllers, store)  # after a restart too
    with pytest.raises(Refused, match="a drift is at most 10%"):
        again.recalibrate(finding(1.06, 0.0))


def test_a_controller_that_holds_something_else_is_refused(store: RecordStore) -> None:
    with pytest.raises(Refused, match="elbow: the drive holds gain 1, but record"):
        Recalibrator(ARM, Controllers(gain=1.0), store).recalibrate(finding())


def test_a_failed_write_leaves_the_old_record_current(store: RecordStore) -> None:
    controllers = Controllers()
    controllers.broken = True
    with pytest.raises(BusFault):
        Recalibrator(ARM, controllers, store).recalibrate(finding())
    assert store.current(CalibrationRecord, ARM) == record()


def test_an_arm_without_a_record_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match="no calibration record yet"):
        Recalibrator(ARM, Controllers(), RecordStore(str(tmp_path / "records.db")))


def test_restore_puts_a_whole_record_on_the_controllers(store: RecordStore) -> None:
    """A gain that is not identifiable stays what the controller holds; the log of current records does not grow."""
    controllers = Controllers(gain=1.0, offset=0.0)
    vertical = record(joints=(joint("shoulder", gain=None), joint("elbow")), covariance_of=(), covariance=())
    store.put(vertical, ARM, by="ann", reason="sweep")
    log = store.activations(ARM)
    assert Recalibrator(ARM, controllers, store).restore() == NAMES
    assert store.activations(ARM) == log
    assert [line.stage for line in store.writes(ARM)] == ["begun", "finished"]
    assert [held.date for held in controllers.held] == [int(vertical.created.timestamp())] * 2
    assert [held.gain for held in controllers.held] == [1.0, pytest.approx(1.1)]
    assert [held.offset for held in controllers.held] == [pytest.approx(-0.4)] * 2
