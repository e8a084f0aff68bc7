"""Parts of the sweep that need no arm: trajectories, the settle rule, the data set on disk."""

import json
import resource
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sweep_arms import random_arm, synthetic_pass

from armlink.errors import BadInput, Refused
from armlink.link.integral import slowest_time
from armlink.link.types import Sample
from calib.arm.sweep_section import SweepSection
from calib.commands.screen import _short, confirm, stall_lines, unsettled_lines
from calib.commands.sweep import next_step
from calib.dataset import DataWriter, Manifest, PlanLine, StallLine, SweepData, encode, load_data
from calib.motion.mover import STOP_TOLERANCE, Mover
from calib.motion.static_reading import SettleRule, StaticReading
from calib.motion.trajectory import trajectory
from calib.plan.sweep_plan import plan_sweep
from calib.sweep.preflight import _noise
from gcomp.arrays import Array
from sim_bus.truth import Truth

PERIOD = 0.004
RULE = SettleRule.of(SweepSection(), np.array([0.05]), PERIOD)
COUNTS = np.array([True])
STEP = np.array([1e-4])
NONE = np.array([np.nan])


def same(ours: Sequence[StaticReading], theirs: Sequence[StaticReading]) -> bool:
    """Equal to the last digit, as the file has them."""
    return list(map(encode, ours)) == list(map(encode, theirs))


@given(
    start=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    goal=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
)
@example(start=[0.0, 0.0, 0.0], goal=[0.0, 0.0, 1e-308])
@settings(max_examples=60, deadline=None)
def test_trajectories_arrive_within_speed_and_acceleration(start: list[float], goal: list[float]) -> None:
    speed, acceleration = np.array([1.0, 0.5, 0.8]), np.full(3, 2.0)
    path = trajectory(np.array(start), np.array(goal), speed, acceleration, PERIOD)
    if not len(path):
        np.testing.assert_allclose(start, goal, atol=1e-12)
        return
    np.testing.assert_allclose(path[-1], goal, atol=1e-12)
    whole = np.vstack([start, path])
    velocity = np.diff(whole, axis=0) / PERIOD
    assert np.all(np.abs(velocity) <= speed * 1.02 + 1e-9)
    if len(velocity) > 2 and np.abs(np.array(goal) - start).max() > 0.01:
        assert np.all(np.abs(np.diff(velocity, axis=0)) / PERIOD <= acceleration * 1.1)


def test_noise_alone_has_settled() -> None:
    random = np.random.default_rng(0)
    settled = [
        RULE.settled(np.zeros((RULE.window, 1)), random.normal(0, 0.2, (RULE.window, 1)), COUNTS, STEP)
        for _ in range(200)
    ]
    assert np.mean(settled) > 0.7


@pytest.mark.parametrize("speed", [0.005, 0.02])
def test_a_creeping_joint_has_not(speed: float) -> None:
    position = np.round(np.arange(RULE.window) * PERIOD * speed / STEP[0])[:, None] * STEP[0]
    assert not RULE.settled(position, np.zeros((RULE.window, 1)), COUNTS, STEP)


@pytest.mark.parametrize("drift", [0.0, 2.0])
def test_a_torque_that_comes_with_every_fourth_cycle_settles_by_the_same_rule(drift: float) -> None:
    random, torque = np.random.default_rng(3), np.full((RULE.window, 1), np.nan)
    every = torque[::4, 0]
    every[:] = drift * np.linspace(0.0, 1.0, len(every)) + random.normal(0.0, 0.05, len(every))
    assert RULE.settled(np.zeros_like(torque), torque, COUNTS, STEP) == (drift == 0.0)
    assert RULE.exact(torque, COUNTS) == (drift == 0.0)


def test_a_window_has_as_many_torque_readings_where_they_come_with_every_fourth_cycle() -> None:
    slow = SettleRule.of(SweepSection(), np.array([0.05]), 0.02, torque_cycles=4)
    assert (slow.window, SettleRule.of(SweepSection(), np.array([0.05]), 0.02).window) == (32, 8)


