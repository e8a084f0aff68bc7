"""Poses of a plan: range of each sweep, poses of the scout, and an order of poses with little travel."""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import SweepSection, sweep_section
from calib.plan.collisions import Geometry
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.design.selection import select
from gcomp.gravity.torque import gravity_regressor

UNKNOWN = 1e-6
"""Prior information on each parameter: negligible, but it keeps the first poses' matrices regular."""
Poses = tuple[tuple[float, ...], ...]
"""(P, n) [rad]"""


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
            raise BadInput("almost every pose within the joint ranges collides: narrow lower and upper in the arm file")
    regressor = gravity_regressor(kinematics, poses)
    offsets = np.broadcast_to(np.eye(n), (len(poses), n, n))
    rows = np.concatenate([regressor, 10 * offsets], axis=2) / limits.rated[:, None]
    information = np.einsum("kip,kiq->kpq", rows, rows)
    (chosen,) = select([information[None]], UNKNOWN * np.eye(3 * n)[None], [n + 3], exchanges=0)
    return tuple(tuple(pose.tolist()) for pose in nearest_first(poses[chosen], ends.mean(axis=1)))


def weighing_poses(arm_file: ArmFile, count: int, seed: int, begin: Array) -> Array:
    """Poses (P, n) [rad] that tell a payload's mass and place best (D-optimal), in an order with little travel.

    Where the arm file has geometry, poses in which bodies touch are left out.
    """
    kinematics, limits, section = gcomp_arm(arm_file), DriveLimits.of(arm_file), sweep_section(arm_file)
    ends = np.array([sweep_range(section, limits, joint) for joint in range(kinematics.n)])
    poses = ends[:, 0] + np.random.default_rng([seed, 8]).random((300, kinematics.n)) * (ends[:, 1] - ends[:, 0])
    if arm_file.model_path is not None:
        poses = poses[Geometry(arm_file).free(poses)]
        if len(poses) < count:
            raise BadInput("almost every pose within the joint ranges collides: narrow lower and upper in the arm file")
    columns = gravity_regressor(kinematics, poses) @ np.column_stack(payload_columns(kinematics))
    rows = np.concatenate([columns, np.broadcast_to(np.eye(kinematics.n), (*columns.shape[:2], kinematics.n))], axis=2)
    rows = rows / limits.rated[:, None]
    information = np.einsum("kip,kiq->kpq", rows, rows)
    (chosen,) = select([information[None]], UNKNOWN * np.eye(rows.shape[2])[None], [count], exchanges=0)
    return nearest_first(poses[chosen], begin)


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
                f"joint {name}: range_margin {section.range_margin} rad leaves nothing of its range "
                f"{limits.lower[joint]} to {limits.upper[joint]} rad to sweep: check lower and upper, or "
                "reduce range_margin"
            )
