"""Choice of creep sweeps: poses of the other joints that leave the torque constants least uncertain."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.estimate.posterior import invert
from gcomp.identify.motor_model import MotorDoubt, MotorModel, family_slices
from gcomp.identify.readings import StaticReadings

SCATTER_SHARE = 0.003
"""Scatter of a row, as a share of rated torque, that the choice assumes."""
BINS = 10
"""Rows per direction with which a candidate is judged."""


@dataclass(frozen=True, eq=False)
class CreepCandidate:
    """One creep: the other joints' poses, and both ends of the joint's way."""

    joint: int
    rest: Array
    """(n,) [rad]; the creeping joint's entry is not used."""
    lower: float
    """[rad]."""
    upper: float
    """[rad]."""

    def poses(self, count: int) -> Array:
        """Poses along the way (count, n) [rad]."""
        poses = np.tile(self.rest, (count, 1))
        poses[:, self.joint] = np.linspace(self.lower, self.upper, count)
        return poses


def choose(
    arm: Arm, beta: Array, rated: Array, candidates: list[list[CreepCandidate]], count: int, speeds: tuple[float, ...],
    mass: float, doubt: MotorDoubt,
) -> tuple[list[list[CreepCandidate]], Array]:  # fmt: skip
    """(`count` candidates of each list, tip to base; standard deviations of the gains that they promise (n,)).

    Greedy: each choice makes the sum of the gains' variances least, with one pass without and one with the mass [kg].
    beta (2n,) [kg·m] is a guess of the mass moments.
    """
    mean, std = doubt.prior(arm, rated, True, 0.02 * rated)
    x, at = mean.copy(), family_slices(arm.n)
    x[at["beta"]], x[at["coulomb"]], x[at["load"]] = beta, 0.02 * rated, 0.05
    information = np.diag(1 / std**2)
    rows = [[_information(arm, x, one, speeds[0], mass, rated) for one in each] for each in candidates]
    chosen: list[list[CreepCandidate]] = [[] for _ in candidates]
    gains = at["gain"]
    for _ in range(count):
        for place, each in enumerate(candidates):
            costs = [float(np.diag(invert(information + one))[gains].sum()) for one in rows[place]]
            best = int(np.argmin(costs))
            information = information + rows[place][best]
            chosen[place].append(each[best])
    return chosen, np.sqrt(np.diag(invert(information))[gains])


def _information(arm: Arm, x: Array, one: CreepCandidate, speed: float, mass: float, rated: Array) -> Array:
    """Information of a creep both ways, without and with the mass (P, P)."""
    poses = np.tile(one.poses(BINS), (4, 1))
    side, loads = np.repeat([1.0, -1.0, 1.0, -1.0], BINS), np.repeat([0.0, 0.0, mass, mass], BINS)
    own = np.arange(arm.n) == one.joint
    readings = StaticReadings(
        poses,
        np.where(own, 0.0, np.nan) * np.ones((len(poses), 1)),
        np.ones(arm.n),
        load=loads,
        velocity=np.outer(side * speed, own),
        warmth=np.outer(np.repeat([-10.0, -10.0, -5.0, -5.0], BINS), own),
    )
    _, jacobian = MotorModel(arm, readings).linearised(x)
    jacobian /= SCATTER_SHARE * rated[one.joint]
    information: Array = jacobian.T @ jacobian
    return information
