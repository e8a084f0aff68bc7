"""Design of sweeps before anything moves: stops of the resting joints, steps (docs/theory.md, section 7.4)."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array
from gcomp.design.selection import Criterion, select, sweep_jacobian
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.global_fit import Prediction, predict_covariance
from gcomp.identify.parameters import Parameters, free_mask, natural_units
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import expected_readings

MINIMUM_LEVER = 0.3
"""Γ/g of the swept joint below which a combination is used only if none is better (docs/theory.md, section 2.5)."""
MOST_COMBINATIONS = 256
"""Combinations of stops that a design chooses from, at most: all of nine joints; time grows with them, and few are
chosen."""
SKETCH_STEPS = 7
"""Steps by which a candidate sweep is judged: more than a sinusoid's three unknowns (docs/theory.md, section 5.3)."""


@dataclass(frozen=True, eq=False)
class JointSweep:
    """Joint `joint` moves through `angles` (K,) [rad] while the others rest as in `pose` (n,) [rad]."""

    joint: int
    pose: Array
    angles: Array

    def stepped(self, steps: int) -> Array:
        """`steps` even angles over the same range."""
        return np.linspace(self.angles[0], self.angles[-1], steps)

    def positions(self) -> Array:
        """All poses of the sweep (K, n)."""
        rows = np.tile(self.pose, (len(self.angles), 1))
        rows[:, self.joint] = self.angles
        return rows


@dataclass(frozen=True, eq=False)
class Design:
    """Chosen sweeps, and the precision that they would give."""

    sweeps: tuple[JointSweep, ...]
    prediction: Prediction


