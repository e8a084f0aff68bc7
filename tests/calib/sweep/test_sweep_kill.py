"""A sweep killed and resumed: a few kills of the campaign's two hundred."""

from pathlib import Path

import pytest
from loaded_campaign import campaign


@pytest.mark.long
@pytest.mark.parametrize("kills", [1, 3])
def test_kills_leave_the_data_of_a_sweep_left_alone(tmp_path: Path, kills: int) -> None:
    made, _, wrong, scores = campaign("kill_sweep").campaign(kills, 5, tmp_path)
    assert made == kills
    assert wrong == []
    assert float((scores**2).mean() ** 0.5) < 2.0
