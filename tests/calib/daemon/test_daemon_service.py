"""The daemon's service: what it knows, says and does, on an arm without a bus."""

import itertools
import json
import logging
import os
import socket
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fast_daemon import FastDaemon, settings
from same_thread import Immediate, journal_at

from armlink.arm_file import load_arm
from armlink.errors import BadInput
from armlink.loop.messages import Down, Up
from armlink.recording.files import load_recording
from calib.daemon.logs import JsonFormatter, LineLimit
from calib.daemon.main_loop import Notifier, watchdog_seconds
from calib.daemon.rate_limit import Rate
from calib.daemon.settings import DaemonSection
from calib.daemon.state.journal_rows import HistoryReader
from calib.daemon.view import HistoryPoint, NoSuch, NotPossible, State
from calib.observer.config import ObserverConfig
from calib.observer.recalibrator import Recalibrator
from calib.records.database import StoreFault
from calib.records.records import CalibrationRecord


def drifted(directory: Path, policy: str, seed: int = 1, **more: object) -> FastDaemon:
    """A daemon whose joint 3 has drifted and been watched until something was made of it."""
    daemon = FastDaemon(directory, seed, settings(policy), **more)
    daemon.run(40)
    daemon.drift()
    daemon.run(80)
    return daemon


# ---- what becomes of a drift


def test_under_apply_a_drift_is_written_and_every_step_is_kept(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "apply")
    daemon.run(40)  # until it is checked
    kinds = [event.kind for event in daemon.view.events()]
    order = ["started", "alarm", "drift", "proposal", "approved", "recalibration", "check"]
    places = [kinds.index(kind) for kind in order]
    assert places == sorted(places)
    gain, offset = daemon.fast.error()
    assert abs(gain[2]) < 0.003
    assert abs(offset[2]) < 0.05
    current = daemon.store.current(CalibrationRecord, daemon.arm)
    assert current is not None
    assert daemon.view.status().records.calibration == current.id
    assert daemon.ids[2] == current.number
    (proposal,) = daemon.view.proposals()
    assert (proposal.state, proposal.record, proposal.joint) == ("applied", current.id, "joint_3")