def test_the_noise_of_a_torque_that_comes_with_every_fourth_cycle_is_known() -> None:
    readings = np.full(400, np.nan)
    readings[::4] = np.random.default_rng(4).normal(0.0, 0.1, 100)
    assert _noise(readings) == pytest.approx(0.1, rel=0.2)


def test_a_drifting_torque_has_not_but_one_that_does_not_count_may() -> None:
    noise = np.random.default_rng(1).normal(0, 0.2, (RULE.window, 1))
    drifting = noise + np.linspace(0, 1.0, RULE.window)[:, None]
    still = np.zeros((RULE.window, 1))
    assert not RULE.settled(still, drifting, COUNTS, STEP)
    assert RULE.settled(still, drifting, ~COUNTS, STEP)


def worst_reading(rule: SettleRule, left: Callable[[Array], Array]) -> float:
    """Largest error of the first window taken for rest, in standard errors, of 12 draws; `left` is still to come."""
    t, worst = np.arange(900) * PERIOD, 0.0
    for seed in range(12):
        random = np.random.default_rng(seed)
        torque = random.normal(0, 0.05, t.size) + left(t + random.uniform(0.0, 0.5))
        ends = range(rule.window, t.size, 5)
        windows = [torque[end - rule.window : end, None] for end in ends]
        first = next(each for each in windows if rule.settled(np.zeros_like(each), each, COUNTS, STEP))
        worst = max(worst, abs(float(first.mean())) / (0.05 / np.sqrt(50)))
    return worst


@pytest.mark.parametrize("swing", [0.3, 0.45, 0.6])
def test_the_turning_point_of_a_slow_swing_is_no_rest(swing: float) -> None:
    """Damped by 0.1: the joint of a soft drive with a load. The window of a stiff drive takes its turns for rest."""
    rate = 2 * np.pi / swing
    soft = SettleRule.of(SweepSection(), np.array([0.05 / np.sqrt(50)]), PERIOD, slowest_time(12.0, 1.2))
    stiff = SettleRule.of(SweepSection(), np.array([0.05 / np.sqrt(50)]), PERIOD)

    def left(t: Array) -> Array:
        return np.asarray(0.6 * np.exp(-0.1 * rate * t) * np.cos(rate * t))

    assert worst_reading(soft, left) < 3.0 < 6.0 < worst_reading(stiff, left)


def test_the_tail_of_a_slow_loop_is_no_rest() -> None:
    slowest = slowest_time(100.0, 12.0)
    soft = SettleRule.of(SweepSection(), np.array([0.05 / np.sqrt(50)]), PERIOD, slowest)
    stiff = SettleRule.of(SweepSection(), np.array([0.05 / np.sqrt(50)]), PERIOD)

    def left(t: Array) -> Array:
        return np.asarray(0.6 * np.exp(-t / slowest))

    assert worst_reading(soft, left) < 5.0 < 10.0 < worst_reading(stiff, left)


def test_a_window_in_the_arm_file_is_kept() -> None:
    section = SweepSection(settle_window=0.1)
    assert SettleRule.of(section, np.array([0.05]), PERIOD, slowest_time(12.0, 1.2)).window == 25
    assert SettleRule.of(SweepSection(), np.array([0.05]), PERIOD, slowest_time(0.0, 0.0)).window == 38


def test_averaging_goes_on_until_the_standard_error_is_reached() -> None:
    noise = np.random.default_rng(2).normal(0, 0.2, (100, 1))
    assert not RULE.exact(noise[:8], COUNTS)
    assert RULE.exact(noise, COUNTS)


class Replayed(Mover):
    """Takes samples of one joint, a period apart, for those of an arm."""

    def __init__(self, rule: SettleRule, period: float, position: Array, torque: Array) -> None:
        self.rule, self.resolution = rule, STEP
        self.link = SimpleNamespace(period=period, catch_up=lambda: None)  # type: ignore[assignment]
        self.samples = iter(
            Sample(k * period, np.array([at]), NONE, np.array([pull]), NONE, np.zeros(1, np.int64), np.zeros(1))
            for k, (at, pull) in enumerate(zip(position, torque, strict=True))
        )

    def cycle(self) -> Sample:
        """The next one."""
        return next(self.samples)


