"""The scale check: what it can judge by arrays alone, and on simulated drives of every family."""

import numpy as np
import pytest
from moved_by_hand import ALL, arm_with, judged

from armlink.arm_file import load_arm
from armlink.errors import BadInput
from armlink.link.link import Link
from armlink.selftest.scales import (
    ScaleTrack,
    current_evidence,
    gather_evidence,
    judge_scales,
    law_evidence,
    stops_evidence,
    velocity_evidence,
)
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

OFF = {0: ("velocity", 1.25), 1: ("position", 0.88), 2: ("torque", 1.15)}


def track(position=1.0, velocity=1.0, torque=1.0, noise=0.05, seed=0):
    """A joint under gains whose position, velocity and torque are coded that much larger than they are decoded."""
    random = np.random.default_rng(seed)
    t = np.arange(4000) * 0.004
    q, v = np.sin(t), np.cos(t)
    target, rate, ahead = q + 0.02 * np.sin(3 * t), v + 0.05 * np.cos(5 * t), 3.0 * np.cos(t)
    read = {"q": q / position, "v": v / velocity, "target": target / position, "rate": rate / velocity}
    last = [np.roll(each, 1) for each in (target, rate, ahead)]
    made = 60.0 * (last[0] - q) + 2.0 * (last[1] - v) + last[2] * torque
    reported = made / torque + noise * random.standard_normal(len(t)) + 0.3
    gain = np.full(len(t), 60.0), np.full(len(t), 2.0)
    return ScaleTrack(t, read["q"], read["v"], reported, read["target"], read["rate"], ahead, *gain)


@pytest.mark.parametrize("quantity", ["position", "velocity", "torque"])
@pytest.mark.parametrize("factor", [0.8, 0.9, 1.11, 1.25])
def test_one_scale_that_is_off_is_named_with_its_size(quantity, factor):
    (found,) = judge_scales(gather_evidence(track(**{quantity: factor}), 2.0, stop_to_stop=False, by_current=()))
    assert found.quantities == (quantity,)
    assert found.factor == pytest.approx(factor, rel=0.02)


def test_two_scales_that_are_off():
    found = judge_scales(gather_evidence(track(position=1.2, torque=0.8), 2.0, stop_to_stop=True, by_current=()))
    assert {each.quantities[0]: round(each.factor, 1) for each in found} == {"position": 1.2, "torque": 0.8}


def test_sound_scales_are_not_named():
    for seed in range(20):
        assert judge_scales(gather_evidence(track(seed=seed), 2.0, stop_to_stop=True, by_current=())) == []


def test_without_more_evidence_it_says_which_ones_it_may_be():
    bare = track(velocity=1.25)
    bare = ScaleTrack(*(getattr(bare, name) for name in ("t", "position", "velocity")), *[np.full(4000, np.nan)] * 6)
    (found,) = judge_scales(gather_evidence(bare, 9.0, stop_to_stop=False, by_current=()))
    assert found.quantities == ("position", "velocity")
    assert found.text.startswith("position or velocity reads")


def test_a_joint_that_hardly_moved_shows_nothing():
    still = track()
    still = ScaleTrack(still.t, 0.001 * still.position, 0.001 * still.velocity, *[np.full(4000, np.nan)] * 6)
    assert gather_evidence(still, 2.0, stop_to_stop=False, by_current=()) == []


def test_a_velocity_that_is_none():
    moved = track()
    wild = moved.velocity * (3 + np.sign(np.sin(20 * moved.t)) * 4)
    evidence = velocity_evidence(ScaleTrack(moved.t, moved.position, wild, *[np.full(4000, np.nan)] * 6))
    (found,) = judge_scales([evidence])
    assert found.quantities == ("velocity",)
    assert "velocity is unsteady" in found.text


def test_a_velocity_that_scatters_is_known_as_well_as_its_windows_agree():
    """160 windows of 0.25 s, in each of which the velocity reads 20 % too much or too little, one in three more."""
    t = np.arange(16000) * 0.0025
    reads = 1.0 + 0.2 * np.random.default_rng(4).standard_normal(160)
    found = velocity_evidence(ScaleTrack(t, t, np.repeat(reads, 100), *[np.full(len(t), np.nan)] * 6))
    assert found.ratio == pytest.approx(1.0, abs=0.03)
    assert found.sigma == pytest.approx(0.2 / np.sqrt(160), rel=0.25)


def test_a_way_beyond_the_stops_counts_whoever_moved_the_joint():
    assert stops_evidence(track(position=0.8), 2.0, stop_to_stop=False).ratio == pytest.approx(1.25, rel=1e-3)
    assert stops_evidence(track(position=1.2), 2.0, stop_to_stop=False) is None


def test_current_times_torque_constant():
    pairs = [(-4.0, -5.0), (2.0, 2.5), (3.2, 4.0)]
    assert judge_scales([current_evidence(pairs)])[0].factor == pytest.approx(1.25)
    assert current_evidence(pairs[:2]) is None


def test_few_rows_with_gains_are_no_law():
    short = track()
    assert law_evidence(ScaleTrack(*(getattr(short, name)[:100] for name in short.__dataclass_fields__))) == []


@pytest.mark.long
@pytest.mark.parametrize("name", ALL[:4])  # CubeMars drives, whose evidence is Damiao's: in the campaign
def test_every_family_by_hand_and_by_its_own_host(name):
    found = judged(name, OFF)
    assert all(quantity in each for each, quantity in zip(found, ("velocity", "position", "torque"), strict=False))
    wanted = zip(found[:3], OFF.values(), strict=True)
    assert all(set(each) <= {quantity, "position or velocity"} for each, (quantity, _) in wanted)
    assert found[3:] == [[], [], []]


def test_stock_cia402_by_hand_and_by_its_own_host():
    found = judged("six-cia402", {0: ("velocity", 1.25), 1: ("position", 0.88)})
    assert found[1:] == [["position", "velocity"], [], [], [], []]  # its velocity is counted in units of position
    assert "velocity" in found[0]


def test_a_rated_torque_that_is_off_is_refused_at_the_start():
    arm, true = arm_with("six-cia402", {2: ("torque", 1.15)}), load_arm("six-cia402")
    with Link(arm, LockStepBus(arm=SimulatedArm(true, Truth.of(true)))) as link, pytest.raises(BadInput, match="6076h"):
        link.start()


def test_the_law_of_gains_takes_the_command_of_the_sample_before():
    found = {each.text: each.ratio for each in law_evidence(track(noise=0.005))}
    assert len(found) == 2
    assert all(ratio == pytest.approx(1.0, abs=0.01) for ratio in found.values()), found
