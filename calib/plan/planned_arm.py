"""An arm as plans need it: ranges of the joints, surroundings, and the torques that hold it, press it and move it."""

from functools import cached_property
from typing import Self

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.plan.collisions import Geometry
from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import Candidates
from calib.plan.types import APPROACH
from gcomp.arrays import Array, Mask

COLLIDING = (
    "almost every pose within the joint ranges collides: correct the collision shapes of the model, or narrow lower "
    "and upper in the arm file"
)
"""Message of a plan without free poses."""
SLOWEST = 0.3
"""Acceleration that every planned sweep must allow [rad/s²]: a step of 0.5 rad then takes 2.6 s; a choice."""
FASTEST = 2.0
"""Largest acceleration between sweeps, and between poses of a verification [rad/s²]; a choice, swept in
tests/campaigns/random_arms.py."""
TRIES = 200
"""Random poses that are tried for each one that is wanted."""


class PlannedArm:
    """Of an arm file, with a rough gravity model where something is known of the masses."""

    def __init__(self, arm_file: ArmFile, guess: GravityGuess | None = None) -> None:
        self.arm_file, self.guess = arm_file, guess
        self.arm, self.section, self.limits = gcomp_arm(arm_file), sweep_section(arm_file), DriveLimits.of(arm_file)

    @cached_property
    def geometry(self) -> Geometry | None:
        """The model's bodies, for collisions; None if the arm file has no model with shapes. Raises BadInput."""
        if self.arm_file.model_path is None:
            return None
        geometry = Geometry(self.arm_file)
        return geometry if geometry.model.ngeom else None

    # ---- poses

    def sweep_range(self, joint: int) -> tuple[float, float]:
        """First and last step [rad], with room to approach them, more at large angles as the gain is unknown."""
        low, high = float(self.limits.lower[joint]), float(self.limits.upper[joint])
        margin = max(self.section.range_margin, APPROACH)
        return low + margin + 0.02 * abs(low), high - margin - 0.02 * abs(high)

    @property
    def ends(self) -> tuple[Array, Array]:
        """Lower and upper ends of the joints' ways (n,) [rad]."""
        low, high = np.array([self.sweep_range(joint) for joint in range(self.arm.n)]).T
        return low, high

    def require_range(self) -> Self:
        """This arm; raises BadInput, naming the joint, if a range leaves nothing to sweep."""
        for joint, name in enumerate(self.arm.names):
            first, last = self.sweep_range(joint)
            if not np.isfinite([first, last]).all() or last - first < 0.2:
                low, high = self.limits.lower[joint], self.limits.upper[joint]
                raise BadInput(
                    f"{name}: of its range {low:g} to {high:g} rad only {last - first:.2f} rad are left to sweep, at "
                    f"least 0.2 rad are needed. At each end range_margin ({self.section.range_margin:g} rad) and 2 % "
                    "are left out: check lower and upper, or reduce range_margin"
                )
        return self

    def drawn_poses(self, count: int, random: np.random.Generator) -> Array:
        """Poses (count, n) [rad] all over the range that sweeps have."""
        return random.uniform(*self.ends, (count, self.arm.n))

    def free_poses(self, fewest: int, random: np.random.Generator) -> Array:
        """Drawn poses (P, n) [rad] in which no bodies touch; raises BadInput if too few remain."""
        poses = self.drawn_poses(300, random)
        poses = poses[self.free(poses)]
        if len(poses) < fewest:
            raise BadInput(COLLIDING)
        return poses

    def free(self, poses: Array) -> Mask:
        """Poses (K, n) [rad] in which no bodies touch (K,)."""
        return np.ones(len(poses), dtype=bool) if self.geometry is None else self.geometry.free(poses)

    def is_clear(self, begin: Array, end: Array) -> bool:
        """Whether nothing touches on the straight way between two poses (n,) [rad]."""
        return self.geometry is None or not any(touching for _, touching in self.geometry.way(begin, end))

    def reachable_poses(
        self, count: int, random: np.random.Generator, begin: Array, reach: float = np.inf, about: float = 0.0
    ) -> Array:
        """Random poses (P, n) [rad] about which, by so much [rad], nothing touches, each reached straight from the one
        before, the first from `begin` (n,), no joint moving more than `reach` [rad]; there are `count` unless the arm
        reaches fewer. Raises Refused where it reaches none."""
        lower, upper = self.ends
        here, found = begin, list[Array]()
        for _ in range(TRIES * count):
            if len(found) == count:
                break
            pose: Array = random.uniform(*np.clip([here - reach, here + reach], lower + about, upper - about))
            if self.is_clear(pose - about, pose + about) and self.is_clear(here, pose):
                found.append(pose)
                here = pose
        if count and not found:
            touching = self.geometry.contacts(begin) if self.geometry is not None else []
            bodies = " and ".join(touching[0].bodies) if touching else "none"
            raise Refused(
                f"{self.arm_file.name}: the arm reaches no pose from its present pose without a collision of the "
                f"model's shapes (touching now: {bodies}): move the arm clear, or correct the shapes"
            )
        return np.array(found).reshape(-1, self.arm.n)

    # ---- torques, by the rough gravity model

    @property
    def _known(self) -> GravityGuess:
        assert self.guess is not None
        return self.guess

    def hold_torque(self, poses: Array) -> tuple[Array, Array, Array]:
        """(Least, largest, allowance) holding torque (C, n) [N·m] along candidate sweeps with poses (C, S, n).

        The allowance covers the rough model's error, the torque scale and friction, but not the margin.
        """
        torque = self._known.torque(poses)
        doubt = (self._known.uncertainty(poses) + self.section.gain_tolerance * np.abs(torque)).max(axis=1)
        return torque.min(axis=1), torque.max(axis=1), doubt + self.section.friction * self.limits.rated

    def required_bias(self, candidates: Candidates) -> Array:
        """Size of the torque (C, n) [N·m] that keeps each resting joint pressed along candidate sweeps; 0 if swept."""
        least, largest, allowance = self.hold_torque(candidates.poses)
        against = np.where(candidates.stops > 0, largest, -least)
        margin = self.section.bias_margin * self.limits.max_torque
        floor = margin + self.section.friction * self.limits.rated
        return np.where(candidates.stops == 0, 0.0, np.maximum(against + allowance + margin, floor))

    @property
    def given_bias(self) -> Array:
        """Torque that may press each joint on its stop (n,) [N·m]: the arm file's, else what the drives have."""
        given = self.section.bias_torque
        return self.limits.max_torque if given is None else np.array(given)

    def pressable_joints(self, candidates: Candidates) -> Mask:
        """Resting joints (C, n) that can be pressed on their stop within max_torque; True for the swept joint."""
        needed = self.required_bias(candidates) + SLOWEST * self.reaction_bound(candidates.joint)
        within = needed <= np.minimum(self.given_bias, self.limits.max_torque)
        return np.asarray(within | (candidates.stops == 0))

    def reaction_bound(self, joint: int) -> Array:
        """Bound of the torque (n,) [N·m] at every joint per rad/s² of the swept one: √(M_ii M_jj)."""
        inertia = self._known.inertia()
        return np.asarray(np.sqrt(inertia * inertia[joint]))

    def travel_acceleration(self, poses: Array) -> float:
        """Acceleration [rad/s²] that the drives have beyond gravity at the poses (K, n) between which they travel."""
        if self.guess is None:
            return 1.0
        spare = self.limits.max_torque - np.abs(self.guess.torque(poses)).max(axis=0)
        return float(np.clip(np.min(spare / np.maximum(2 * self.guess.inertia(), 1e-9)), SLOWEST, FASTEST))


def nearest_first(poses: Array, begin: Array) -> list[int]:
    """The places of poses (K, n) [rad], each followed by the nearest of the remaining ones, from `begin` (n,) on."""
    left, way = list(range(len(poses))), []
    here = begin
    while left:
        nearest = min(left, key=lambda k: float(np.abs(poses[k] - here).max()))
        left.remove(nearest)
        way.append(nearest)
        here = poses[nearest]
    return way