@pytest.mark.parametrize(("rate", "tail"), [(250, 1e-3), (100, 3e-4), (100, 1e-3), (50, 3e-4), (50, 1e-3)])
def test_the_time_to_settle_is_not_that_of_the_average(rate: float, tail: float) -> None:
    """At 50 Hz an average of 200 samples takes as long as a joint has to settle."""
    rule = SettleRule.of(SweepSection(), np.array([0.01]), 1 / rate)
    t = np.arange(0.0, 12.0, 1 / rate)
    torque = np.random.default_rng(5).normal(0, 0.2, t.size)
    reading = Replayed(rule, 1 / rate, tail * np.exp(-t / 1.2), torque).rest(COUNTS)
    assert reading.settled
    assert reading.t < SweepSection().settle_timeout + 1.6 * rule.max_samples / rate
    assert reading.count >= rule.max_samples


def test_a_creep_too_slow_to_tell_comes_to_an_end() -> None:
    rule = SettleRule.of(SweepSection(), np.array([0.01]), 0.02)
    t = np.arange(0.0, 12.0, 0.02)
    reading = Replayed(rule, 0.02, 5e-5 * t, np.random.default_rng(6).normal(0, 0.2, t.size)).rest(COUNTS)
    assert reading.settled
    assert reading.t < SweepSection().settle_timeout + 1.6 * rule.max_samples * 0.02


def test_a_joint_that_never_settles_is_read_when_its_time_is_up() -> None:
    swing = 0.01 * np.sin(np.arange(1100) * PERIOD * 5)
    reading = Replayed(RULE, PERIOD, swing, np.zeros(1100)).rest(COUNTS)
    assert not reading.settled
    assert reading.t == pytest.approx(SweepSection().settle_timeout, abs=0.05)


def test_a_data_set_reads_back_as_it_was_written(tmp_path: Path) -> None:
    arm = random_arm(1, 3)
    data = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0))
    assert data.plan is not None
    with DataWriter(tmp_path / "set", Manifest.of(arm, 0.0)) as writer:
        writer.append(PlanLine(plan=data.plan, resolution=(1e-4,) * 3))
        for reading in data.readings:
            writer.append(reading)
    back = load_data(tmp_path / "set").require(arm)
    assert same(back.readings, data.readings)
    assert back.plan == data.plan
    assert back.complete


@pytest.mark.parametrize("torn", [1, 17, 200])
def test_a_torn_last_line_is_left_out_and_overwritten_on_resume(tmp_path: Path, torn: int) -> None:
    arm = random_arm(1, 3)
    readings = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0)).readings[:3]
    folder = tmp_path / "set"
    with DataWriter(folder, Manifest.of(arm, 0.0)) as writer:
        for reading in readings:
            writer.append(reading)
    lines = folder / "readings.jsonl"
    lines.write_bytes(lines.read_bytes()[:-torn])
    assert same(load_data(folder).readings, readings[:2])
    with DataWriter(folder, Manifest.of(arm, 0.0), resume=True) as writer:
        writer.append(readings[2])
    assert same(load_data(folder).readings, readings)


def test_a_full_disk_is_said_in_one_line_and_loses_one_reading(tmp_path: Path) -> None:
    """A file may not grow beyond what it is: as on a full disk, the write fails and what was there stands."""
    arm = random_arm(1, 3)
    readings = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0)).readings[:3]
    folder = tmp_path / "set"
    with DataWriter(folder, Manifest.of(arm, 0.0)) as writer:
        writer.append(readings[0])
        unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
        size = (folder / "readings.jsonl").stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 40, unlimited[1]))
        try:
            with pytest.raises(BadInput, match=r"readings\.jsonl: .*the last reading was not saved.*--resume"):
                writer.append(readings[1])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert same(load_data(folder).readings, readings[:1])
    with DataWriter(folder, Manifest.of(arm, 0.0), resume=True) as writer:
        writer.append(readings[1])
    assert same(load_data(folder).readings, readings[:2])