def stop_combinations(arm: Arm, joint: int) -> Array:
    """The 2^(n-1) poses (C, n) [rad] with the other joints at a limit and `joint` in the middle.

    Of an arm with more than 9 joints, `MOST_COMBINATIONS` of them, drawn. Raises BadArray if a joint has no limits.
    """
    for name, low, high in zip(arm.names, arm.lower, arm.upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise BadArray(f"joint {name} has no limits ({low} to {high} rad), so it has no stop to rest on")
    others = np.delete(np.arange(arm.n), joint)
    numbers = np.arange(2 ** len(others))
    if len(numbers) > MOST_COMBINATIONS:
        numbers = np.random.default_rng(0).choice(len(numbers), MOST_COMBINATIONS, replace=False)
    at_upper = (numbers[:, None] >> np.arange(len(others))[::-1]) & 1 == 1  # the last joint changes fastest
    poses = np.tile((arm.lower + arm.upper) / 2, (len(numbers), 1))
    poses[:, others] = np.where(at_upper, arm.upper[others], arm.lower[others])
    return poses


def candidate_sweeps(arm: Arm, joint: int, steps: int, margin: float = 0.0) -> list[JointSweep]:
    """A sweep of `joint`, `margin` [rad] off its limits, for each stop combination with a sufficient lever of gravity.

    Sufficient is Γ ≥ 0.3 g; if no combination has that, the better half is taken.
    """
    poses = stop_combinations(arm, joint)
    good = sufficient_levers(gravity_levers(arm, poses)[:, joint] / max(float(np.linalg.norm(arm.gravity)), 1e-9))
    angles = np.linspace(arm.lower[joint] + margin, arm.upper[joint] - margin, steps)
    return [JointSweep(joint, pose, angles) for pose in poses[good]]


def sufficient_levers(lever: Array) -> Mask:
    """Levers Γ/g (C,) of at least `MINIMUM_LEVER`; if there is none, the better half."""
    good: Mask = lever >= MINIMUM_LEVER
    return good if good.any() else lever >= np.median(lever)


def readings_of(
    arm: Arm, sweeps: Sequence[JointSweep], sigma: ArrayLike, loads: Sequence[float] = (0.0,)
) -> StaticReadings:
    """Readings of these sweeps, repeated with each load [kg]; only the swept joint's torque counts and is 0."""
    positions = np.concatenate([sweep.positions() for sweep in sweeps])
    torque = np.full(positions.shape, np.nan)
    swept = np.concatenate([np.full(len(sweep.angles), sweep.joint) for sweep in sweeps])
    torque[np.arange(len(torque)), swept] = 0.0
    return StaticReadings.of(
        np.tile(positions, (len(loads), 1)),
        np.tile(torque, (len(loads), 1)),
        _per_joint(arm, sigma),
        np.repeat(np.asarray(loads, dtype=np.float64), len(positions)),
    )


def choose_sweeps(
    arm: Arm,
    guess: Parameters,
    *,
    sigma: ArrayLike,
    unknown: Collection[str],
    poses: int = 2,
    steps: int = 25,
    loads: Sequence[float] = (0.0,),
    margin: float = 0.0,
    criterion: Criterion = "D",
) -> Design:
    """`poses` sweeps of every joint, stops chosen together so that the families `unknown` come out best.

    `guess` is the parameters expected, sigma () or (n,) [N·m] the noise of a reading, loads [kg] the reference masses
    of the passes. Raises BadArray on a joint without limits.
    """
    candidates = [candidate_sweeps(arm, joint, SKETCH_STEPS, margin) for joint in reversed(range(arm.n))]  # tip first
    judge = _Judge.of(arm, guess, [sweep for each in candidates for sweep in each], sigma, unknown, loads)
    rows = [judge.jacobian(each) * np.sqrt(steps / SKETCH_STEPS) for each in candidates]
    picks = judge.select(rows, [poses] * arm.n, criterion)
    chosen = [each[pick] for each, of_joint in zip(candidates, picks, strict=True) for pick in of_joint]
    sweeps = [JointSweep(each.joint, each.pose, each.stepped(steps)) for each in chosen]
    return judge.design(sorted(sweeps, key=lambda sweep: sweep.joint))


@dataclass(frozen=True, eq=False)
class _Judge:
    """Comparison of sweeps: the parameters expected, which of them are unknown, and their natural units."""

    arm: Arm
    guess: Parameters
    sigma: Array
    unknown: Collection[str]
    loads: Sequence[float]
    free: Mask
    unit: Array
    """Of the free parameters (p,): with a prior of one unit each, every stage of the choice is regular."""

    @classmethod
    def of(
        cls,
        arm: Arm,
        guess: Parameters,
        sweeps: Sequence[JointSweep],
        sigma: ArrayLike,
        unknown: Collection[str],
        loads: Sequence[float],
    ) -> "_Judge":
        free = free_mask(arm.n, unknown)
        unit = natural_units(arm, expected_readings(arm, guess, readings_of(arm, sweeps, sigma)), guess)[free]
        return cls(arm, guess, _per_joint(arm, sigma), unknown, loads, free, unit)

    def jacobian(self, sweeps: Sequence[JointSweep]) -> Array:
        """Weighted Jacobian (C, L·S, p) of sweeps of one joint with equally many steps."""
        poses = np.stack([sweep.positions() for sweep in sweeps])
        return sweep_jacobian(self.arm, self.guess, sweeps[0].joint, poses, self.sigma, self.free, self.loads)

    def select(self, rows: Sequence[Array], counts: Sequence[int], criterion: Criterion) -> list[list[int]]:
        """The candidates of each group, given by their weighted Jacobians (C, K, p), that together are best."""
        prior = np.diag(self.unit**-2.0)[None]
        return select([each[None] for each in rows], prior, counts, criterion=criterion, unit=self.unit)

    def design(self, sweeps: Sequence[JointSweep]) -> Design:
        readings = readings_of(self.arm, sweeps, self.sigma, self.loads)
        return Design(tuple(sweeps), predict_covariance(self.arm, readings, self.guess, unknown=self.unknown))


def _per_joint(arm: Arm, sigma: ArrayLike) -> Array:
    return as_array("sigma", np.broadcast_to(sigma, (arm.n,)), (arm.n,))
