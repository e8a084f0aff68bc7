"""Recorded runs through the observer, against the references beside them; a change of output shows as a difference.

Where the change is meant: python tests/calib/replay.py --write, and read the difference before committing it.
"""

import difflib
import re

import pytest
from replay import FOLDER, RUNS, replay

NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")
NEAR = 1.1e-4
"""Relative difference of a number whose fifth digit was rounded the other way."""


def same(ours: str, theirs: str) -> bool:
    if NUMBER.sub("#", ours) != NUMBER.sub("#", theirs):
        return False
    pairs = zip(NUMBER.findall(ours), NUMBER.findall(theirs), strict=True)
    return all(abs(float(a) - float(b)) <= NEAR * abs(float(b)) + 1e-9 for a, b in pairs)


@pytest.mark.parametrize("name", RUNS)
def test_a_recorded_run_gives_what_it_gave(name: str) -> None:
    found = replay(name)
    reference = (FOLDER / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    if len(found) != len(reference) or not all(map(same, found, reference)):
        pytest.fail("\n".join(difflib.unified_diff(reference, found, "reference", "now", lineterm="", n=0)))


def test_the_comparison_sees_what_matters() -> None:
    assert same("60.10 alarm joint_3 {x: 1.00001}", "60.10 alarm joint_3 {x: 1.00002}")
    assert not same("60.10 alarm joint_3 {x: 1.001}", "60.10 alarm joint_3 {x: 1.002}")
    assert not same("60.10 alarm joint_3 {x: 1}", "60.10 alarm joint_4 {x: 1}")
