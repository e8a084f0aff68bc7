"""The self-test: what it finds on a controller that does what it should, and on one that does not."""

import json
import re
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from armlink.arm_file import bundled_arms, parse_arm
from armlink.cli import run
from armlink.commands.check import _outcomes
from armlink.drives.canopen.check.self_test import POWER_CHECKS
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.drives.findings import HOLD_TOLERANCE, Result
from armlink.link.link import Link
from armlink.selftest.self_test import SelfTest, announcement
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.node import supervision
from sim_bus.node.drives import SimulatedDrives
from sim_bus.node.supervision import Supervision
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ROOT = Path(__file__).parents[3]
QUICK_STOP = 0x07

HOLDING = ("sarcos", "parallel6", "six-cia402")
RATING = {"rated_torque": 20.0, "max_torque": 20.0}
DAMIAO = {"family": "damiao", "id": 2, "reply": 0x12, "model": "DM8009", "kp": 50, "kd": 5.0}


def two_joints(**joint):
    return parse_arm(content_of_two_joints(**joint), Path("pair.yaml"))


def content_of_two_joints(**joint):
    row = {**RATING, **joint}
    return {
        "name": "pair",
        "kinematics": {
            "joints": [
                {"name": "hinge_1", "alpha": 1.5707963, "d": 0.2, "lower": -2.0, "upper": 2.0},
                {"name": "hinge_2", "a": 0.3, "lower": -2.0, "upper": 2.0},
            ]
        },
        "link": {"joints": [{"name": "hinge_1", "node": 11, **row}, {"name": "hinge_2", "node": 12, **row}]},
        "sim": {
            "links": [
                {"mass": 2.0, "com": [0.0, 0.0, 0.05], "inertia": [0.01, 0.01, 0.01]},
                {"mass": 1.0, "com": [0.1, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]},
            ],
            "sensors": {"noise": [0.01, 0.01], "bits": 16},
        },
    }


@pytest.fixture
def simulated():
    arm = two_joints()
    return SimulatedArm(arm, Truth.of(arm), 1)


def self_test(simulated, power=True, bus=LockStepBus):
    with Link(simulated.arm, bus(arm=simulated)) as link:
        results = SelfTest(link).run(power)
    return {(each.joint, each.check): each for each in results}


def outcomes(results, check):
    return [each.outcome for (_, name), each in results.items() if name == check]


def test_a_simulated_arm_passes_and_says_how_long_it_takes(simulated):
    results = self_test(simulated)
    assert {each.outcome for each in results.values()} == {"passed"}
    for joint in ("hinge_1", "hinge_2"):
        silent = results[joint, "RPDO deadline"]
        assert silent.seconds == pytest.approx(0.1, abs=0.0081)
        assert "quick stop" in silent.found
        assert "8250h" in silent.found
        alone = results[joint, "heartbeat of the host"]
        assert alone.seconds == pytest.approx(0.2, abs=0.0081)
        assert "8130h" in alone.found
    simulated.advance(0.5)
    assert [node.value(0x6041) & 0x6F for node in simulated.nodes] == [QUICK_STOP] * 2


class LateBus(LockStepBus):
    """Of every third cycle the readings come a cycle late."""

    syncs, late = 0, ()

    def put(self, can_id, data):
        if can_id == SYNC_ID:
            self._outbox.extend(self.late)
            self.late = ()
            self.syncs += 1
        super().put(can_id, data)
        if can_id == SYNC_ID and self.syncs % 3 == 0:
            self.late = [frame for frame in self._outbox if 0x180 < frame[0] < 0x200]
            for frame in self.late:
                self._outbox.remove(frame)


def test_answers_that_come_late_are_answers():
    arm = two_joints()
    results = self_test(SimulatedArm(arm, Truth.of(arm), 1), bus=LateBus)
    for joint in ("hinge_1", "hinge_2"):
        assert results[joint, "answers SYNC"].outcome == "passed"
        assert re.search(r"replies came in (\d+) of \1 cycles, 1\d of them late", results[joint, "answers SYNC"].found)


