"""The Grafana dashboard asks for metrics that the daemon has."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[4]


def test_every_metric_of_the_dashboard_is_on_the_page_of_metrics():
    panels = json.loads((ROOT / "packaging" / "grafana" / "armlink.json").read_text())["panels"]
    asked = {name for panel in panels for each in panel["targets"] for name in re.findall(r"armlink_\w+", each["expr"])}
    known = set(re.findall(r"armlink_\w+", (ROOT / "docs" / "daemon-api.md").read_text()))
    assert asked
    assert asked <= known
    places = [tuple(panel["gridPos"].values()) for panel in panels]
    assert len(set(places)) == len(places)
