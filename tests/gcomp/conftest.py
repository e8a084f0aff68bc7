"""Fixtures of gcomp's tests; gravity_rig.py beside it has the arms and the independent model."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))  # importlib mode leaves this folder out

from gravity_rig import SARCOS_MOMENTS, Built, bar_moments, make_random_arm, make_sarcos

from gcomp.arm.arm import Arm
from gcomp.arrays import Array


@pytest.fixture
def sarcos() -> Arm:
    return make_sarcos()


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(request.node.name.encode()[-6:], "big"))


@pytest.fixture
def sarcos_moments() -> Array:
    return bar_moments(make_sarcos(), SARCOS_MOMENTS)


@pytest.fixture
def random_arm() -> Callable[..., Built]:
    return make_random_arm