def test_the_joints_do_not_move(simulated):
    before = simulated.plant.position.copy()
    self_test(simulated)
    assert np.abs(simulated.plant.position - before).max() < 0.02


def test_without_power_nothing_is_enabled(simulated):
    results = self_test(simulated, power=False)
    assert [node.value(0x6041) & 0x4F for node in simulated.nodes] == [0x40] * 2
    for check in POWER_CHECKS:
        assert outcomes(results, check) == ["not run"] * 2
    assert "failed" not in {each.outcome for each in results.values()}


def test_a_latched_torque_offset_is_cleared(simulated):
    simulated.nodes[0].set_data(0x60B2, 0, struct.pack("<h", 120))
    results = self_test(simulated, power=False)
    assert results["hinge_1", "settings: 60B2h:00 torque offset"].outcome == "passed"
    assert simulated.nodes[0].value(0x60B2) == 0


def test_a_device_that_swaps_disable_and_quick_stop_is_found_and_not_tried_again(simulated, monkeypatch):
    monkeypatch.setattr(supervision, "ABORT_QUICK_STOP", 2)
    monkeypatch.setattr(supervision, "ABORT_DISABLE", 3)
    results = self_test(simulated)
    assert outcomes(results, "RPDO deadline") == ["failed"] * 2
    assert 'goes to "switch on disabled" instead of "quick stop active"' in results["hinge_1", "RPDO deadline"].found
    assert "swap the values 2 and 3" in results["hinge_1", "RPDO deadline"].found
    assert outcomes(results, "heartbeat of the host") == ["not run"] * 2
    assert "lost its power" in results["hinge_2", "heartbeat of the host"].found


def test_a_device_without_a_deadline_is_found(simulated, monkeypatch):
    monkeypatch.setattr(Supervision, "rpdo", lambda *_: None)
    results = self_test(simulated)
    assert outcomes(results, "RPDO deadline") == ["failed"] * 2
    assert "does nothing within" in results["hinge_1", "RPDO deadline"].found
    assert outcomes(results, "heartbeat of the host") == ["passed"] * 2


def test_a_device_that_does_not_watch_the_host_is_found(simulated, monkeypatch):
    monkeypatch.setattr(Supervision, "heartbeat", lambda *_: None)
    results = self_test(simulated)
    assert outcomes(results, "RPDO deadline") == ["passed"] * 2
    assert outcomes(results, "heartbeat of the host") == ["failed"] * 2


def test_a_device_that_leaves_operational_is_told(simulated):
    simulated.nodes[1].set_data(0x1029, 1, b"\0")
    results = self_test(simulated)
    assert results["hinge_2", "heartbeat of the host"].outcome == "passed"
    assert "NMT pre-operational (1029h:01)" in results["hinge_2", "heartbeat of the host"].found
    assert "NMT" not in results["hinge_1", "heartbeat of the host"].found


def test_a_device_that_does_not_enter_a_mode_is_found(simulated, monkeypatch):
    select = SimulatedDrives._select_mode

    def stubborn(self, joint):
        if not (joint == 1 and self._mode_in[joint] == 10):
            select(self, joint)

    monkeypatch.setattr(SimulatedDrives, "_select_mode", stubborn)
    results = self_test(simulated)
    assert results["hinge_1", "mode display"].outcome == "passed"
    assert results["hinge_2", "mode display"].outcome == "failed"
    assert "does not enter mode 10 (displays" in results["hinge_2", "mode display"].found


def test_another_controller_is_found_and_nothing_is_set(simulated):
    arm = two_joints(identity={"serial": 7})
    with Link(arm, LockStepBus(arm=simulated)) as link:
        results = SelfTest(link).run(power=True)
    failed = [each for each in results if each.outcome == "failed"]
    assert [(each.joint, each.check) for each in failed] == [("hinge_1", "identity"), ("hinge_2", "identity")]
    assert "1018h:04 serial number is 0x" in failed[0].found
    assert "expected 0x7: connect the right arm" in failed[0].found
    assert not any(each.check.startswith("settings") for each in results)
    assert simulated.nodes[0].value(0x1017) == 0


