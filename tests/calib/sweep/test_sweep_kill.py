"""A sweep killed and resumed: three kills of the campaign's two hundred."""

from pathlib import Path

from loaded_campaign import campaign


def test_three_kills_leave_the_data_of_a_sweep_left_alone(tmp_path: Path) -> None:
    made, _, wrong, scores = campaign("kill_sweep").campaign(3, 5, tmp_path)
    assert made == 3
    assert wrong == []
    assert float((scores**2).mean() ** 0.5) < 2.0
