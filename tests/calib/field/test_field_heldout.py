"""Rows of the field that are predicted by a fit without them."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.fit.field_fit import BLOCK, heldout_errors
from gcomp.identify.readings import StaticReadings


@pytest.mark.parametrize("count", [6 * BLOCK, 40])
def test_every_row_is_predicted_by_the_other_blocks_alone(count):
    """Blocks of rows take turns: those of the one turn read 1 N·m more, which only the other turn's line can show."""
    length = min(BLOCK, count // 6)
    turn = np.arange(count) // length % 2
    model = np.random.default_rng(0).uniform(-5, 5, (count, 2))
    shift = np.column_stack([turn, np.zeros(count)])
    rows = StaticReadings(np.zeros((count, 2)), 1.1 * model + 0.3 + shift, np.full(2, 0.01))
    fit = SimpleNamespace(torque=model, value=lambda parameter: np.array([1.1, 1.1]))
    before = SimpleNamespace(torque_calibration=lambda: SimpleNamespace(apply=lambda torque: torque))
    new, old = heldout_errors(rows, fit, before)
    np.testing.assert_allclose(new[:, 0], np.where(turn == 1, 1.0, -1.0), atol=1e-9)
    np.testing.assert_allclose(new[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(old, rows.torque - model)
