"""The compromised program and its joints, shared by the tests here and a campaign."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
