"""The drawing of a plan: where its stick figures have their joints."""

import numpy as np
import pytest
from sweep_arms import random_arm

from calib.arm.kinematics import gcomp_arm
from calib.plan.drawing import frame_origins


def denavit_hartenberg(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """Standard transform of one joint, (4, 4): about z, along z, along x, about x."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])


@pytest.mark.parametrize("seed", range(3))
def test_frames_are_where_the_transforms_of_the_joints_put_them(seed):
    arm = gcomp_arm(random_arm(seed, 5))
    assert np.abs(arm.d).max() > 0
    assert np.abs(arm.a).max() > 0
    q = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (4, arm.n))
    for pose, places in zip(q, frame_origins(arm, q), strict=True):
        frame, expected = np.eye(4), [np.zeros(3)]
        for j in range(arm.n):
            frame = frame @ denavit_hartenberg(pose[j] + arm.theta_offset[j], arm.d[j], arm.a[j], arm.alpha[j])
            expected.append(frame[:3, 3])
        np.testing.assert_allclose(places, expected, atol=1e-12)
