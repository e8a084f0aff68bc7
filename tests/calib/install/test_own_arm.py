"""A calibration is written to the arm it is of: told by its serial number, and by those of its drives."""

from pathlib import Path

import numpy as np
import pytest
from daemon_bench import DaemonBench
from fake_controllers import ARM, Controllers, joint, record
from fast_daemon import FastDaemon, settings

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import Refused
from armlink.link.link import Link
from calib.daemon.view import State
from calib.dataset import Manifest, SweepData, drives_of
from calib.install.journaled_write import install, recover
from calib.install.plausibility import Admitted
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

NEW = record(joints=(joint("shoulder", 1.12), joint("elbow", 1.08)), note="new")
OTHER = ["1:1:c", "1:1:d"]


def write(store: RecordStore, controllers: Controllers, new: CalibrationRecord = NEW, arm: ArmFile = ARM) -> None:
    install(Admitted(new, arm, "none"), store, controllers, by="ann", reason="sweeps", check=None)


@pytest.mark.parametrize("serial", ["unknown", "Unknown ", "FILL-IN"])
def test_nothing_is_written_to_an_arm_without_a_serial_number(store: RecordStore, serial: str) -> None:
    arm, controllers = ARM.model_copy(update={"serial": serial}), Controllers()
    with pytest.raises(
        Refused,
        match=r"bench: its serial is .*, so the calibration may belong to another arm .* give this arm a "
        r"serial in bench.yaml \(`serial: …",
    ):
        write(store, controllers, NEW.model_copy(update={"serial": serial}), arm)
    assert controllers.held == Controllers().held
    assert store.writes(arm) == []


def test_a_record_is_written_to_the_drives_that_it_was_measured_on(store: RecordStore) -> None:
    controllers, measured = Controllers(), NEW.model_copy(update={"drives": ("1:1:a", "1:1:b")})
    controllers.drives = OTHER
    with pytest.raises(
        Refused, match=r"none of its drives \(1:1:c …\) is one of the drives on which record .* was measured"
    ):
        write(store, controllers, measured)
    assert controllers.held == Controllers().held
    controllers.drives = ["1:1:c", "1:1:b"]  # one drive was exchanged
    write(store, controllers, measured)


def test_an_arm_that_shares_name_and_serial_with_one_written_before_is_refused(store: RecordStore) -> None:
    write(store, Controllers())
    other = Controllers()
    other.drives = OTHER
    for new in (NEW, record()):
        with pytest.raises(
            Refused,
            match="Another arm has the same name and serial, so nothing was written: give each arm its own serial",
        ):
            write(store, other, new)
    assert other.held == Controllers().held
    write(store, Controllers(), record(note="the arm itself goes on"))


def test_a_write_that_was_cut_off_is_not_undone_on_another_arm(store: RecordStore) -> None:
    entries = [{"joint": 0, "name": "shoulder", "gain": 1.3, "offset": -0.4, "record_id": 0, "date": 0}]
    drives = ("1:1:a", "1:1:b")
    store.begin_write(record().id, ARM, "ann", entries, reason="sweeps", gates="bounds", drives=drives)
    other = Controllers()
    other.drives = OTHER
    with pytest.raises(Refused, match="none of its drives"):
        recover(ARM, store, other)
    assert other.held == Controllers().held
    assert store.unfinished_write(ARM) is not None
    assert recover(ARM, store, Controllers()) is not None


def test_drives_without_serial_numbers_and_records_of_before_are_taken_as_they_are(store: RecordStore) -> None:
    mute = Controllers()
    mute.drives = ["", ""]
    write(store, mute, NEW.model_copy(update={"drives": ("1:1:a", "")}))
    write(store, Controllers(), record(note="no drives noted"))
    assert record().model_dump_json() == record(drives=()).model_dump_json()
    assert "drives" not in record().model_dump_json()


# ---- through the link


def test_an_arm_that_is_simulated_in_this_process_needs_no_serial_number(tmp_path: Path) -> None:
    """It ends with the process; its drives have numbers nevertheless, which tell two simulated arms apart."""
    arm = load_arm("sarcos").model_copy(update={"serial": "unknown"})
    bench = DaemonBench(tmp_path, arm)
    assert len(bench.store.writes(arm)[0].body["drives"]) == 7


