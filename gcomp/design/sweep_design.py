"""Which sweeps to make: stops for the resting joints to lean on and steps to take, chosen before anything moves.

D-optimal designs make the volume of the parameters' confidence ellipsoid smallest, A-optimal ones the sum of their
variances in natural units.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.global_fit import Prediction, predict_covariance
from gcomp.identify.natural_units import natural_units
from gcomp.identify.parameters import Parameters, free_mask
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import expected_readings, predict_and_jacobian

MINIMUM_LEVER = 0.3
"""Γ/g of the swept joint below which a stop combination is taken only where there is no better one."""
SKETCH_STEPS = 7
"""Steps by which a candidate sweep is judged."""
EXCHANGES = 2
"""Rounds in which every chosen sweep is compared once more with all others."""

Criterion = Literal["D", "A"]


@dataclass(frozen=True, eq=False)
class Sweep:
    """Joint `joint` moves through `angles` (K,) [rad] while the others stand as in `pose` (n,) [rad]."""

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
    """Chosen sweeps, and what they would determine."""

    sweeps: tuple[Sweep, ...]
    prediction: Prediction


def stop_combinations(arm: Arm, joint: int) -> Array:
    """The 2^(n-1) poses (C, n) [rad] with the other joints at a limit and `joint` in the middle.

    Raises BadArray where a joint has no limits.
    """
    for name, low, high in zip(arm.names, arm.lower, arm.upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise BadArray(f"joint {name} has no limits ({low} to {high} rad): there is no stop to lean on")
    choices = [
        [(low + high) / 2] if i == joint else [low, high]
        for i, (low, high) in enumerate(zip(arm.lower, arm.upper, strict=True))
    ]
    return np.array(list(product(*choices)))


def candidate_sweeps(arm: Arm, joint: int, steps: int, margin: float = 0.0) -> list[Sweep]:
    """A sweep of `joint`, `margin` [rad] off its limits, for each stop combination in which it feels gravity well.

    Well is Γ ≥ 0.3 g; where no combination has that, the better half is taken.
    """
    poses = stop_combinations(arm, joint)
    good = well_felt(gravity_levers(arm, poses)[:, joint] / max(float(np.linalg.norm(arm.gravity)), 1e-9))
    angles = np.linspace(arm.lower[joint] + margin, arm.upper[joint] - margin, steps)
    return [Sweep(joint, pose, angles) for pose in poses[good]]


def well_felt(lever: Array) -> Mask:
    """Which levers Γ/g (C,) are at least `MINIMUM_LEVER`; where none is, the better half."""
    good: Mask = lever >= MINIMUM_LEVER
    return good if good.any() else lever >= np.median(lever)


def readings_of(arm: Arm, sweeps: Sequence[Sweep], sigma: ArrayLike, loads: Sequence[float] = (0.0,)) -> StaticReadings:
    """Rows of these sweeps, made once with each load, in which only the swept joint's torque counts (torque 0)."""
    positions = np.concatenate([sweep.positions() for sweep in sweeps])
    torque = np.full(positions.shape, np.nan)
    swept = np.concatenate([np.full(len(sweep.angles), sweep.joint) for sweep in sweeps])
    torque[np.arange(len(torque)), swept] = 0.0
    return StaticReadings.of(
        np.tile(positions, (len(loads), 1)),
        np.tile(torque, (len(loads), 1)),
        as_array("sigma", np.broadcast_to(sigma, (arm.n,)), (arm.n,)),
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
    of the passes. Greedy choice, then exchanges. Raises BadArray on a joint without limits.
    """
    candidates = [candidate_sweeps(arm, joint, SKETCH_STEPS, margin) for joint in range(arm.n)]
    information = [_information(arm, guess, each, sigma, unknown, loads, steps / SKETCH_STEPS) for each in candidates]
    total = np.eye(information[0].shape[1])  # a prior of one natural unit keeps every stage regular
    chosen: list[list[int]] = [[] for _ in candidates]
    for _ in range(poses):
        for joint, rows in enumerate(information):
            if len(chosen[joint]) < len(rows):
                best = _best(total, rows, chosen[joint], criterion)
                chosen[joint].append(best)
                total = total + rows[best]
    for _ in range(EXCHANGES):
        for joint, rows in enumerate(information):
            for slot, old in enumerate(chosen[joint]):
                total = total - rows[old]
                others = [pick for pick in chosen[joint] if pick != old]
                chosen[joint][slot] = _best(total, rows, others, criterion)
                total = total + rows[chosen[joint][slot]]
    sweeps = [
        Sweep(joint, candidates[joint][pick].pose, candidates[joint][pick].stepped(steps))
        for joint, picks in enumerate(chosen)
        for pick in picks
    ]
    prediction = predict_covariance(arm, readings_of(arm, sweeps, sigma, loads), guess, unknown=unknown)
    return Design(tuple(sweeps), prediction)


def choose_steps(
    arm: Arm,
    guess: Parameters,
    sweeps: Sequence[Sweep],
    *,
    sigma: ArrayLike,
    unknown: Collection[str],
    count: int,
    loads: Sequence[float] = (0.0,),
    criterion: Criterion = "D",
) -> Design:
    """The same sweeps with `count` of their steps each, those that serve the families `unknown` best.

    Give sweeps of many steps to choose from. Ends and turning points of the sinusoids win; keep 13 or more where
    harmonics are to show in the residual.
    """
    rows = [np.concatenate(_scaled(arm, guess, [sweep], sigma, unknown, loads)) for sweep in sweeps]
    total = np.eye(rows[0].shape[-1])
    taken: list[list[int]] = [[] for _ in sweeps]
    for _ in range(count):
        for place, (sweep, jacobian) in enumerate(zip(sweeps, rows, strict=True)):
            of_step = jacobian.reshape(len(loads), len(sweep.angles), -1)
            information = np.einsum("lkp,lkq->kpq", of_step, of_step)
            best = _best(total, information, taken[place], criterion)
            taken[place].append(best)
            total = total + information[best]
    thinned = [
        Sweep(each.joint, each.pose, each.angles[sorted(kept)]) for each, kept in zip(sweeps, taken, strict=True)
    ]
    prediction = predict_covariance(arm, readings_of(arm, thinned, sigma, loads), guess, unknown=unknown)
    return Design(tuple(thinned), prediction)


def _information(
    arm: Arm,
    guess: Parameters,
    sweeps: Sequence[Sweep],
    sigma: ArrayLike,
    unknown: Collection[str],
    loads: Sequence[float],
    repeat: float,
) -> Array:
    """JᵀJ (C, p, p) of each sweep in natural units, its rows standing for `repeat` each."""
    per_load = _scaled(arm, guess, sweeps, sigma, unknown, loads)
    jacobian = np.stack([rows.reshape(len(sweeps), -1, rows.shape[-1]) for rows in per_load], axis=1)
    jacobian = jacobian.reshape(len(sweeps), -1, jacobian.shape[-1])
    information: Array = np.swapaxes(jacobian, 1, 2) @ jacobian * repeat
    return information


def _scaled(
    arm: Arm,
    guess: Parameters,
    sweeps: Sequence[Sweep],
    sigma: ArrayLike,
    unknown: Collection[str],
    loads: Sequence[float],
) -> list[Array]:
    """Weighted Jacobian in natural units of all sweeps' rows (K, p), one for each load."""
    free = free_mask(arm.n, unknown)
    unit = natural_units(arm, expected_readings(arm, guess, readings_of(arm, sweeps, sigma)), guess)[free]
    scaled = []
    for load in loads:
        rows = readings_of(arm, sweeps, sigma, (load,))
        _, jacobian, _ = predict_and_jacobian(arm, guess, rows)
        scaled.append(jacobian[:, free] * unit / rows.sigma[rows.counted][:, None])
    return scaled


def _best(total: Array, information: Array, taken: Collection[int], criterion: Criterion) -> int:
    """The candidate whose information (C, p, p) improves the criterion most, those taken left out."""
    summed = total + information
    score = np.linalg.slogdet(summed)[1] if criterion == "D" else -np.trace(np.linalg.inv(summed), axis1=1, axis2=2)
    score[list(taken)] = -np.inf
    return int(np.argmax(score))
