"""Planned motion: within the arm's range and speed, both ways at several speeds; run and recorded through the link."""

import json
from pathlib import Path

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.errors import BadInput
from armlink.link.link import Link
from armlink.recording.files import load_recording
from calib.arm.kinematics import gcomp_arm
from sim_gap.experiment import (
    LONGEST,
    MOVES,
    SPEEDS,
    PlannedMotion,
    collect,
    joints_in_doubt,
    load_motion,
    multisine,
    plan_motion,
    save_motion,
)


@pytest.mark.parametrize("name", ["sarcos", "parallel6"])
def test_motion_stays_within_range_speed_and_acceleration(name: str) -> None:
    arm = load_arm(name)
    described, section = gcomp_arm(arm), arm.require_link()
    motion = plan_motion(arm, poses=2, seed=3)
    velocity = np.diff(motion.target, axis=0) * motion.rate
    acceleration = np.diff(velocity, axis=0) * motion.rate
    assert (motion.target >= described.lower).all()
    assert (motion.target <= described.upper).all()
    assert (np.abs(velocity) <= [joint.max_velocity for joint in section.joints]).all()
    assert np.abs(acceleration).max() < 1.5


def test_each_joint_turns_both_ways_at_every_speed_alone() -> None:
    arm = load_arm("sarcos")
    motion = plan_motion(arm, ["joint_4"], poses=1)
    velocity = np.diff(motion.target, axis=0) * motion.rate
    alone = np.flatnonzero(np.abs(np.delete(velocity, 3, axis=1)).max(axis=1) < 1e-9)
    fastest = arm.require_link().joints[3].max_velocity
    for share in SPEEDS:
        for way in (-1, 1):
            steady = np.abs(velocity[alone, 3] / (way * share * fastest) - 1) < 0.01
            assert steady.sum() > motion.rate  # for more than a second


def test_a_slow_joint_turns_through_a_part_of_its_range() -> None:
    """As far as it gets in the longest time, about the middle."""
    shape = PlannedMotion(load_arm("sarcos"))
    shape.fastest = 0.004 * (shape.high - shape.low)
    shape.turn(3, shape.here)
    q = np.concatenate(shape.rows)[:, 3]
    assert np.ptp(q) == pytest.approx(max(SPEEDS) * shape.fastest[3] * LONGEST)
    assert 0.5 * (q.min() + q.max()) == pytest.approx(0.5 * (shape.low[3] + shape.high[3]))


def test_what_a_diagnosis_leaves_open_is_moved(tmp_path: Path) -> None:
    answer = tmp_path / "gap.json"
    clear = {"joints": ["joint_1"], "confounded_with": [], "separate_by": None}
    doubtful = {"joints": ["joint_2"], "confounded_with": ["friction.load"], "separate_by": "record both ways"}
    answer.write_text(json.dumps({"causes": [clear, doubtful], "where": []}), encoding="utf-8")
    assert joints_in_doubt(answer) == (["joint_2"], ["record both ways"])
    answer.write_text(json.dumps({"causes": [clear], "where": []}), encoding="utf-8")
    assert joints_in_doubt(answer) == (["joint_1"], [])
    answer.write_text("[]", encoding="utf-8")
    with pytest.raises(BadInput, match="not a result that gap diagnose wrote"):
        joints_in_doubt(answer)
    with pytest.raises(BadInput, match="no joint elbow in arm sarcos"):
        plan_motion(load_arm("sarcos"), ["elbow"])


def write(path: Path, rows: np.ndarray, rate: float = 50.0) -> Path:
    t = np.arange(len(rows))[:, None] / rate
    header = ",".join(["t", *(f"q_cmd_{i + 1}" for i in range(rows.shape[1]))])
    np.savetxt(path, np.hstack([t, rows]), delimiter=",", header=header, comments="")
    return path


def test_a_motion_comes_back_from_its_file_at_the_arms_rate(tmp_path: Path) -> None:
    arm = load_arm("sarcos")
    motion = plan_motion(arm, ["joint_7"], poses=1)
    save_motion(motion, tmp_path / "m.csv")
    assert load_motion(tmp_path / "m.csv", arm) == pytest.approx(motion.target[: len(motion.target) - 1], abs=1e-9)


def test_a_motion_that_does_not_fit_the_arm_is_refused(tmp_path: Path) -> None:
    arm = load_arm("sarcos")
    described = gcomp_arm(arm)
    middle = (described.lower + described.upper) / 2
    rows = np.repeat(middle[None], 50, axis=0)
    beyond, fast, missing = rows.copy(), rows.copy(), rows.copy()
    beyond[:, 2] = described.upper[2] + 0.01
    fast[25:, 4] += 0.3
    missing[7, 1] = np.nan
    for name, bad, words in (
        ("beyond", beyond, "joint_3 goes from .* beyond its range"),
        ("fast", fast, "joint_5 turns at .* but its max_velocity"),
        ("missing", missing, "row 8: q_cmd_2 is nan, expected a number"),
        ("narrow", rows[:, :5], "column q_cmd_6 is missing"),
    ):
        with pytest.raises(BadInput, match=words):
            load_motion(write(tmp_path / f"{name}.csv", bad), arm)


def test_the_arm_follows_and_every_cycle_is_recorded(tmp_path: Path) -> None:
    arm = load_arm("sarcos")
    described = gcomp_arm(arm)
    middle = (described.lower + described.upper) / 2
    t = np.arange(0, 2, 0.02)[:, None]
    target = load_motion(write(tmp_path / "m.csv", middle + 0.1 * (1 - np.cos(np.pi * t))), arm)
    with Link.open(arm, "armlink_sim:sarcos") as link:
        link.start()
        link.enable()
        rows = collect(link, target, tmp_path / "out.mcap")
        link.disable()
    recording = load_recording(tmp_path / "out.mcap")
    assert rows == len(target) == len(recording.t)
    assert recording.names == described.names
    assert recording.position_command == pytest.approx(target, abs=1e-9)
    assert np.abs(recording.position - target).max() < 0.05
    assert recording.torque is not None
    assert np.isfinite(recording.torque).all()


def waves(reach: tuple[float, float], speed: tuple[float, float], seed: int) -> tuple[np.ndarray, ...]:
    """Position, velocity and acceleration of two joints over a minute, where the sines are at their full size."""
    draw = np.random.default_rng(seed).random((2, 2, 3))
    q = multisine(np.arange(12_000) / 200.0, np.array(reach), np.array(speed), (0.08, 0.3), draw)[1000:-1000]
    v = np.diff(q, axis=0) * 200.0
    return q, v, np.diff(v, axis=0) * 200.0


def test_sines_keep_reach_speed_and_acceleration() -> None:
    q, v, a = waves((0.35, 0.9), (0.12, 4.8), 1)
    assert (np.abs(q) <= [0.35 + 1e-9, 0.9 + 1e-9]).all()
    assert (np.abs(v) <= [0.12 + 1e-6, 4.8 + 1e-6]).all()
    assert np.abs(a).max() <= MOVES.acceleration + 1e-6
    assert (np.ptp(q, axis=0) > 0.05).all()


def test_sines_use_the_acceleration_that_they_may() -> None:
    """On a joint with reach and speed in plenty; where the sines meet, in the course of a minute."""
    _, _, a = waves((0.35, 30.0), (0.6, 30.0), 3)
    assert 0.95 * MOVES.acceleration < np.abs(a[:, 1]).max() <= MOVES.acceleration + 1e-6