def test_a_data_set_whose_beginning_was_cut_off_can_be_begun_again(tmp_path: Path) -> None:
    arm = random_arm(1, 3)
    (tmp_path / "manifest.json.part").write_text('{"schema": "armlink.sw')
    with DataWriter(tmp_path, Manifest.of(arm, 0.0)):
        pass
    assert load_data(tmp_path).readings == ()


def test_a_data_set_that_another_process_writes_is_not_resumed(tmp_path: Path) -> None:
    arm = random_arm(1, 3)
    says = r"set: in use by .*\(process \d+\): stop that process, or choose another one"
    with DataWriter(tmp_path / "set", Manifest.of(arm, 0.0)), pytest.raises(BadInput, match=says):
        DataWriter(tmp_path / "set", Manifest.of(arm, 0.0), resume=True)
    DataWriter(tmp_path / "set", Manifest.of(arm, 0.0), resume=True).__exit__()


def test_unsettled_readings_are_told_with_their_sweeps() -> None:
    arm = random_arm(1, 3)
    data = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0))
    assert unsettled_lines(data) == []
    swung = replace(data.readings[0], settled=False)
    (line,) = unsettled_lines(replace(data, readings=(swung, *data.readings[1:])))
    assert line.startswith(f"1 of {len(data.readings)} readings had not settled")
    assert "in the rough gravity model: these readings count less" in line


def test_people_are_told_of_readings_without_the_words_of_the_file() -> None:
    arm = random_arm(1, 3)
    data = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0))
    stalls = [StallLine(t=1.0, late_ms=None, reading=each, reason="") for each in ("scout 6", "j2.1 3", "end")]
    (line,) = stall_lines(replace(data, stalls=tuple(stalls)))
    assert line.endswith(
        "stopped 3 times; these readings were repeated: rough gravity model, pose 6; j2.1, reading 3; end"
    )


def test_without_a_terminal_it_is_said_what_moves_and_that_nobody_is_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stdin", None)
    (said,) = confirm("bench will move", "Is its space clear?")
    assert said == "bench will move. Is its space clear? There is no terminal to ask on: the arm moves now"


def swept(folder: Path, mass: float, seconds: int, speed: float | None = None) -> SweepData:
    """A whole pass on disk that was begun so many seconds after the first."""
    arm = random_arm(1, 3)
    data = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), mass, np.random.default_rng(0))
    assert data.plan is not None
    plan = data.plan.model_copy(
        update={"sweeps": tuple(each.model_copy(update={"speed": speed}) for each in data.plan.sweeps)}
    )
    manifest = Manifest.of(arm, mass)
    manifest = manifest.model_copy(
        update={"created": manifest.created.replace(year=2020, hour=0, minute=0, second=seconds)}
    )
    with DataWriter(folder, manifest) as writer:
        for line in (*data.readings, PlanLine(plan=plan, resolution=(0.0,) * 3)):
            writer.append(line)
    return load_data(folder)


def test_the_next_command_names_the_passes_that_are_there(tmp_path: Path) -> None:
    again, first = ["sweep", "arm.yaml"], swept(tmp_path / "un", 0.0, 0)
    _, step = next_step(first, again)
    assert step[2:3] + step[4:] == ["--reference-mass", "--out", str(tmp_path / "un-loaded")]
    _, step = next_step(swept(tmp_path / "unloaded", 0.0, 3), again)
    assert step[-1] == str(tmp_path / "loaded")
    alone = swept(tmp_path / "elsewhere" / "lo", 2.0, 1)
    assert next_step(alone, again)[1] == [*again, "--out", str(tmp_path / "elsewhere" / "unloaded")]
    (tmp_path / "of-another-program" / "manifest.json").parent.mkdir()
    (tmp_path / "of-another-program" / "manifest.json").write_text("{}")
    swept(tmp_path / "later", 0.0, 9)
    loaded = swept(tmp_path / "lo", 2.0, 1)
    assert next_step(loaded, again)[1] == ["calibrate", str(tmp_path / "un"), str(tmp_path / "lo")]


