"""A process killed anywhere in a record write or controller write: three kills of the campaign's two hundred."""

from pathlib import Path

from loaded_campaign import campaign


def test_three_kills_tear_and_lose_nothing(tmp_path: Path) -> None:
    records, _, wrong = campaign("kill_records").campaign(str(tmp_path / "records.db"), tmp_path, 3, seed=5)
    assert wrong == []
    assert records > 0
