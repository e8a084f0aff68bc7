"""Poses of a plan: range of each sweep, poses of the scout, and an order of poses with little travel."""

import numpy as np

from armlink.errors import BadInput
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import SweepSection
from calib.plan.collisions import Geometry
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.design.selection import select
from gcomp.gravity.torque import gravity_regressor

UNKNOWN = 1e-6
"""Prior information on each parameter: negligible, but it keeps the first poses' matrices regular."""
Poses = tuple[tuple[float, ...], ...]
"""(P, n) [rad]"""

COLLIDING = (
    "almost every pose within the joint ranges collides: correct the collision shapes of the model, or narrow lower "
    "and upper in the arm file"
)
"""Message of a plan without free poses."""


def sweep_range(section: SweepSection, limits: DriveLimits, joint: int) -> tuple[float, float]:
    """First and last step [rad] of a joint; the margin grows with the angle, since the position gain is unknown."""
    low, high = float(limits.lower[joint]), float(limits.upper[joint])
    margin = section.range_margin
    return low + margin + 0.02 * abs(low), high - margin - 0.02 * abs(high)


def scout_poses(
    kinematics: Arm,
    section: SweepSection,
    limits: DriveLimits,
    seed: int,
    geometry: Geometry | None = None,
) -> Poses:
    """n + 3 poses that determine mass moments and sensor offsets well, in an order with little travel.

    Poses in which bodies of `geometry` touch are left out; raises BadInput if too few remain.
    """
    n = kinematics.n
    ends = np.array([sweep_range(section, limits, joint) for joint in range(n)])
    generator = np.random.default_rng(seed)
    poses = ends[:, 0] + generator.random((300, n)) * (ends[:, 1] - ends[:, 0])
    if geometry is not None:
        poses = poses[geometry.free(poses)]
        if len(poses) < 2 * (n + 3):
            raise BadInput(COLLIDING)
    regressor = gravity_regressor(kinematics, poses)
    offsets = np.broadcast_to(np.eye(n), (len(poses), n, n))
    rows = np.concatenate([regressor, 10 * offsets], axis=2) / limits.rated[:, None]
    information = np.einsum("kip,kiq->kpq", rows, rows)
    (chosen,) = select([information[None]], UNKNOWN * np.eye(3 * n)[None], [n + 3], exchanges=0)
    return tuple(tuple(pose.tolist()) for pose in nearest_first(poses[chosen], ends.mean(axis=1)))


def nearest_first(poses: Array, begin: Array) -> Array:
    """The same poses (K, n) [rad], each followed by the nearest of the remaining ones, from `begin` (n,) on."""
    left, way = list(range(len(poses))), []
    here = begin
    while left:
        nearest = min(left, key=lambda k: float(np.abs(poses[k] - here).max()))
        left.remove(nearest)
        way.append(nearest)
        here = poses[nearest]
    return poses[way]


def require_range(section: SweepSection, limits: DriveLimits, kinematics: Arm) -> None:
    """Raise BadInput, naming the joint, if a range leaves nothing to sweep."""
    for joint, name in enumerate(kinematics.names):
        first, last = sweep_range(section, limits, joint)
        if not np.isfinite([first, last]).all() or last - first < 0.2:
            raise BadInput(
                f"{name}: of its range {limits.lower[joint]:g} to {limits.upper[joint]:g} rad, {last - first:.2f} rad "
                f"are left to sweep after range_margin ({section.range_margin:g} rad) and 2 % at each end, at least "
                "0.2 rad are needed: check lower and upper, or reduce range_margin"
            )
