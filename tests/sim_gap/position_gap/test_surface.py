"""A table that the arm presses on: found in simulations with MuJoCo's contacts, and left out of fit and judgement."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from servo_arm import above_a_table, model_text, record

from armlink.recording.recording import Recording
from sim_gap.attribution.position_notes import _touching
from sim_gap.model.load import load_model
from sim_gap.position_gap.surface import RELEASE_S, Surface, find_surface, rows_of_touch
from sim_gap.position_gap.training import replay as replays
from sim_gap.position_gap.windows import thin, windows_of

HEIGHT, TIP = -0.2, np.array([0.16, 0.0, 0.0])
REAL = model_text(kp=15.0, friction=0.25)
SIM = load_model(mujoco.MjModel.from_xml_string(model_text(kp=120.0, friction=0.0)))


@pytest.fixture(scope="module")
def pressing() -> list[Recording]:
    return [record(above_a_table(REAL, HEIGHT), seed, 40.0, wide=1.5) for seed in (1, 2)]


def tip_height(q: np.ndarray) -> np.ndarray:
    """Height of the end of the last link [m], by hand: both links turn downwards."""
    return -0.2 * np.sin(q[:, 0]) - TIP[0] * np.sin(q.sum(1))


def test_the_table_and_the_moments_at_it_are_found(pressing) -> None:
    found = find_surface(SIM.arm, pressing)
    assert found is not None
    assert found.joints == (0, 1)
    for recording in pressing:
        at_it = tip_height(recording.position) < HEIGHT + 0.002
        rows = rows_of_touch(found, SIM.arm, recording)
        assert 0.02 < at_it.mean() < 0.3
        assert rows[at_it].mean() > 0.9
        about = np.convolve(at_it, np.ones(51), "same") > 0
        assert about[rows].mean() > 0.85


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(1, 10**6),
    friction=st.floats(0.0, 0.4),
    load=st.sampled_from([0.0, 0.15]),
    limit=st.sampled_from([1.0, 2.0, 9.0]),
)
def test_an_arm_that_touches_nothing_has_none(seed: int, friction: float, load: float, limit: float) -> None:
    """Not even one whose motors are too weak, or whose friction grows with the load."""
    real = model_text(kp=15.0, friction=friction, limits=(limit, limit))
    assert find_surface(SIM.arm, [record(real, seed, 30.0, wide=1.5, load=load)]) is None


def test_a_joint_at_a_stop_of_its_own_is_no_surface() -> None:
    stopped = REAL.replace('name="elbow" axis', 'name="elbow" range="-3 0.3" limited="true" axis')
    recording = record(stopped.replace("<option", '<compiler angle="radian"/><option', 1), 1, 40.0, wide=1.5)
    assert recording.position[:, 1].max() == pytest.approx(0.3, abs=0.03)
    assert find_surface(SIM.arm, [recording]) is None


def test_without_gravity_or_with_one_joint_nothing_is_looked_for(pressing) -> None:
    assert find_surface(replace(SIM.arm, gravity=np.zeros(3)), pressing) is None
    short = [replace(r, t=r.t[:5], position=r.position[:5], position_command=r.position_command[:5]) for r in pressing]
    assert find_surface(SIM.arm, short) is None


def test_an_arm_without_length_or_motion_has_none(pressing) -> None:
    bare = replace(SIM.arm, offset=np.zeros((2, 3)), inertial=np.zeros((2, 10)))
    assert find_surface(bare, pressing) is None
    t = np.arange(0.0, 40.0, 0.02)
    still = np.full((len(t), 2), 0.5)
    assert find_surface(SIM.arm, [Recording(t=t, position=still, position_command=still)]) is None


def test_the_moments_before_and_after_a_touch_are_left_out_too() -> None:
    surface = Surface(1, TIP, HEIGHT, (0, 1))
    t = np.arange(0.0, 4.0, 0.02)
    q = np.zeros((len(t), 2))
    q[100:110, 0] = 1.2
    rows = np.flatnonzero(rows_of_touch(surface, SIM.arm, Recording(t=t, position=q)))
    assert t[100] - t[rows[0]] == pytest.approx(0.5 * RELEASE_S, abs=0.021)
    assert t[rows[-1]] - t[109] == pytest.approx(RELEASE_S, abs=0.021)
    assert not rows_of_touch(None, SIM.arm, Recording(t=t, position=q)).any()


def test_an_arm_that_lies_still_on_it_touches() -> None:
    t = np.arange(0.0, 4.0, 0.02)
    still = np.tile([1.2, 0.1], (len(t), 1))
    surface = Surface(1, TIP, float(tip_height(still)[0]), (0, 1))
    assert rows_of_touch(surface, SIM.arm, Recording(t=t, position=still)).all()


def test_an_arm_that_always_lies_in_one_pose_on_it_is_found_and_left_out() -> None:
    """As coarse encoders show it: however deep the command is, the position is the same to the last digit."""
    t = np.arange(0.0, 60.0, 0.02)
    q = np.column_stack([-0.2 + 0.4 * np.sin(0.9 * t), 0.4 * np.sin(1.3 * t + 1.0)])
    lies, pose = t % 15.0 > 12.5, np.array([0.5, 0.2])
    q[lies] = pose
    lever = -np.array([0.2 * np.cos(pose[0]) + TIP[0] * np.cos(pose.sum()), TIP[0] * np.cos(pose.sum())])
    deep = np.where(lies, 0.45 * np.abs(np.sin(2.0 * t)), 0.0)[:, None]
    jitter = 0.004 * np.random.default_rng(1).standard_normal(q.shape)
    recording = Recording(t=t, position=q, position_command=q - deep * lever + jitter)
    found = find_surface(SIM.arm, [recording])
    assert found is not None
    assert rows_of_touch(found, SIM.arm, recording)[lies].all()


def test_surface_and_windows_do_not_depend_on_the_order_of_recordings(pressing) -> None:
    three = [*pressing, record(REAL, 3, 30.0)]
    one, other = (find_surface(SIM.arm, each) for each in (three, three[::-1]))
    assert one.height == other.height
    np.testing.assert_array_equal(one.point, other.point)
    ahead, back = (
        windows_of(SIM.arm, each, labels) for each, labels in ((three, ["a", "b", "c"]), (three[::-1], ["c", "b", "a"]))
    )
    np.testing.assert_array_equal(ahead.measured, back.measured)
    np.testing.assert_array_equal(ahead.recording, 2 - back.recording)
    np.testing.assert_array_equal(thin(ahead, 5).measured, thin(back, 5).measured)


def test_what_touches_does_not_count_in_windows(pressing) -> None:
    surface = find_surface(SIM.arm, pressing)
    labels = ["one", "two"]
    all_of_it, without = (windows_of(SIM.arm, pressing, labels, surface=each) for each in (None, surface))
    share = np.mean([rows_of_touch(surface, SIM.arm, recording).mean() for recording in pressing])
    left_out = 1.0 - without.weight.sum() / all_of_it.weight.sum()
    assert left_out == pytest.approx(share, abs=0.05)


def test_what_touches_is_not_judged_in_a_replay(monkeypatch) -> None:
    t = np.arange(0.0, 4.0, 0.1)
    apart = (t > 2.0) & (t < 3.0)
    simulated, measured = np.where(apart, 7.0, 0.5)[:, None], np.zeros((len(t), 1))
    monkeypatch.setattr(replays, "replay", lambda arm, recording, longest: (t, simulated, measured))
    recording = Recording(t=t, position=measured, position_command=measured)
    assert replays.replay_rms(replays.Simulated(None, (0,)), [recording], apart=[apart]) == pytest.approx([0.5])


def test_the_note_says_where_and_how_much() -> None:
    rows = (np.arange(10) < 2, np.arange(10) < 4, np.zeros(10, bool))
    sim = SimpleNamespace(arm=SimpleNamespace(names=("shoulder", "elbow")))
    (note,) = _touching(SimpleNamespace(surface=Surface(1, TIP, HEIGHT, (0, 1)), touched=rows, sim=sim))
    assert "in 2 of 3 recordings the arm presses on something below it" in note
    assert "20 to 40 %" in note
    assert _touching(SimpleNamespace(surface=None)) == []
