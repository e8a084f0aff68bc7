"""The seam between link and drives: nothing but the CANopen family and the simulated arm speaks of PDOs or 2100h.

Imports are a contract of import-linter; here are the words, docstrings and messages included.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
WORDS = re.compile(r"\b[RT]PDO\d?\b|\b2100h|\b0x2100\b|\b60[0-9A-F]{2}h\b|\bstatus word|\bcontrol word", re.IGNORECASE)
SPEAKS = ("armlink/drives/canopen", "sim_bus")
MAY = {
    "armlink/arm_file.py",  # the keys node, identity and eds are CANopen's
    "armlink/guard/bus_guard.py",
}


def test_nothing_else_speaks_canopen():
    found = {}
    for package in ("armlink", "calib", "gcomp", "sim_gap"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if name.startswith(SPEAKS) or name in MAY:
                continue
            lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if WORDS.search(line)]
            if lines:
                found[name] = lines
    assert found == {}
