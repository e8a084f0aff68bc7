"""Why drives do not come into a state: what is said where nothing else explains it."""

from types import SimpleNamespace

import pytest

from armlink.drives.orders import Power
from armlink.link import cycle
from armlink.link.cycle import ENABLE_SECONDS, Commander


@pytest.mark.parametrize(
    ("power", "ready", "says"),
    [
        (Power.ON, True, f"in {ENABLE_SECONDS} s, no cycle had the readings of all joints: frames are lost"),
        (Power.ON, False, "joint 0 is stuck"),
        (Power.OFF, True, "joint 0 is stuck"),
    ],
)
def test_where_no_drive_is_stuck_frames_are_lost(power, ready, says, monkeypatch):
    monkeypatch.setattr(cycle, "bus_fault", lambda names, watch, since: "")
    drives = SimpleNamespace(
        power=lambda drive: power,
        ready=lambda drive: ready,
        stuck=lambda drive, target, seconds: f"joint {drive} is stuck",
    )
    commander = SimpleNamespace(names=("a",), loop=SimpleNamespace(watch=None, groups=()), _drives=((drives, 0),))
    assert Commander._stuck(commander, Power.ON) == says
