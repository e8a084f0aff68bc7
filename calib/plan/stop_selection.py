"""Choice of stop combinations: a D-optimal design for the sensor and gravity fit (docs/theory.md, section 7.4)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.design.selection import select, sufficient_levers, sweep_jacobian
from gcomp.design.selection import stop_combinations as limit_poses
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.parameters import GAIN_STD, POSITION_GAIN_STD, Parameters, free_mask

SKETCH_STEPS = 5
"""Steps by which a candidate sweep is judged: more than a sinusoid's three unknowns (docs/theory.md, section 5.3)."""
TRAVEL_COST = 0.6
"""Price of a second of travel between two sweeps, as log determinant (docs/theory.md, section 7.4)."""
PRIOR_POINT = 0.2
"""Standard deviation before any reading of the place of the mass [m] (docs/theory.md, section 7.4)."""
UNKNOWN = ("gain", "offset", "position_gain", "beta", "rho")
"""Parameter families for which the stops are chosen."""


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
        return len(self.stops)

    def kept(self, which: Mask) -> "Candidates":
        return Candidates(self.joint, self.stops[which], self.poses[which], self.lever[which])


def stop_combinations(kinematics: Arm, joint: int, swept: tuple[float, float]) -> Candidates:
    """The 2^(n-1) combinations with the other joints at a limit, `joint` sweeping the range `swept` [rad]."""
    rest = limit_poses(kinematics, joint)
    stops = np.where(rest > (kinematics.lower + kinematics.upper) / 2, 1, -1).astype(np.int8)
    stops[:, joint] = 0
    poses = np.repeat(rest[:, None, :], SKETCH_STEPS, axis=1)
    poses[:, :, joint] = np.linspace(*swept, SKETCH_STEPS)
    lever = gravity_levers(kinematics, poses[:, 0])[:, joint] / max(float(np.linalg.norm(kinematics.gravity)), 1e-9)
    return Candidates(joint, stops, poses, lever)


def with_lever(candidates: Candidates) -> Candidates:
    """Those with a sufficient lever of gravity on the swept joint; if there are none, the better half."""
    return candidates.kept(sufficient_levers(candidates.lever))


@dataclass(frozen=True, eq=False)
class StopDesign:
    """The design matrices of each joint's candidates, and the prior."""

    candidates: list[Candidates]
    rows: list[Array]
    """Weighted Jacobian (G, C, K, p) of each joint's candidates, for G guesses at the mass moments."""
    prior: Array
    """(G, p, p) before any reading."""

    @classmethod
    def of(
        cls, kinematics: Arm, candidates: list[Candidates], moments: list[Array], sigma: Array, mass: float
    ) -> "StopDesign":
        """`moments` are the mass moments β (2n,) [kg·m] for which the design is made, several guesses if they are
        unknown; sigma (n,) [N·m] of one reading; mass [kg] of the second pass."""
        flange, free = kinematics.span[-1], free_mask(kinematics.n, UNKNOWN)
        guesses = [Parameters.nominal(kinematics.n, beta=beta, rho=flange) for beta in moments]
        loads = (0.0, mass)
        rows = [
            np.stack(
                [sweep_jacobian(kinematics, guess, each.joint, each.poses, sigma, free, loads) for guess in guesses]
            )
            for each in candidates
        ]
        prior = np.stack([np.diag(_prior_std(guess, sigma)[free] ** -2.0) for guess in guesses])
        return cls(candidates, rows, prior)

    def choose(self, counts: list[int], speed: Array) -> list[list[int]]:
        """For each joint's candidates, the indices of the `counts` combinations that together are best.

        Best is D-optimal, less `TRAVEL_COST` for each second of travel from one sweep to the next at `speed` (n,)
        [rad/s].
        """

        def travel(chosen: list[list[int]], place: int, slot: int) -> Array:
            """Price (C,) of the way to each candidate for a slot, from the sweep before it and on to the next one."""
            here, seconds = self.candidates[place], np.zeros(self.candidates[place].count)
            way = [(other, number) for other, picks in enumerate(chosen) for number in range(len(picks))]
            before = [each for each in way if each < (place, slot)][-1:]
            after = [each for each in way if each > (place, slot)][:1]
            for other, number in before + after:
                there = self.candidates[other].poses[chosen[other][number], 0]
                seconds += (np.abs(here.poses[:, 0] - there) / speed).max(axis=1)
            return TRAVEL_COST * seconds

        return select(self.rows, self.prior, counts, cost=travel)


def guessed_moments(kinematics: Arm, seed: int) -> list[Array]:
    """Mass moments (2n,) of three plausible arms of these dimensions, for planning before anything was measured."""
    generator = np.random.default_rng(seed)
    length = np.linalg.norm(kinematics.span, axis=1)
    beyond = np.cumsum((length + 0.1)[::-1])[::-1]
    return [(generator.normal(size=(kinematics.n, 2)) * beyond[:, None]).ravel() for _ in range(3)]


def _prior_std(guess: Parameters, sigma: Array) -> Array:
    """Standard deviations (6n + 3,) of the parameters before any reading."""
    ones = np.ones(len(sigma))
    return Parameters(
        gain=GAIN_STD * ones,
        offset=100 * sigma,
        position_gain=POSITION_GAIN_STD * ones,
        position_offset=ones,
        beta=np.full(len(guess.beta), 10 * max(float(np.abs(guess.beta).max()), 1e-3)),
        rho=np.full(3, PRIOR_POINT),
    ).vector
