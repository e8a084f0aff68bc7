"""Jumps of a position reading: an encoder's, and none where messages waited on their way."""

import numpy as np
import pytest

from armlink.link.types import Sample
from calib.motion.encoder_check import EncoderCheck, EncoderFault

PERIOD, SPEED, STEP = 0.004, 0.4, 1e-4


def seen(own_clock: bool, readings: list[tuple[float, float]]) -> None:
    """Judge (time it came [s], position [rad]) of one joint; NaN for a cycle in which none came."""
    check = EncoderCheck(("j",), np.array([STEP]), np.array([SPEED]), 0.0, np.array([own_clock]))
    before, nothing = np.zeros(1), np.full(1, np.nan)
    for t, position in readings:
        here = np.array([position])
        check.see(Sample(t, here, nothing, nothing, nothing, np.zeros(1, np.int64), np.zeros(1)), before)
        np.copyto(before, here, where=np.isfinite(here))


def moving(taken: list[float]) -> list[tuple[float, float]]:
    """A joint at its largest speed, read at these times in cycle after cycle."""
    return [((cycle + 1) * PERIOD, SPEED * t) for cycle, t in enumerate(taken)]


def test_readings_that_waited_together_are_no_jump_of_an_encoder():
    nothing = float("nan")
    waited = [0.004, 0.008, nothing, nothing, nothing, nothing, 0.012, 0.031, 0.036]
    seen(True, moving(waited))
    with pytest.raises(EncoderFault, match="jumped by"):
        seen(False, moving(waited))  # one that is asked tells where it is now


@pytest.mark.parametrize("own_clock", [True, False])
def test_a_jump_that_no_motion_makes_is_the_encoder_s(own_clock):
    steady = moving([0.004 * cycle for cycle in range(1, 8)])
    seen(own_clock, steady)
    t, position = steady[-1]
    with pytest.raises(EncoderFault, match="jumped by"):
        seen(own_clock, [*steady, (t + PERIOD, position + 128 * STEP)])
