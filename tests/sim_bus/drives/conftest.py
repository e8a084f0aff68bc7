"""The pendulum that a file's client operates."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from serving import Served, served


@pytest.fixture
def arm(request: pytest.FixtureRequest) -> Iterator[Served]:
    """It has the drive that the test's file states as DRIVE."""
    with served(request.module.DRIVE) as arm:
        yield arm
