"""How well the variances of a fit are known themselves."""

from types import SimpleNamespace

import numpy as np

from calib.fit.refinement import _certainty
from calib.fit.small_troubles import FAMILIES


def test_a_parameter_that_one_joint_s_readings_tell_has_their_degrees_of_freedom():
    """Without random effects the variance is known as well as the noise of the readings that the parameter hangs on."""
    joint = np.repeat([0, 1], [12, 30])
    design = np.zeros((42, 3))
    random = np.random.default_rng(1)
    design[joint == 0, 0] = random.normal(size=12)
    design[joint == 1, 1] = random.normal(size=30)
    design[:, 2] = random.normal(size=42)
    covariance = np.linalg.inv(design.T @ design)
    nothing = np.zeros((len(FAMILIES), len(FAMILIES)))
    linear = SimpleNamespace(
        joint=joint,
        precision=np.eye(42),
        design=design,
        effects=np.zeros((42, 0)),
        levels=SimpleNamespace(covariance=nothing),
        troubles=SimpleNamespace(family=np.zeros(0, int)),
    )
    free = np.array([9.0, 25.0])
    alone = SimpleNamespace(**vars(linear) | {"design": design[:, :2]})
    np.testing.assert_allclose(_certainty(alone, np.linalg.inv(design[:, :2].T @ design[:, :2]), free), free)
    mixed = _certainty(linear, covariance, free)[2]
    assert free.max() < mixed < free.sum()  # two independent variances, each known by its own readings