def test_under_propose_nothing_is_written_until_a_person_approves(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    (proposal,) = daemon.view.proposals()
    assert proposal.state == "pending"
    assert daemon.view.status().pending_proposals == 1
    assert not any(call.startswith("write") for call in daemon.sdo)
    approved = daemon.view.approve(proposal.id, "ann").result(0)
    assert (approved.state, approved.decided_by) == ("applied", "ann")
    assert abs(daemon.fast.error()[0][2]) < 0.003
    assert daemon.store.activations(daemon.arm)[-1].by == "ann"
    with pytest.raises(NotPossible, match="already applied"):
        daemon.view.approve(proposal.id, "ann").result(0)


def test_a_rejected_proposal_changes_nothing(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    before = daemon.store.current(CalibrationRecord, daemon.arm)
    assert daemon.view.reject(daemon.view.proposals()[0].id, "ann").result(0).state == "rejected"
    assert daemon.store.current(CalibrationRecord, daemon.arm) == before
    assert daemon.of_kind("rejected")[0].evidence["by"] == "ann"


def test_under_observe_a_drift_is_an_event_alone(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "observe")
    assert daemon.of_kind("drift")
    assert daemon.view.proposals() == ()
    assert daemon.sdo == []


def test_listening_only_sends_nothing_until_something_is_approved(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose", listen_only=True)
    assert daemon.sdo == []
    daemon.view.approve(daemon.view.proposals()[0].id, "ann")
    assert abs(daemon.fast.error()[0][2]) < 0.003


def test_a_joint_is_recalibrated_by_itself_no_oftener_than_the_limit(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "apply")
    daemon.fast.offset[2] += 0.5
    daemon.run(200)
    states = [proposal.state for proposal in daemon.view.proposals()]
    assert states[0] == "pending"
    assert states.count("applied") == 1
    assert "in 600 s" in daemon.of_kind("undecided")[-1].text
    daemon.wall_shift = timedelta(hours=-5)  # a clock set back counts as no time
    daemon.service.tick()
    assert daemon.of_kind("clock")[0].evidence["seconds"] == pytest.approx(-18000, abs=1)


def drift_again(daemon: FastDaemon, joint: int) -> None:
    """Another joint drifts, and is watched until a record is proposed for it."""
    before = len(daemon.view.proposals())
    daemon.fast.offset[joint] += 0.5
    daemon.run(240, until=lambda: len(daemon.view.proposals()) > before)
    assert daemon.view.proposals()[0].joint == daemon.arm.joint_names[joint]


def test_a_wall_clock_that_is_set_grants_no_further_write_and_neither_does_a_restart(tmp_path: Path) -> None:
    """Six automatic writes came in 25 minutes: the limits counted by the wall clock."""
    daemon = FastDaemon(tmp_path, 1, settings("apply", writes_per_day=1))
    daemon.run(60)
    drift_again(daemon, 2)
    daemon.run(60)
    assert daemon.view.proposals()[0].state == "applied"
    daemon.wall_shift = timedelta(hours=25)
    daemon.service.tick()
    drift_again(daemon, 1)
    assert daemon.view.proposals()[0].state == "pending"
    assert "only 1 recalibrations are allowed within a day" in daemon.of_kind("undecided")[-1].text
    assert len(daemon.of_kind("recalibration")) == 1
    limit = daemon.service.recalibrations._limit("joint_5")
    assert limit.startswith("only 1 recalibrations are allowed within a day")
    for hours, back in ((50, 0.0), (-50, daemon.now())):  # the machine has restarted: its monotonic clock begins anew
        daemon.kill()
        daemon.wall_shift, daemon.clock_shift = timedelta(hours=hours), -back
        daemon.start()
        assert daemon.service.recalibrations._limit("joint_5") == limit
    daemon.clock_shift += 86_400.0
    assert daemon.service.recalibrations._limit("joint_5") == ""


def test_an_id_of_before_a_damaged_journal_names_no_other_proposal(tmp_path: Path) -> None:
    """ "approve 1" wrote another joint: ids began anew with the journal."""
    daemon = drifted(tmp_path, "propose")
    (before,) = daemon.view.proposals()
    daemon.kill()
    path = tmp_path / "state" / "journal.db"
    path.write_bytes(b"damaged" * 1000)
    daemon.start()
    daemon.run(240, until=lambda: bool(daemon.view.proposals()))
    (now,) = daemon.view.proposals()
    for number in (before.id, 1):
        with pytest.raises(NoSuch, match=f"no proposal {number}"):
            daemon.view.approve(number, "ann")
    assert daemon.view.proposals() == (now,)
    assert now.id == int(now.record, 16)


def test_a_decision_that_names_another_content_is_refused(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    (proposal,) = daemon.view.proposals()
    for decide in (daemon.view.approve, daemon.view.reject):
        with pytest.raises(NotPossible, match=f"proposal {proposal.id} does not have the hash 000000000000…: look at"):
            decide(proposal.id, "ann", "0" * 64)
    assert not any(call.startswith("write") for call in daemon.sdo)
    daemon.kill()
    daemon.start()
    assert daemon.view.approve(proposal.id, "ann", proposal.hash).result(0).state == "applied"


def test_after_a_damaged_journal_nothing_is_written_automatically_for_a_day(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.kill()
    (tmp_path / "state" / "journal.db").write_bytes(b"damaged" * 1000)
    for _ in range(2):  # by its own finding, then by the event that it kept of it
        daemon.start()
        assert "a damaged journal was set aside less than a day ago" in daemon.service.recalibrations._limit("joint_1")
        daemon.kill()
    daemon.start()
    daemon.clock_shift = 86_400.0
    assert daemon.service.recalibrations._limit("joint_1") == ""


def test_a_record_that_is_not_current_in_the_store_any_more_is_not_followed(tmp_path: Path) -> None:
    """The store was replaced, or another command was quicker than the daemon's next look at it."""
    daemon = drifted(tmp_path, "propose")
    (calibration, _) = daemon.good_records()
    other = daemon.store.put(calibration.model_copy(update={"note": "other"}), daemon.arm, by="ann", reason="sweep")
    answer = daemon.view.approve(daemon.view.proposals()[0].id, "ann").result(0)
    assert answer.state == "failed"
    assert f"is superseded: it is not current in {daemon.store.url} any more ({other} is)" in answer.note
    assert not any(call.startswith("write") for call in daemon.sdo)


def test_a_write_that_fails_is_said_and_the_old_record_stays(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    daemon.on_write = daemon.broken
    answer = daemon.view.approve(daemon.view.proposals()[0].id, "ann").result(0)
    assert answer.state == "failed"
    assert "joint gone" in answer.note
    assert daemon.store.current(CalibrationRecord, daemon.arm).id == answer.base
    assert daemon.service.state is State.OBSERVING


def test_a_recalibration_that_makes_it_worse_is_rolled_back(tmp_path: Path) -> None:
    """The sensor recovers right after the write: the check at the next rests finds the old pair better."""
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(60)
    daemon.fast.offset[2] += 0.5
    daemon.run(200, until=lambda: bool(daemon.of_kind("recalibration")))
    daemon.fast.offset[2] -= 0.5
    daemon.run(60, until=lambda: bool(daemon.of_kind("roll-back")))
    assert daemon.of_kind("roll-back")[0].joint == "joint_3"
    assert abs(daemon.fast.error()[1][2]) < 0.01
    assert [line.by for line in daemon.store.activations(daemon.arm)][-1] == "check after recalibration"


def test_a_roll_back_that_fails_is_tried_again_and_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(60)
    daemon.fast.offset[2] += 0.5
    daemon.run(200, until=lambda: bool(daemon.of_kind("recalibration")))
    daemon.fast.offset[2] -= 0.5
    with monkeypatch.context() as patch:
        patch.setattr(daemon.store, "get", lambda record: (_ for _ in ()).throw(StoreFault("store failed")))
        daemon.run(60)
    (refused,) = daemon.of_kind("refused")
    assert refused.text == "joint_3: the roll-back failed: store failed"
    daemon.run(3)
    assert daemon.of_kind("roll-back")[0].joint == "joint_3"
    assert abs(daemon.fast.error()[1][2]) < 0.01


def test_payload_is_an_event_with_mass_and_centre_and_nothing_is_written(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 2, settings("apply"))
    daemon.run(60)
    daemon.fast.carry(1.5, np.array([0.05, -0.1, 0.1]))
    daemon.run(60)
    (payload,) = daemon.of_kind("payload")
    assert payload.evidence["mass"] == pytest.approx(1.5, abs=0.02)
    assert payload.evidence["com"] == pytest.approx([0.05, -0.1, 0.1], abs=0.02)
    assert daemon.view.status().held
    daemon.fast.put_down()
    daemon.run(60)
    assert daemon.of_kind("clear")
    assert not daemon.view.status().held
    assert daemon.view.proposals() == ()


# ---- restarts


def test_after_a_kill_it_knows_everything(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    daemon.service.save()
    events, estimates, proposals = daemon.view.events(), daemon.view.estimates(), daemon.view.proposals()
    rows = daemon.view.status().rows
    daemon.kill()
    daemon.start()
    assert daemon.view.events()[: len(events)] == events
    assert daemon.view.proposals() == proposals
    assert daemon.view.status().rows == rows
    for before, after in zip(estimates, daemon.view.estimates(), strict=True):
        assert after.model_copy(update={"last_accepted": before.last_accepted}) == before
    daemon.view.approve(proposals[0].id, "ann")
    assert abs(daemon.fast.error()[0][2]) < 0.003


def test_a_kill_loses_at_most_five_seconds_of_the_estimate(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 3, settings("apply"))
    daemon.run(50)
    rows = daemon.view.status().rows
    daemon.kill()
    daemon.start()
    assert rows - 5 <= daemon.view.status().rows <= rows


def test_an_approval_cut_off_before_the_write_is_said_to_have_failed(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    number = daemon.service.journal.proposals()[0].id
    daemon.service.journal.decide(number, daemon.wall(), "approved", "ann")
    daemon.kill()
    daemon.start()
    assert daemon.view.proposals()[0].state == "failed"


def test_an_approval_cut_off_after_the_write_is_in_force(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    proposal = daemon.view.proposals()[0]
    daemon.service.journal.decide(daemon.service.journal.proposals()[0].id, daemon.wall(), "approved", "ann")
    daemon.service.save()
    recalibrator = Recalibrator(daemon.arm, daemon, daemon.store)
    recalibrator.apply(daemon.store.get(proposal.record), 2, "ann")
    rows = daemon.view.status().rows
    daemon.kill()
    daemon.start()
    assert daemon.view.proposals()[0].state == "applied"
    assert daemon.view.status().rows == rows  # the observer went on, with the finding installed
    assert daemon.view.estimates()[2].gain == 1.0
    daemon.run(60)
    assert not daemon.of_kind("alarm")[2:]


def test_controllers_that_lost_power_get_the_record_again(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "apply")
    daemon.service.take(Down("no power"))
    assert daemon.view.status().state is State.FAULT
    daemon.fast.held_gain[:], daemon.fast.held_offset[:] = 1.0, 0.0
    daemon.service.take(Up(daemon.held(), uncalibrated=tuple(daemon.arm.joint_names)))
    assert daemon.of_kind("recalibration")[-1].evidence["restored"]
    assert daemon.view.status().uncalibrated == ()
    assert abs(daemon.fast.error()[0][2]) < 0.003


def test_a_bus_that_comes_back_during_a_write_is_compared_after_it(tmp_path: Path) -> None:
    daemon = drifted(tmp_path, "propose")
    jobs: list[tuple[Any, Any]] = []
    daemon.run_aside = lambda work, done: jobs.append((work, done))
    daemon.view.approve(daemon.view.proposals()[0].id, "ann")
    daemon.fast.held_gain[5] = 1.3
    daemon.service.take(Down("no power"))
    daemon.service.take(Up(daemon.held()))
    daemon.service.tick()
    assert not daemon.of_kind("configuration")
    (write,) = jobs
    Immediate()(*write)
    daemon.run_aside = Immediate()
    daemon.service.tick()
    assert daemon.of_kind("configuration")[0].evidence["joints"] == ["joint_6"]


def test_an_error_that_is_no_fault_of_the_bus_is_raised(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    with pytest.raises(ZeroDivisionError):
        daemon.service.jobs.start(lambda: 1 / 0, lambda outcome: None)
    assert not daemon.service.jobs.busy


def test_under_propose_readings_of_other_calibrations_are_converted(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 4, settings("propose"))
    daemon.fast.held_gain[:], daemon.fast.held_offset[:] = 1.2, 2.0
    daemon.service.take(Down("gone"))
    daemon.service.take(Up(daemon.held()))
    daemon.run(100)
    assert "hold another calibration" in daemon.of_kind("configuration")[0].text
    assert not daemon.of_kind("alarm", "drift")


# ---- bus, records, configuration, disk


def test_a_bus_that_comes_and_goes_is_shown_and_does_not_fill_the_journal(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(5)
    for number in range(200):
        daemon.service.take(Down(f"bus socketcan:can0: gone {number}"))
        status = daemon.view.status()
        assert (status.state, status.bus.connected) == (State.FAULT, False)
        assert str(number) in (status.bus.fault or "")
        daemon.service.take(Up(daemon.held()))
        assert daemon.view.status().state is not State.FAULT
    assert len(daemon.view.events()) < 30


def test_a_joint_that_falls_silent_is_a_fault(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(5)
    batch = daemon.service.arm_state.batch
    batch.age[3] = 1.7
    assert daemon.view.status().state is State.FAULT
    assert daemon.view.status().detail == "joint_4: no reading has come for 1.7 s"
    assert daemon.view.joints()[3].sample_age_s == pytest.approx(1.7)


def test_a_host_near_the_deadline_is_said_once_and_not_of_few_cycles(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(5)
    stats = daemon.service.arm_state.batch.stats
    for _ in range(5000):
        stats.lateness.add(1e-4)
    for _ in range(10):
        stats.lateness.add(0.06)  # of 100 ms
    stats.cycles = 5010
    daemon.service.tick()
    assert not daemon.of_kind("late")
    stats.cycles = 10_000
    for _ in range(3):
        daemon.service.tick()
    (event,) = daemon.of_kind("late")
    assert "60 ms late in 99.9 % of the cycles, which comes near link.deadline (100 ms)" in event.text
    assert event.evidence["late_ms"]["p50"] < 0.2
    assert daemon.view.status().state is State.OBSERVING


def test_without_records_it_waits_and_begins_when_they_come(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"), records=False)
    daemon.run(10)
    status = daemon.view.status()
    assert status.state is State.STARTING
    assert "calibration and gravity" in status.detail
    assert ": sweep the arm, then calibrate and identify: armlink sweep " in status.detail
    listening = FastDaemon(tmp_path / "listening", 1, settings("apply"), listen_only=True, records=False)
    listening.run(10)
    assert "stop the program that commands the arm, then sweep the arm" in listening.view.status().detail
    assert daemon.view.estimates() == ()
    assert daemon.view.joints()[0].model_torque is None
    for record in daemon.good_records():
        daemon.store.put(record, daemon.arm, by="ann", reason="sweep")
    daemon.run(10)
    assert daemon.view.status().state is State.OBSERVING
    assert daemon.view.joints()[0].model_torque is not None


def test_a_reload_changes_the_policy_and_keeps_what_was_learnt(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("observe"))
    daemon.run(60)
    rows = daemon.view.status().rows
    daemon.service.reload(daemon.arm, settings("apply", observer={"window": 16}))
    status = daemon.view.status()
    assert (status.policy, status.rows) == ("apply", rows)
    assert daemon.service.records.feed.observer.config.window == 16


def test_a_full_disk_is_shown_and_stops_nothing(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(10)
    daemon.service.journal._db.execute("PRAGMA query_only=ON")
    daemon.run(30)
    assert "cannot be written" in daemon.view.status().detail
    daemon.service.journal._db.execute("PRAGMA query_only=OFF")
    daemon.run(30)
    assert daemon.view.status().detail == ""


def test_sweeps_are_by_schedule_or_request_and_only_where_the_bus_is_driven(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply", sweep_every_hours=0.02))
    daemon.run(120, until=lambda: daemon.view.status().state is State.SWEEPING)
    assert daemon.view.status().state is State.SWEEPING
    daemon.run(120, until=lambda: daemon.view.status().state is State.OBSERVING)
    assert [event.kind for event in daemon.of_kind("sweep")][:2] == ["sweep", "sweep"]
    listening = FastDaemon(tmp_path / "listening", 1, settings("apply"), listen_only=True)
    listening.service.tours.request("asked for")
    assert "only listens" in listening.of_kind("refused")[0].text


def at_a_job_of_few_poses(tmp_path: Path, **more: object) -> FastDaemon:
    """A daemon that knows its arm, which then goes to and fro among three poses while joint_3's sensor drifts."""
    daemon = FastDaemon(tmp_path, 4, settings("apply", **more))
    daemon.run(150)
    fast = daemon.fast
    half = 0.4 * (fast.arm.upper - fast.arm.lower)
    poses = fast.q.clip(fast.arm.lower + half, fast.arm.upper - half) + half * np.array([[-0.5], [0.0], [0.5]])
    fast.job = itertools.cycle(poses)
    daemon.run(60)
    fast.offset[2] += 0.8
    return daemon


@pytest.mark.long
def test_where_watching_cannot_decide_a_sweep_follows_and_decides(tmp_path: Path) -> None:
    daemon = at_a_job_of_few_poses(tmp_path, sweep_when_undecided=True)
    daemon.run(900, until=lambda: daemon.view.status().state is State.SWEEPING)
    assert daemon.view.status().state is State.SWEEPING
    assert daemon.of_kind("alarm")
    assert "too few different poses" in daemon.of_kind("undecided")[-1].text
    assert not daemon.of_kind("recalibration")
    daemon.run(600, until=lambda: daemon.view.status().state is State.OBSERVING)
    (written,) = daemon.of_kind("recalibration")
    assert written.joint == "joint_3"
    gain, offset = daemon.fast.error()
    assert np.abs(gain).max() < 0.003
    assert np.abs(offset).max() < 0.05


def test_without_leave_no_sweep_follows_and_nothing_is_written(tmp_path: Path) -> None:
    daemon = at_a_job_of_few_poses(tmp_path)
    daemon.run(400, until=lambda: bool(daemon.of_kind("undecided")))
    assert daemon.of_kind("undecided")
    daemon.run(30)
    assert not daemon.of_kind("sweep", "recalibration", "proposal")


# ---- journal, recordings, settings, systemd


def test_events_proposals_and_decisions_cannot_be_changed(tmp_path: Path) -> None:
    import sqlite3

    daemon = drifted(tmp_path, "propose")
    daemon.view.reject(daemon.view.proposals()[0].id, "ann")
    for statement in ("UPDATE events SET text = ''", "DELETE FROM proposals", "DELETE FROM decisions"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            daemon.service.journal._db.execute(statement)


def test_a_journal_of_another_version_is_refused(tmp_path: Path) -> None:
    journal = journal_at(tmp_path / "journal.db")
    journal._db.execute("PRAGMA user_version=99")
    journal.close()
    with pytest.raises(BadInput, match="schema 99"):
        journal_at(tmp_path / "journal.db")


def keep_history(daemon: FastDaemon) -> None:
    """Six points, a second apart."""
    for _ in range(6):
        daemon.run(1)
        daemon.service.save(history=True)


def history(daemon: FastDaemon, *asked: Any, **more: Any) -> tuple[HistoryPoint, ...]:
    return tuple(point for page in daemon.view.history_pages(*asked, **more) for point in page)


def test_history_is_thinned_evenly_and_ends_with_the_newest(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    keep_history(daemon)
    points = history(daemon, "joint_3")
    assert len(points) >= 6
    few = history(daemon, "joint_3", most=3)
    assert len(few) <= 3
    assert few[-1] == points[-1]
    assert history(daemon, "joint_3", since=points[-2].time) == points[-2:]
    with pytest.raises(NoSuch, match="joint_9"):
        history(daemon, "joint_9")
    everything = history(daemon, None, most=3)
    assert [point for point in everything if point.joint == "joint_3"] == list(few)


def test_history_older_than_a_month_is_thinned_the_rest_stays_whole(tmp_path: Path) -> None:
    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    journal, old = daemon.service.journal, daemon.wall() - timedelta(days=31)
    for minute in range(100):
        journal.add_history(old + timedelta(minutes=minute), 60.0 * minute, None, {"gain": []})
    keep_history(daemon)
    reader = HistoryReader(journal.path)
    times = [point[0] for page in reader.pages(reader.chosen(None, None, 1000)) for point in page]
    assert sum(time < daemon.wall() - timedelta(days=30) for time in times) == 10
    assert len(history(daemon, "joint_3")) >= 6


def test_recordings_are_rotated_within_their_quota_and_load(tmp_path: Path) -> None:
    given = {"minutes": 0.25, "quota_mb": 0.25, "rate": 25}
    daemon = FastDaemon(
        tmp_path, 1, settings("apply").model_copy(update={"recording": DaemonSection(recording=given).recording})
    )
    daemon.run(200)
    daemon.service.close("test")
    files = sorted((tmp_path / "state" / "recordings").glob("*.mcap"))
    assert 2 <= len(files) < 13
    assert sum(file.stat().st_size for file in files) <= 0.25e6
    assert int(files[-1].name.partition("-")[0]) > 10
    recording = load_recording(files[0])
    assert recording.warning == ""
    assert np.diff(recording.t).mean() == pytest.approx(0.04, rel=0.02)
    assert recording.t[-1] == pytest.approx(15.0, abs=4.0)


def test_unknown_keys_and_thresholds_of_the_section_are_refused() -> None:
    with pytest.raises(ValueError, match=r"observer\.windw"):
        DaemonSection.model_validate({"observer": {"windw": 3}})
    with pytest.raises(ValueError, match="polcy"):
        DaemonSection.model_validate({"polcy": "apply"})
    assert load_arm("sarcos").daemon is None


def test_systemd_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        Notifier()("READY=1", "STATUS=observing")
        assert receiver.recv(100) == b"READY=1\nSTATUS=observing"
    Notifier()("WATCHDOG=1")  # gone: no reason to stop
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert watchdog_seconds() == 30.0
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_seconds() is None


def test_a_log_line_is_one_json_object() -> None:
    record = logging.makeLogRecord({"name": "armlink.daemon", "levelname": "INFO", "msg": "a\nb", "joint": "joint_1"})
    line = JsonFormatter().format(record)
    assert "\n" not in line
    assert json.loads(line)["joint"] == "joint_1"
    assert json.loads(line)["message"] == "a\nb"


def test_a_flood_of_log_lines_is_cut_and_counted() -> None:
    limit, lines = LineLimit(Rate(burst=3, per_second=1)), []
    for second in (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0):
        record = logging.makeLogRecord({"name": "uvicorn", "levelname": "WARNING", "msg": "again", "created": second})
        if limit.filter(record):
            lines.append(getattr(record, "left_out", 0))
    assert lines == [0, 0, 0, 2]
    other = logging.makeLogRecord({"name": "armlink.daemon", "msg": "important", "created": 1.0})
    assert limit.filter(other)


async def _first(client: object) -> object:
    return await client.get()


def test_a_slow_client_loses_the_oldest_and_holds_nobody_up(tmp_path: Path) -> None:
    import asyncio

    daemon = FastDaemon(tmp_path, 1, settings("apply"))
    daemon.run(5)
    client = daemon.view.subscribe()
    for _ in range(1000):
        daemon.view.publish()
    last = daemon.view.snapshot()
    assert asyncio.run(_first(client)).type == "joints"
    assert client.qsize() < 100
    client.close()
    daemon.view.publish()
    assert client.qsize() < 100
    assert last.joints[0].joint == "joint_1"


def test_thresholds_of_earlier_arm_files_are_left_out_and_said_so(caplog: pytest.LogCaptureFixture) -> None:
    given = {"place_size": 0.3, "excitation_rows": 40, "window": 16}
    assert settings("apply", observer=given).observer == ObserverConfig(window=16)
    assert [record.args for record in caplog.records] == [("excitation_rows",), ("place_size",)]
    with pytest.raises(ValueError, match=r"observer\.windows"):
        settings("apply", observer={"windows": 16})
