"""Cosines and sines of many joint angles from tan(θ/2): numpy's tan is vectorised, its sin is not."""

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array


def half_angles(arm: Arm, q: Array, tangent: Array, double: Array) -> None:
    """At poses q (K, n) [rad]: t = tan(θ/2) into `tangent` (n, K), 2/(1 + t²) into `double` (n, K).

    Then cos θ = double − 1 and sin θ = tangent · double.
    """
    np.multiply(q.T, 0.5, out=tangent)
    if arm.theta_offset.any():
        np.add(tangent, 0.5 * arm.theta_offset[:, None], out=tangent)
    np.tan(tangent, out=tangent)
    np.multiply(tangent, tangent, out=double)
    np.add(double, 1.0, out=double)
    np.divide(2.0, double, out=double)
