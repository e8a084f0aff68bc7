"""Hard cases through the real sweep, cheaply: two joints, few steps, no mass. The campaign does them fully."""

from pathlib import Path

import numpy as np
import pytest
from hard_cases import Outcome, hard_arm, judge, stick, sweep_case

from calib.dataset import load_data
from calib.motion.encoder_check import EncoderFault

SEED = {"range": 1, "slip": 7, "vertical": 3}


@pytest.mark.long
@pytest.mark.parametrize("case", SEED)
def test_a_hard_case_is_named_or_stays_within_its_intervals(case: str, tmp_path: Path) -> None:
    arm, simulated = hard_arm(case, SEED[case], 2, steps=5, poses=1, max_samples=30, gain_std=0.5)
    swept = sweep_case(case, arm, simulated, tmp_path, loaded=False)
    outcome = judge(swept)
    assert outcome.wrong == ()
    settled = [reading.settled for reading in load_data(tmp_path / "bare").readings]
    assert np.mean(settled) > 0.9  # it reads as soon as the arm rests, not when its patience is at an end
    _CHECKS[case](outcome, swept.slips)


@pytest.mark.sample(1)
@pytest.mark.parametrize("bit", [8, 2, 5])
def test_a_stuck_bit_ends_the_sweep_before_anything_is_pressed(bit: int, tmp_path: Path) -> None:
    arm, simulated = hard_arm("sound", 1, 2, steps=5, poses=1, max_samples=30, gain_std=0.5)
    stick(simulated, bit)
    with pytest.raises(
        EncoderFault, match=rf"^j2: .*its position reading .*the encoder, since its bit {bit} is stuck or lost"
    ):
        sweep_case("encoder", arm, simulated, tmp_path, loaded=False)
    assert not any(reading.joint is not None for reading in load_data(tmp_path / "bare").readings)


def _intervals_hold(outcome: Outcome, slips: int) -> None:
    assert outcome.named == ()
    assert len(outcome.scores) >= 2
    assert slips == 0


def _pressed_again(outcome: Outcome, slips: int) -> None:
    assert slips > 0
    assert outcome.named == ()


def _said_not_to_be_felt(outcome: Outcome, _: int) -> None:
    assert "gravity does not act" in outcome.fit.reasons["j1", "gain"]
    assert np.isfinite(outcome.fit.value("offset")[0])


_CHECKS = {
    "range": _intervals_hold,
    "slip": _pressed_again,
    "vertical": _said_not_to_be_felt,
}
