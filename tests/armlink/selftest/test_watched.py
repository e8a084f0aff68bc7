"""Drives that keep on when their host falls silent: the check names them, and drives none of the joints."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from armlink.drives.findings import Checks
from armlink.drives.piper.drives import TRAITS
from armlink.selftest import self_test
from armlink.selftest.self_test import SelfTest


@pytest.mark.parametrize(
    ("silence", "says"),
    [
        (("falls", "damps"), ""),
        (("falls", "keeps on"), "b is not driven: if its host died, its drive would keep on with the last command"),
        (("keeps on", "keeps on"), "a is not driven: if its host died, its drive would keep on with the last command"),
    ],
)
def test_no_joint_is_driven_where_one_would_keep_on(silence, says, monkeypatch):
    traits = [replace(TRAITS, silence=each) for each in silence]
    monkeypatch.setattr(self_test, "traits_of", lambda groups: traits)
    checks = Checks()
    link = SimpleNamespace(names=("a", "b"), groups=(), n=2, section=SimpleNamespace(keeper=False))
    test = SimpleNamespace(link=link, checks=checks)
    assert SelfTest._watched(test) == says
    keeping = [name for name, each in zip("ab", silence, strict=True) if "keeps" in each]
    assert [(each.joint, each.check, each.outcome) for each in checks.results] == [
        (name, "silence", "failed") for name in keeping
    ]
    link.section.keeper = True
    assert SelfTest._watched(test) == ""
