"""Hard cases through the real sweep, cheaply: two joints, few steps, no mass. The campaign does them fully."""

from pathlib import Path

import numpy as np
import pytest
from hard_cases import Outcome, hard_arm, judge, sweep_case

SEED = {"range": 1, "slip": 7, "encoder": 1, "vertical": 3}


@pytest.mark.parametrize("case", SEED)
def test_a_hard_case_is_named_or_stays_within_its_intervals(case: str, tmp_path: Path) -> None:
    arm, simulated = hard_arm(case, SEED[case], 2, steps=5, poses=1, max_samples=30, gain_std=0.5)
    swept = sweep_case(case, arm, simulated, tmp_path, loaded=False)
    outcome = judge(swept)
    assert outcome.wrong == ()
    _CHECKS[case](outcome, swept.slips)


def _intervals_hold(outcome: Outcome, slips: int) -> None:
    assert outcome.named == ()
    assert len(outcome.scores) >= 2
    assert slips == 0


def _pressed_again(outcome: Outcome, slips: int) -> None:
    assert slips > 0
    assert outcome.named == ()


def _bit_named(outcome: Outcome, _: int) -> None:
    assert outcome.named == ("j2",)
    assert any("bit 7 of the position reading" in finding.text for finding in outcome.fit.findings)


def _said_not_to_be_felt(outcome: Outcome, _: int) -> None:
    assert "gravity does not act" in outcome.fit.reasons["j1", "gain"]
    assert np.isfinite(outcome.fit.value("offset")[0])


_CHECKS = {
    "range": _intervals_hold,
    "slip": _pressed_again,
    "encoder": _bit_named,
    "vertical": _said_not_to_be_felt,
}
