"""The paper's arm for the observer's tests, from the numbers of docs/theory.md, sections 3 and 8."""

import sys
from pathlib import Path

import numpy as np
import pytest

from calib.records.store import RecordStore
from gcomp.arm.arm import Arm

sys.path.insert(0, str(Path(__file__).parent))
from fake_controllers import ARM, record
from paper_arm import BETA, NAMES


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


@pytest.fixture
def store(tmp_path: Path) -> RecordStore:
    """With the record that the fake controllers hold; files that need another one make their own."""
    store = RecordStore(str(tmp_path / "records.db"))
    store.put(record(), ARM, by="ann", reason="sweep")
    return store
