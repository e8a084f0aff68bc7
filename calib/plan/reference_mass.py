"""Reference masses that suit an arm and its drives."""

import numpy as np

from calib.arm.drive_limits import Limits
from calib.plan.choices import ASSUMED_GRAVITY, HAND, MASS_SHARES
from calib.plan.rough_gravity import GravityGuess, reach
from calib.plan.stop_selection import Candidates
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_regressor


def reference_masses(
    kinematics: Arm, limits: Limits, options: list[Candidates], guess: GravityGuess | None
) -> list[float]:
    """Masses [kg] that take `MASS_SHARES` of the torque left at the joint that they load most, to two digits."""
    poses = np.concatenate([each.poses.reshape(-1, kinematics.n) for each in options])
    regressor = gravity_regressor(kinematics, poses)
    at_origin, by_point = payload_columns(kinematics)
    flange = np.array([kinematics.a[-1], 0.0, kinematics.d[-1]])
    per_kg = np.abs(regressor @ (at_origin + by_point @ flange))
    per_kg += HAND * np.linalg.norm(regressor @ by_point, axis=-1)
    gravity = ASSUMED_GRAVITY * limits.max_torque if guess is None else np.abs(guess.torque(poses)).max(axis=0)
    room = np.maximum(limits.max_torque - gravity, 0.05 * limits.max_torque)
    most = float(np.min(room / np.maximum(per_kg.max(axis=0), 1e-9)))
    most = min(most, 2 * float(limits.rated.max()) / (9.81 * float(reach(kinematics)[0])))
    return [float(f"{share * most:.2g}") for share in MASS_SHARES]