def test_drives_tell_their_serial_numbers_and_two_arms_of_one_name_and_serial_differ(tmp_path: Path) -> None:
    arm = load_arm("sarcos")
    numbers = []
    for serial in (arm.serial, "another one"):
        there = arm.model_copy(update={"serial": serial})
        simulated = SimulatedArm(there, Truth.draw(there, 1), 1)
        with Link(arm, LockStepBus(arm=simulated)) as link:
            link.start()
            numbers.append([link.drive_serial(j) for j in range(link.n)])
    one, other = numbers
    assert all(drive.simulated and drive.number.count(":") == 2 for drive in one)
    assert not {drive.number for drive in one} & {drive.number for drive in other}
    assert len({drive.number for drive in one}) == 7


# ---- sweeps


def swept(*drives: str, serial: str = "7") -> SweepData:
    manifest = Manifest.of(ARM, 0.0, drives=drives).model_copy(update={"serial": serial})
    return SweepData(Path("swept"), manifest, (), None, np.zeros(2), "00")


def test_sweeps_tell_the_drives_and_of_two_arms_are_refused() -> None:
    assert drives_of([swept(), swept()]) == ()
    assert drives_of([swept("1:1:a", "1:1:b"), swept(), swept("1:1:c", "1:1:b")]) == ("1:1:c", "1:1:b")
    assert swept("", "").manifest.drives == ()
    with pytest.raises(Refused, match="they come from two arms"):
        drives_of([swept("1:1:a", ""), swept("1:1:c", "")])


def test_sweeps_from_before_the_arm_had_a_serial_number_are_still_its() -> None:
    assert swept(serial="unknown").require(ARM)
    with pytest.raises(Refused, match="serial is 8"):
        swept(serial="8").require(ARM)


# ---- two daemons


def daemon(folder: Path, store: Path, serial: str, policy: str, first: int, seed: int) -> FastDaemon:
    made = FastDaemon(folder, seed, settings(policy), store=str(store), records=False)
    made.kill()
    made.arm = made.arm.model_copy(update={"serial": serial})
    made.drives = [f"1:1:{first + k}" for k in range(made.fast.n)]
    if made.store.current(CalibrationRecord, made.arm) is None:
        for each in made.good_records():
            made.store.put(each, made.arm, by="ann", reason="sweep")
    made.directory = folder / "own"
    made.start()
    return made


@pytest.mark.sample(1)
@pytest.mark.parametrize(("serial", "written"), [("unknown", [0, 0]), ("7", [1, 0])])
def test_of_two_arms_of_one_name_on_one_store_none_gets_the_other_s_calibration(
    tmp_path: Path, serial: str, written: list[int]
) -> None:
    """Policy apply: each wrote its calibration on the other, seven joints, 1.35 N·m."""
    found = []
    for place, first in enumerate((0, 100)):
        one = daemon(tmp_path / str(place), tmp_path / "records.db", serial, "apply", first, seed=1)
        held = one.held()
        one.run(60)
        one.drift()
        one.run(200, until=lambda one=one: bool(one.of_kind("recalibration", "refused")))
        found.append(len(one.of_kind("recalibration")))
        if not found[-1]:
            assert one.held() == held
            said = {"unknown": "its serial is unknown", "7": "Another arm has the same name and serial"}[serial]
            assert said in one.of_kind("refused")[-1].text
            assert one.view.status().state is State.OBSERVING
    assert found == written


def test_without_a_serial_number_a_daemon_observes_and_proposes(tmp_path: Path) -> None:
    one = daemon(tmp_path / "one", tmp_path / "records.db", "unknown", "propose", 0, seed=1)
    one.run(60)
    one.drift()
    one.run(200, until=lambda: bool(one.view.proposals()))
    (proposal,) = one.view.proposals()
    assert (proposal.state, proposal.joint) == ("pending", "joint_3")
    answer = one.view.approve(proposal.id, "ann").result(0)
    assert answer.state == "failed"
    assert "give this arm a serial in sarcos.yaml (`serial: …`)" in answer.note
