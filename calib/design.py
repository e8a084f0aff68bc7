"""Choice of stop combinations: the D-optimal design of the whole sensor and gravity fit (theory.md 2, 4, 7)."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from gcomp.arm import Arm
from gcomp.gravity import gravity_levers, gravity_regressor, gravity_stiffness
from gcomp.moments import payload_columns

Array = npt.NDArray[np.float64]

SKETCH_STEPS = 5
"""Steps by which a candidate sweep is judged: enough for a sinusoid and an offset."""
MINIMUM_LEVER = 0.3
"""Γ/g below which a combination is taken only where there is no better one."""
EXCHANGES = 1
"""Rounds in which every chosen combination is compared once more with all others."""
PRIOR_GAIN, PRIOR_POSITION_GAIN, PRIOR_POINT = 0.15, 0.02, 0.2
"""What is known before any reading: standard deviations of torque gain, position gain, attachment point [m]."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """All stop combinations of one swept joint."""

    joint: int
    stops: npt.NDArray[np.int8]
    """(C, n), ±1; 0 for the swept joint."""
    poses: Array
    """(C, S, n) poses along each sweep [rad]."""
    lever: Array
    """Γ/g of the swept joint (C,)."""

    def kept(self, which: npt.NDArray[np.bool_]) -> "Candidates":
        """These combinations alone."""
        return Candidates(self.joint, self.stops[which], self.poses[which], self.lever[which])


def stop_combinations(arm: Arm, joint: int, low: Array, high: Array, swept: tuple[float, float]) -> Candidates:
    """The 2^(n-1) combinations in which the other joints stand at `low` or `high` (n,), `joint` sweeping `swept`."""
    others = [i for i in range(arm.n) if i != joint]
    stops = np.zeros((2 ** len(others), arm.n), dtype=np.int8)
    stops[:, others] = np.array(list(product((-1, 1), repeat=len(others))), dtype=np.int8).reshape(-1, len(others))
    poses = np.repeat(np.where(stops > 0, high, low)[:, None, :], SKETCH_STEPS, axis=1)
    poses[:, :, joint] = np.linspace(*swept, SKETCH_STEPS)
    lever = gravity_levers(arm, poses[:, 0])[:, joint] / max(float(np.linalg.norm(arm.gravity)), 1e-9)
    return Candidates(joint, stops, poses, lever)


def reachable(candidates: Candidates) -> Candidates:
    """Those in which the swept joint feels gravity well; where there are none, the better half."""
    good = candidates.lever >= MINIMUM_LEVER
    if not good.any():
        good = candidates.lever >= np.median(candidates.lever)
    return candidates.kept(good)


def choose(
    arm: Arm, candidates: list[Candidates], count: list[int], moments: list[Array], sigma: Array, mass: float
) -> list[list[int]]:
    """For each joint's candidates, the indices of the `count` combinations that together are D-optimal.

    `moments` are the mass moments β (2n,) [kg·m] for which the design is made, as several guesses where they are
    unknown; sigma (n,) [N·m] of one reading; mass [kg] of the second pass. Greedy, then exchanged.
    """
    rows = [np.stack([_information(arm, each, beta, sigma, mass) for beta in moments]) for each in candidates]
    prior = np.stack([_prior(arm, beta, sigma) for beta in moments])
    chosen: list[list[int]] = [[] for _ in candidates]
    total = prior.copy()
    for place, wanted in enumerate(count):
        for _ in range(min(wanted, len(candidates[place].stops))):
            best = _best(total, rows[place], set(chosen[place]))
            chosen[place].append(best)
            total += rows[place][:, best]
    for _ in range(EXCHANGES):
        for place, picks in enumerate(chosen):
            for slot, old in enumerate(picks):
                total -= rows[place][:, old]
                picks[slot] = _best(total, rows[place], set(picks) - {old})
                total += rows[place][:, picks[slot]]
    return chosen


def guessed_moments(arm: Arm, seed: int, draws: int = 3) -> list[Array]:
    """Mass moments (2n,) of plausible arms of these dimensions, for planning before anything was measured."""
    generator = np.random.default_rng(seed)
    length = np.hypot(arm.a, arm.d)
    beyond = np.cumsum((length + 0.1)[::-1])[::-1]
    return [(generator.normal(size=(arm.n, 2)) * beyond[:, None]).ravel() for _ in range(draws)]


def _best(total: Array, rows: Array, taken: set[int]) -> int:
    """The candidate that makes the mean log determinant largest."""
    score = np.linalg.slogdet(total[:, None] + rows)[1].mean(axis=0)
    score[list(taken)] = -np.inf
    return int(np.argmax(score))


def _information(arm: Arm, candidates: Candidates, beta: Array, sigma: Array, mass: float) -> Array:
    """JᵀJ (C, P, P) of each candidate sweep, without and with the mass, for x = (k, o, c, β, ρ)."""
    i, n = candidates.joint, arm.n
    at_origin, by_point = payload_columns(arm)
    tip = np.array([arm.a[-1], 0.0, arm.d[-1]])
    regressor = gravity_regressor(arm, candidates.poses)[..., i, :]
    count, steps = regressor.shape[:2]
    parts = []
    for load in (0.0, mass):
        loaded = beta + load * (at_origin + by_point @ tip)
        jacobian = np.zeros((count, steps, 5 * n + 3))
        jacobian[..., i] = regressor @ loaded
        jacobian[..., n + i] = 1.0
        stiffness = gravity_stiffness(arm, loaded, candidates.poses)[..., i, :]
        jacobian[..., 2 * n : 3 * n] = stiffness * candidates.poses
        jacobian[..., 3 * n : 5 * n] = regressor
        jacobian[..., 5 * n :] = load * regressor @ by_point
        parts.append(jacobian / sigma[i])
    both = np.concatenate(parts, axis=1)
    information: Array = np.einsum("csp,csq->cpq", both, both, optimize=True)
    return information


def _prior(arm: Arm, beta: Array, sigma: Array) -> Array:
    n = arm.n
    std = np.concatenate(
        [
            np.full(n, PRIOR_GAIN),
            100 * sigma,
            np.full(n, PRIOR_POSITION_GAIN),
            np.full(2 * n, 10 * max(float(np.abs(beta).max()), 1e-3)),
            np.full(3, PRIOR_POINT),
        ]
    )
    return np.diag(std**-2.0)
