"""Drives that keep on when their host falls silent: the check names them, and drives none of the joints."""

from types import SimpleNamespace

import pytest

from armlink.selftest import self_test
from armlink.selftest.self_test import SelfTest


@pytest.mark.parametrize(
    ("silence", "says"),
    [
        (("stops", "stops"), ""),
        (("stops", "keeps on"), "b is not driven: it would keep on after its host died"),
        (("keeps on", "keeps on"), "a is not driven: it would keep on after its host died"),
    ],
)
def test_no_joint_is_driven_where_one_would_keep_on(silence, says, monkeypatch):
    traits = [SimpleNamespace(silence=each) for each in silence]
    monkeypatch.setattr(self_test, "traits_of", lambda groups: traits)
    results = [SimpleNamespace(joint="other", check="calibration")]
    test = SimpleNamespace(
        link=SimpleNamespace(names=("a", "b"), groups=(), n=2),
        results=results,
        _add=lambda name, check, outcome, found: results.append(SimpleNamespace(joint=name, check=check)),
    )
    assert SelfTest._watched(test) == says
    assert [each.joint for each in results[1:]] == [n for n, each in zip("ab", silence, strict=True) if "keeps" in each]
