"""Size and length of what calibrated torque and gravity model still disagree by."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.fit import examination as module
from calib.fit.small_troubles import FAMILIES


def test_the_length_is_that_over_which_the_disagreement_of_two_poses_fades(sarcos, monkeypatch):
    """Of a squared-exponential kernel, whatever its size and whichever of the two poses knows it better."""
    n, length = sarcos.n, np.array([0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 9.0])
    level, level_near = np.linspace(0.01, 4.0, n), np.linspace(2.0, 0.04, n)
    alike = np.exp(-(module.APART**2) / (2 * length**2))
    moments = (level, level_near, alike * np.sqrt(level * level_near))
    seen = []
    monkeypatch.setattr(
        module, "_moments", lambda setting, rows, refined, poses, near: seen.append((poses, near)) or moments
    )
    gain = np.full(n, -2.0)
    levels = SimpleNamespace(level=np.zeros(len(FAMILIES)), freedom=np.full(n, 4.0))
    linear = SimpleNamespace(levels=levels)
    refined = SimpleNamespace(fit=SimpleNamespace(complete=SimpleNamespace(gain=gain)), linear=linear)
    found = module.remaining_doubt(SimpleNamespace(arm=sarcos, rated=np.ones(n)), None, refined)
    assert [each.length for each in found] == pytest.approx([*length[:-1], 4.99], rel=0.01)  # none longer is told
    assert [each.level for each in found] == pytest.approx(np.sqrt(level) / 2)
    assert [each.level_std for each in found] == pytest.approx(np.sqrt(level) / 2 / np.sqrt(2 * 4.0))
    ((poses, near),) = seen
    assert np.linalg.norm(near - poses, axis=1) == pytest.approx(module.APART)