def test_creep_sweeps_are_fitted_after_the_third_pass(tmp_path: Path) -> None:
    again, names = ["sweep", "arm.yaml"], [str(tmp_path / name) for name in ("un", "lo", "un-again")]
    swept(tmp_path / "un", 0.0, 0, speed=0.1)
    loaded = swept(tmp_path / "lo", 2.0, 1, speed=0.1)
    assert next_step(loaded, again)[1] == [*again, "--out", names[2]]
    assert next_step(swept(tmp_path / "un-again", 0.0, 2, speed=0.1), again)[1] == ["calibrate", *names]


def test_long_names_of_joints_are_numbers_in_the_heads_of_a_narrow_plan() -> None:
    names = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")
    assert _short(names, 40) == ["1", "2", "3"]
    assert _short(names, 100) == [*names]
    assert _short(("joint_a2", "joint_a3"), 100) == ["2", "3"]


def test_a_missing_number_stays_missing(tmp_path: Path) -> None:
    arm = random_arm(1, 3)
    reading = synthetic_pass(arm, Truth.of(arm), plan_sweep(arm), 0.0, np.random.default_rng(0)).readings[0]
    lacking = replace(reading, motor_torque=np.full(3, np.nan))
    with DataWriter(tmp_path / "set", Manifest.of(arm, 0.0)) as writer:
        writer.append(lacking)
    assert np.isnan(load_data(tmp_path / "set").array("motor_torque")).all()


def test_bad_data_sets_say_where(tmp_path: Path) -> None:
    arm = random_arm(1, 3)
    with pytest.raises(BadInput, match=r"manifest\.json is missing"):
        load_data(tmp_path)
    with DataWriter(tmp_path / "set", Manifest.of(arm, 0.0)):
        pass
    with pytest.raises(BadInput, match="not empty"):
        DataWriter(tmp_path / "set", Manifest.of(arm, 0.0))
    with pytest.raises(Refused, match=r"reference_mass was 0\.0, but now it is 2\.0"):
        DataWriter(tmp_path / "set", Manifest.of(arm, 2.0), resume=True)
    (tmp_path / "set" / "readings.jsonl").write_text(json.dumps({"kind": "reading", "sweep": "x"}) + "\n")
    with pytest.raises(BadInput, match="line 1: key"):
        load_data(tmp_path / "set")
    with DataWriter(tmp_path / "other", Manifest.of(arm, 0.0)):
        pass
    with pytest.raises(Refused, match="arm is random1"):
        load_data(tmp_path / "other").require(random_arm(2, 3))


def test_a_reading_of_the_wrong_width_is_refused(tmp_path: Path) -> None:
    small, large = random_arm(1, 3), random_arm(1, 4)
    reading = synthetic_pass(large, Truth.of(large), plan_sweep(large), 0.0, np.random.default_rng(0)).readings[0]
    with DataWriter(tmp_path / "set", Manifest.of(small, 0.0)) as writer:
        writer.append(reading)
    with pytest.raises(BadInput, match="must have one value for each joint"):
        load_data(tmp_path / "set")


@pytest.mark.parametrize("side", [-1, 1])
def test_how_far_a_stop_may_be_from_its_place(side: int) -> None:
    place, most = side * 2.0, STOP_TOLERANCE + 0.025 * 2.0
    limits, names = SimpleNamespace(upper=[2.0], lower=[-2.0]), SimpleNamespace(names=["j1"])
    mover = SimpleNamespace(limits=limits, link=names, contacts={}, position=[place - side * (most - 1e-6)])
    Mover._check_stop(mover, 0, side)  # type: ignore[arg-type]
    assert mover.contacts == {(0, side): mover.position[0]}
    mover.position = [place - side * (most + 1e-6)]
    with pytest.raises(Refused, match=f"its stop should be at {place:.3f} rad"):
        Mover._check_stop(mover, 0, side)  # type: ignore[arg-type]
    furthest = 2 * STOP_TOLERANCE + 0.03 * 2.0
    Mover._check_creep(mover, 0, side, place + side * (furthest - 1e-6))  # type: ignore[arg-type]
    with pytest.raises(Refused, match=f"no stop was found at {place:.3f} rad"):
        Mover._check_creep(mover, 0, side, place + side * (furthest + 1e-6))  # type: ignore[arg-type]
