import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real recordings; a test that needs them is skipped where they are missing."""
    beside = Path(__file__).parents[3] / "shared" / "realdata"
    folder = Path(os.environ.get("ARMLINK_REALDATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is missing (set ARMLINK_REALDATA)")
    return folder
