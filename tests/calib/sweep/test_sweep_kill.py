"""A sweep killed and resumed: three kills of the campaign's two hundred."""

import importlib.util
import sys
from pathlib import Path

CAMPAIGN = Path(__file__).parents[2] / "campaigns" / "kill_sweep.py"


def test_three_kills_leave_the_data_of_a_sweep_left_alone(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("kill_sweep", CAMPAIGN)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kill_sweep"] = module
    spec.loader.exec_module(module)
    made, _, wrong, scores = module.campaign(3, 5, tmp_path)
    assert made == 3
    assert wrong == []
    assert float((scores**2).mean() ** 0.5) < 2.0
