"""Precision of a plan before anything moves: the covariance that the fit would report."""

from collections.abc import Sequence

import numpy as np

from calib.plan.rough_gravity import GravityGuess
from calib.plan.stop_selection import PRIOR_GAIN
from calib.plan.types import Sweep
from gcomp.arrays import Array
from gcomp.identify.global_fit import predict_covariance
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.readings import StaticReadings

SIDE = 0.05
"""Lateral offset at which the reference mass is assumed to hang [m]; a choice."""
SCATTER = 1.3
"""Scatter of readings over the noise of their samples, since joints never rest completely: as the fits of
tests/campaigns/random_arms.py find it."""


def predicted_gain_std(
    guess: GravityGuess,
    sweeps: Sequence[Sweep],
    scout: Array,
    mass: float,
    sigma: Array,
    position_offset_std: float,
    position_sigma: Array | float = 0.0,
    point: Prior | None = None,
) -> Array:
    """Standard deviations (n,) of the torque gains after passes without and with `mass` [kg]; inf if not observable.

    scout (P, n) [rad] are poses at which all sensors count; sigma (n,) [N·m] is that of one reading, position_sigma
    (n,) [rad] that of its positions; `point` is the prior on the place of the mass.
    """
    kinematics = guess.kinematics
    positions, counted = [scout], [np.ones(scout.shape, dtype=bool)]
    for sweep in sweeps:
        poses = np.tile(np.array(sweep.rest), (sweep.readings, 1))
        poses[:, sweep.joint] = [sweep.target(index)[0] for index in range(sweep.readings)]
        counts = np.array(sweep.servo)
        counts[sweep.joint] = True
        positions.append(poses)
        counted.append(np.tile(counts, (sweep.readings, 1)))
    position, counts = np.concatenate(positions), np.concatenate(counted)
    torque = np.where(counts, 0.0, np.nan)
    rows = len(position)
    both = StaticReadings.of(
        np.concatenate([position, position]),
        np.concatenate([torque, torque]),
        SCATTER * sigma,
        np.repeat([0.0, mass], rows),
    )
    unknown = {"gain", "offset", "position_gain", "beta", "rho"}
    priors = {}
    if position_offset_std > 0:
        unknown.add("position_offset")
        priors["position_offset"] = Prior(0.0, position_offset_std)
    tip = kinematics.span[-1] + [SIDE, SIDE, 0.0]
    if point is not None:
        priors["rho"], tip = point, np.asarray(point.mean, dtype=np.float64)
    start = Parameters.nominal(kinematics.n, beta=guess.beta, rho=tip)
    std: Array = predict_covariance(
        kinematics, both, start, unknown=unknown, priors=priors, position_sigma=position_sigma
    ).std.gain
    return std


def worst_gain_std(std: Array) -> float:
    """Largest standard deviation among the gains that averaging can improve; 0 if there is none."""
    known = std[std < PRIOR_GAIN]  # beyond it more averaging cannot help
    return float(known.max()) if len(known) else 0.0
