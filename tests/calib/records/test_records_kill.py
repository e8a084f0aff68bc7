"""A process killed anywhere in a record write or controller write: three kills of the campaign's two hundred."""

import importlib.util
import sys
from pathlib import Path

CAMPAIGN = Path(__file__).parents[2] / "campaigns" / "kill_records.py"


def test_three_kills_tear_and_lose_nothing(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("kill_records", CAMPAIGN)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kill_records"] = module
    spec.loader.exec_module(module)
    records, _, wrong = module.campaign(str(tmp_path / "records.db"), tmp_path, 3, seed=5)
    assert wrong == []
    assert records > 0
