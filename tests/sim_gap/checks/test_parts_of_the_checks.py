"""Single figures of the checks before a diagnosis: sample times, correlations, units."""

from types import SimpleNamespace

import numpy as np
import pytest

from armlink.recording.corrections import Corrections
from sim_gap.checks.positions import _degrees
from sim_gap.checks.sampling import _sample_times

NOTHING_STATED = Corrections()


@pytest.mark.parametrize("missing", [0, 1, 3, 60, 400])
@pytest.mark.parametrize("at", [100, 300, 600])
def test_times_of_receipt_scatter_about_even_ones_whose_gaps_stay(missing: int, at: int) -> None:
    """A hundred rows a second, received within some milliseconds, of which some are missing in a row."""
    number = np.concatenate([np.arange(at), np.arange(at + missing, 700 + missing)])
    stamps = 0.01 * number + 0.002 * np.random.default_rng(1).standard_normal(len(number))
    even = _sample_times(np.sort(stamps))
    assert even is not None
    np.testing.assert_allclose(even, 0.01 * number, atol=1e-3)


def test_every_gap_is_kept() -> None:
    number = np.delete(np.arange(1000), [*range(200, 203), *range(240, 242), *range(500, 560), *range(900, 901)])
    stamps = 0.01 * number + 0.002 * np.random.default_rng(1).standard_normal(len(number))
    even = _sample_times(np.sort(stamps))
    assert even is not None
    np.testing.assert_allclose(even, 0.01 * number, atol=1e-3)


def test_a_clock_that_changes_its_rate_has_no_even_times() -> None:
    number = np.arange(700)
    stamps = np.where(number < 350, 0.01 * number, 3.5 + 0.011 * (number - 350))
    assert _sample_times(stamps + 1e-4 * np.random.default_rng(1).standard_normal(700)) is None


def test_the_option_for_degrees_names_what_was_recorded() -> None:
    there = np.zeros((1, 1))
    for velocity, command, option in (
        (None, None, "--units q=deg"),
        (there, None, "--units q=deg,dq=deg"),
        (there, there, "--units q=deg,dq=deg,q_cmd=deg"),
    ):
        assert _degrees(SimpleNamespace(velocity=velocity, position_command=command)) == option
