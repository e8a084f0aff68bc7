"""Arm files, and a tiny lock-step arm: nodes that answer from a dictionary and follow their targets."""

import sys
from pathlib import Path

import pytest

from armlink.link.link import Link

sys.path.insert(0, str(Path(__file__).parent))
from fake_joints import FakeBus, make_arm


@pytest.fixture
def arm_of():
    """Makes an arm of n joints, nodes 1 to n, at 250 Hz; `link` and `joint` are further keys of the arm file."""
    return make_arm


@pytest.fixture
def bus():
    """Three nodes in lock-step."""
    return FakeBus(range(1, 4))


@pytest.fixture
def link(bus):
    """A link to the three nodes; not started."""
    with Link(make_arm(), bus) as link:
        yield link


@pytest.fixture
def enabled(link):
    """A link whose joints are enabled."""
    link.start()
    link.enable()
    return link


@pytest.fixture
def relinked(bus):
    """A started link to joints that hold in quick stop, as the one before it left them."""
    with Link(make_arm(), bus) as link:
        link.start()
        link.enable()
    with Link(make_arm(), bus) as link:
        link.start()
        yield link
