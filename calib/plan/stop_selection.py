"""Choice of stop combinations: the D-optimal design of the whole sensor and gravity fit (theory.md 2, 4, 7)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.design.sweep_design import stop_combinations as limit_poses
from gcomp.design.sweep_design import well_felt
from gcomp.gravity.torque import gravity_levers, gravity_regressor, gravity_stiffness

Array = npt.NDArray[np.float64]

SKETCH_STEPS = 5
"""Steps by which a candidate sweep is judged: enough for a sinusoid and an offset."""
EXCHANGES = 2
"""Rounds in which every chosen combination is compared once more with all others."""
WAY = 0.6
"""Log determinant that a second of travel between two sweeps must be worth."""
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

    @property
    def count(self) -> int:
        """How many there are, C."""
        return len(self.stops)

    def kept(self, which: npt.NDArray[np.bool_]) -> "Candidates":
        """These combinations alone."""
        return Candidates(self.joint, self.stops[which], self.poses[which], self.lever[which])


def stop_combinations(arm: Arm, joint: int, swept: tuple[float, float]) -> Candidates:
    """The 2^(n-1) combinations in which the other joints stand at a limit, `joint` sweeping `swept`."""
    rest = limit_poses(arm, joint)
    stops = np.where(rest > (arm.lower + arm.upper) / 2, 1, -1).astype(np.int8)
    stops[:, joint] = 0
    poses = np.repeat(rest[:, None, :], SKETCH_STEPS, axis=1)
    poses[:, :, joint] = np.linspace(*swept, SKETCH_STEPS)
    lever = gravity_levers(arm, poses[:, 0])[:, joint] / max(float(np.linalg.norm(arm.gravity)), 1e-9)
    return Candidates(joint, stops, poses, lever)


def reachable(candidates: Candidates) -> Candidates:
    """Those in which the swept joint feels gravity well; where there are none, the better half."""
    return candidates.kept(well_felt(candidates.lever))


def choose(
    arm: Arm,
    candidates: list[Candidates],
    count: list[int],
    moments: list[Array],
    sigma: Array,
    mass: float,
    speed: Array,
) -> list[list[int]]:
    """For each joint's candidates, the indices of the `count` combinations that together are best.

    Best is D-optimal, less `WAY` for each second of travel from one sweep to the next at `speed` (n,) [rad/s].
    `moments` are the mass moments β (2n,) [kg·m] for which the design is made, as several guesses where they are
    unknown; sigma (n,) [N·m] of one reading; mass [kg] of the second pass. Greedy, then exchanged.
    """
    rows = [np.stack([_information(arm, each, beta, sigma, mass) for beta in moments]) for each in candidates]
    total = np.stack([_prior(arm, beta, sigma) for beta in moments])
    chosen: list[list[int]] = [[] for _ in candidates]
    slots = [(place, slot) for place, each in enumerate(candidates) for slot in range(min(count[place], each.count))]
    for turn in range(1 + EXCHANGES):
        for place, slot in slots:
            picks = chosen[place]
            if turn:
                total -= rows[place][:, picks[slot]]
            score = np.linalg.slogdet(total[:, None] + rows[place])[1].mean(axis=0)
            score -= WAY * _seconds(candidates, chosen, place, slot, speed)
            score[[pick for other, pick in enumerate(picks) if other != slot]] = -np.inf
            picks[slot : slot + 1] = [int(np.argmax(score))]
            total += rows[place][:, picks[slot]]
    return chosen


def guessed_moments(arm: Arm, seed: int, draws: int = 3) -> list[Array]:
    """Mass moments (2n,) of plausible arms of these dimensions, for planning before anything was measured."""
    generator = np.random.default_rng(seed)
    length = np.hypot(arm.a, arm.d)
    beyond = np.cumsum((length + 0.1)[::-1])[::-1]
    return [(generator.normal(size=(arm.n, 2)) * beyond[:, None]).ravel() for _ in range(draws)]


def _seconds(candidates: list[Candidates], chosen: list[list[int]], place: int, slot: int, speed: Array) -> Array:
    """Time (C,) [s] to each candidate for one slot from the sweep before it, and on to the one after it."""
    here, time = candidates[place], np.zeros(candidates[place].count)
    way = [(other, number) for other, picks in enumerate(chosen) for number in range(len(picks))]
    before = [each for each in way if each < (place, slot)][-1:]
    after = [each for each in way if each > (place, slot)][:1]
    for other, number in before + after:
        there = candidates[other].poses[chosen[other][number], 0]
        time += (np.abs(here.poses[:, 0] - there) / speed).max(axis=1)
    return time


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
