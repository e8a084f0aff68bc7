"""A record made current while the daemon runs: written through the gates, checked, rolled back if worse."""

from datetime import timedelta
from pathlib import Path

import pytest
from fast_daemon import START, FastDaemon, settings

from armlink.arm_file import load_arm
from armlink.errors import Refused
from calib.records.records import CalibrationRecord


def daemon_of(directory: Path, policy: str = "apply") -> FastDaemon:
    """At work for a minute, with good records in its controllers."""
    daemon = FastDaemon(directory, 1, settings(policy))
    daemon.run(60)
    assert not daemon.of_kind("configuration", "refused", "alarm")
    return daemon


OFFSET = 0.6 * float(load_arm("sarcos").require_link().rated_torques[2])
"""Beyond what is written, half of rated torque, and within what may be in force [N·m]."""


def import_record(daemon: FastDaemon, days: int = 1, **values: float) -> CalibrationRecord:
    """Make a record current whose joint_3 has other values, as `armlink history --import --activate` does."""
    old = daemon.store.current(CalibrationRecord, daemon.arm)
    assert old is not None
    joints = list(old.joints)
    joints[2] = joints[2].model_copy(update=values)
    when = START + timedelta(days=days)
    record = old.model_copy(update={"joints": tuple(joints), "created": when, "note": "imported"})
    daemon.store.put(record, daemon.arm, by="ann", reason="imported from record.yaml")
    return record


@pytest.mark.parametrize(
    ("values", "gate", "said"),
    [
        ({"gain": 1.95}, "CHANGE", r"joint_3: gain 1.9500 differs by +95.0% from record"),
        ({"offset": OFFSET}, "OFFSET", f"joint_3: offset {OFFSET:.3f} N·m is beyond"),
        ({"gain": 1.95, "offset": OFFSET}, "OFFSET", f"joint_3: offset {OFFSET:.3f} N·m is beyond"),
    ],
)
def test_an_implausible_record_is_not_written_and_that_is_an_event(
    tmp_path: Path, values: dict[str, float], gate: str, said: str
) -> None:
    daemon = daemon_of(tmp_path)
    held = daemon.held()
    record = import_record(daemon, **values)
    daemon.run(10)
    (refused,) = daemon.of_kind("refused")
    assert said in refused.text
    assert "nothing was written" in refused.text
    assert refused.evidence["gate"] == gate
    assert refused.evidence["record"] == record.id
    assert daemon.held() == held
    assert not [call for call in daemon.sdo if call.startswith("write")]
    assert daemon.store.writes(daemon.arm) == []


@pytest.mark.parametrize(
    ("values", "said"), [({"gain": 2.5}, "gain is 2.5; working arms"), ({"offset": 900.0}, "offset is 900")]
)
def test_a_record_of_no_working_sensor_does_not_become_current(
    tmp_path: Path, values: dict[str, float], said: str
) -> None:
    daemon = daemon_of(tmp_path)
    before = daemon.store.current(CalibrationRecord, daemon.arm)
    with pytest.raises(Refused, match=f"joint_3: {said}"):
        import_record(daemon, **values)
    daemon.run(10)
    assert daemon.store.current(CalibrationRecord, daemon.arm) == before
    assert not [call for call in daemon.sdo if call.startswith("write")]


def test_after_a_refusal_the_next_record_is_judged_by_what_is_installed(tmp_path: Path) -> None:
    """Not by the refused one, which only was current: 1.95 and then 1.94 are refused both."""
    daemon = daemon_of(tmp_path)
    import_record(daemon, gain=1.95)
    daemon.run(10)
    import_record(daemon, days=2, gain=1.94)
    daemon.run(10)
    assert [event.evidence["gate"] for event in daemon.of_kind("refused")] == ["CHANGE", "CHANGE"]
    assert not [call for call in daemon.sdo if call.startswith("write")]


def test_a_plausible_record_is_written_with_its_date_and_a_journal_line_and_holds(tmp_path: Path) -> None:
    daemon = daemon_of(tmp_path)
    daemon.fast.gain[2] *= 1.03
    record = import_record(daemon, gain=1.03)
    daemon.run(90)
    assert daemon.ids == [record.number] * daemon.fast.n
    assert daemon.dates == [int(record.created.timestamp())] * daemon.fast.n
    begun, finished = daemon.store.writes(daemon.arm)
    assert (begun.record, begun.stage, finished.stage) == (record.id, "begun", "finished")
    assert begun.body["gates"] == "bounds and change"
    (written,) = daemon.of_kind("recalibration")
    assert written.evidence["record"] == record.id
    (check,) = daemon.of_kind("check")
    assert check.evidence["kept"]


def test_a_record_that_makes_readings_worse_is_rolled_back(tmp_path: Path) -> None:
    daemon = daemon_of(tmp_path)
    good = daemon.store.current(CalibrationRecord, daemon.arm)
    record = import_record(daemon, gain=1.06)
    daemon.run(120)
    (back,) = daemon.of_kind("roll-back")
    assert back.joint == "joint_3"
    assert daemon.store.current(CalibrationRecord, daemon.arm) == good
    assert (daemon.held()[2].gain, daemon.held()[2].offset) == (good.joints[2].gain, good.joints[2].offset)
    assert daemon.ids == [good.number] * daemon.fast.n
    stages = [(line.record, line.stage) for line in daemon.store.writes(daemon.arm)]
    assert stages == [(each, stage) for each in (record.id, good.id) for stage in ("begun", "finished")]
    assert daemon.service.records.feed.calibration == good


def test_under_propose_an_imported_record_is_not_written(tmp_path: Path) -> None:
    daemon = daemon_of(tmp_path, "propose")
    import_record(daemon, gain=1.02)
    daemon.run(10)
    assert not [call for call in daemon.sdo if call.startswith("write")]
    assert "hold another calibration" in daemon.of_kind("configuration")[-1].text
