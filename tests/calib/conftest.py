"""The paper's arm for the observer's tests, from the numbers of theory.md sections 3 and 8."""

import sys
from pathlib import Path

import numpy as np
import pytest

from gcomp.arm import Arm

sys.path.insert(0, str(Path(__file__).parent))

NAMES = tuple(f"joint_{i}" for i in range(1, 8))
BETA = (
    0.1116,
    -0.9594,
    -0.1063,
    -4.6877,
    0.1256,
    -1.0284,
    0.0437,
    1.5219,
    0.0376,
    0.0871,
    -0.0217,
    0.6686,
    0.1132,
    -0.0594,
)


@pytest.fixture(scope="session")
def sarcos() -> Arm:
    return Arm(
        names=NAMES,
        alpha=np.radians([-90, -90, 90, 90, -90, 90, 0]),
        a=np.zeros(7),
        d=np.array([0, 0, -0.4, 0, -0.25, 0, -0.4]),
        theta_offset=np.zeros(7),
        gravity=np.array([9.81, 0, 0]),
        lower=np.radians([-50, -110, -95, 55, -100, -65, -60]),
        upper=np.radians([110, 30, 95, 170, 100, 65, 60]),
    )


@pytest.fixture(scope="session")
def sarcos_beta() -> np.ndarray:
    return np.array(BETA)