def test_a_record_whose_crc_is_wrong_is_found(simulated):
    simulated.nodes[0].set_data(0x2100, 9, struct.pack("<I", 12345))
    assert self_test(simulated, power=False)["hinge_1", "calibration"].outcome == "failed"


def test_the_command_answers_for_machines(tmp_path, capsys):
    path = tmp_path / "pair.yaml"
    content = yaml.safe_load(bundled_arms()["sarcos"].read_text())
    content["link"]["joints"][1]["identity"] = {"vendor": 0, "serial": 1}
    path.write_text(yaml.safe_dump(content))
    assert run(["check", str(path), "--bus", "armlink_sim:sarcos", "--json", "-"]) == 1
    captured = capsys.readouterr()
    answer = json.loads(captured.out)
    assert answer["schema"] == "armlink.check/1"
    assert not answer["passed"]
    assert [each["joint"] for each in answer["checks"] if each["outcome"] == "failed"] == ["joint_2"]
    assert "check: 1 of" in captured.err.splitlines()[-1]
    assert run(["check", "sarcos", "--bus", "armlink_sim:sarcos", "--passive", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"]


def test_on_another_bus_it_asks_first(capsys):
    assert run(["check", "sarcos", "--bus", "virtual:nobody"]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == (
        "armlink: check: there is no terminal to ask for confirmation: give `--yes`, or `--passive` for "
        "the checks without power"
    )


@pytest.mark.parametrize(
    ("arm", "says", "never"),
    [
        ("sarcos", ("quick-stopped", "for 100 ms", "heartbeat", "hold, in quick stop"), ("lowered", "parked")),
        (
            "six-damiao",
            ("up to 300 ms", "wrist_3: falls (damiao)", "parked or slowly lowered"),
            ("quick", "heartbeat"),
        ),
        ("six-moteus", ("wrist_3: damps (moteus)",), ("quick", "heartbeat", "keeper")),
        (
            "six-piper",
            ("wrist_3: holds (piper)", "Finally, no joint gets commands", "keeper must hold"),
            ("heartbeat",),
        ),
    ],
)
def test_it_announces_what_it_tests_of_these_drives(arm, says, never, capsys):
    assert run(["check", arm, "--bus", "virtual:nobody"]) == 2
    announced = capsys.readouterr().err
    assert all(each in announced for each in says), announced
    assert not any(each in announced for each in never), announced


def test_the_joints_of_a_mixed_arm_are_named_by_what_their_drives_do():
    content = yaml.safe_load(bundled_arms()["six-damiao"].read_text())
    content["link"]["joints"][0] |= {"drive": {"family": "canopen", "node": 99}}
    announced = announcement(parse_arm(content, Path("mixed.yaml")))
    assert "base: holds (canopen); shoulder, elbow, wrist_1, wrist_2, wrist_3: falls (damiao)" in announced


@pytest.mark.parametrize(
    ("geometry", "options", "step"),
    [(True, ["--passive"], "check here.yaml"), (True, [], "sweep here.yaml --plan"), (False, [], "doctor here.yaml")],
)
def test_what_comes_next(geometry, options, step, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load((ROOT / "examples" / "planar3.yaml").read_text())
    content["link"]["bus"]["channel"] = str(ROOT / "examples" / "planar3.yaml")
    if not geometry:
        for row in content["kinematics"]["joints"]:
            row |= {"a": 0.0, "alpha": 0.0, "d": 0.0}
    Path("here.yaml").write_text(yaml.safe_dump(content))
    assert run(["check", "here.yaml", *options]) == 0
    assert f"next: armlink {step}\n" in capsys.readouterr().err


def test_an_arm_that_is_not_there_is_a_bus_fault(capsys):
    content = yaml.safe_load(bundled_arms()["sarcos"].read_text())
    assert content
    assert run(["check", "sarcos", "--bus", "virtual:nobody", "--yes"]) == 3
    assert "no answer from joint_1" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.sample(1)
@pytest.mark.parametrize("arm", ["openarm", *(name for name in bundled_arms() if name != "openarm")])
def test_every_bundled_arm_passes_in_process(arm, capsys):
    """The OpenArm's wrist sags under its soft gains until the integral term has taken its load over."""
    assert run(["check", arm, "--yes"]) == 0
    told = capsys.readouterr().out
    assert "checks passed" in told
    assert ("the joints hold where they stand" if arm in HOLDING else "its power was switched off") in told


def test_the_joint_that_a_reason_begins_with_is_blamed():
    test = SelfTest(SimpleNamespace(names=("joint_1", "joint_10", "joint_2")), print)
    assert test._blamed("joint_10 (id 0Ah): its power stays off") == "joint_10"
    assert test._blamed("joint_2: its power stays off") == "joint_2"
    assert test._blamed("joint_2 and joint_10 are silent") == "joint_1"


def test_the_joint_that_moved_is_blamed(capsys, monkeypatch):
    """A shoulder that carries the arm, with gains that are not its own: no tolerance is left for its load."""
    monkeypatch.setattr(SelfTest, "_sags", lambda test: np.full(test.link.n, -HOLD_TOLERANCE))
    assert run(["check", "openarm", "--yes"]) == 1
    told = capsys.readouterr()
    (line,) = [line for line in told.out.splitlines() if "while it should hold" in line]
    moved = line.partition(": enables and holds: ")
    assert moved[1]
    assert moved[2].startswith(f"{moved[0]}: moved by")
    assert "no answer from" not in told.err


@pytest.mark.parametrize("drive", [{"family": "canopen", "node": 12}, DAMIAO])
@pytest.mark.parametrize("passive", [True, False])
def test_a_drive_that_lost_a_turn_fails_without_power(tmp_path, capsys, drive, passive):
    """The check of its position names the zero, and nothing that needs power is run."""
    for name, zero in (("host", 0.0), ("lost", 0.0 if drive["family"] == "canopen" else 2 * np.pi)):
        content = content_of_two_joints()
        content["link"]["joints"][1] = {"name": "hinge_2", "drive": {**drive, "zero": zero}, **RATING}
        if drive["family"] != "canopen":
            content["link"]["joints"][0] = {"name": "hinge_1", "drive": {**drive, "id": 1, "reply": 0x11}, **RATING}
        elif name == "lost":
            content["sim"]["sensors"]["position_offset"] = [0.0, -2 * np.pi]
        content["link"]["bus"] = {"interface": "armlink_sim", "channel": "lost.yaml"}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    path = str(tmp_path / "host.yaml")
    assert run(["check", path, "--json", "-", *(["--passive"] if passive else [])]) == 1
    answer = json.loads(capsys.readouterr().out.partition("{")[2].join(["{", ""]))
    checks = answer["checks"]
    (failed,) = [each for each in checks if each["outcome"] == "failed"]
    assert (failed["joint"], failed["check"]) == ("hinge_2", "position")
    assert "write `zero: 6.2832` (a whole turn more)" in failed["found"]
    with_power = ("enables and holds", "quick stop", "silence")
    assert {each["outcome"] for each in checks if each["check"] in with_power} == {"not run"}


@pytest.mark.parametrize(
    ("found", "shown"),
    [
        ({"a": "passed", "b": "passed"}, "ok"),
        ({"a": 0.008, "b": 0.012, "c": 0.0081}, "8 to 12 ms"),
        ({"a": 0.008, "b": 0.0081}, "8 ms"),
        ({"a": 0.008, "b": "passed"}, "8 ms: a; ok: b"),
        ({"a": "passed", "b": "failed", "c": "passed", "d": "not run"}, "ok: a, c; FAILED: b; not made: d"),
    ],
)
def test_the_table_names_joints_where_they_differ(found, shown):
    results = {
        joint: [Result(joint, "silence", "passed", "", it) if isinstance(it, float) else Result(joint, "x", it, "")]
        for joint, it in found.items()
    }
    assert _outcomes(results).plain == shown
