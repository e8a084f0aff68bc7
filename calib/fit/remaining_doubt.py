"""Doubt of a fit about the torque at a new pose, beyond the covariance of its parameters, joint by joint."""

from dataclasses import replace

import numpy as np

from calib.fit.lags import Lags
from calib.fit.refinement import Refined
from calib.fit.small_troubles import FAMILIES, HELD, UNITS, Setting, troubles
from calib.fit.sweep_readings import SweepReadings
from calib.records.records import Discrepancy
from gcomp.arrays import Array
from gcomp.identify.parameters import parameter_names
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict_and_jacobian

POSES, APART = 80, 0.5
"""Random poses, and the distance between the two of each pair that tells the length [rad]."""
LIKE = (0.02, 0.995)
"""Range of the correlation over APART from which a length follows: 0.18 to 5 rad."""


def remaining_doubt(setting: Setting, rows: SweepReadings, refined: Refined) -> tuple[Discrepancy, ...]:
    """The discrepancy of every joint: what its calibrated torque and the gravity model still disagree by.

    The second moment, over random poses of the joints' range, of all small troubles as the readings leave them:
    their estimates, which gain, offset and mass moments cannot express, and their uncertainty, in so far as it is not
    in that of the parameters (docs/theory.md, 4.6).
    """
    arm, n = setting.arm, setting.arm.n
    random = np.random.default_rng(7)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    poses = random.uniform(low, high, (POSES, n))
    away = random.normal(size=(POSES, n))
    near = poses + APART * away / np.linalg.norm(away, axis=1, keepdims=True)
    level, level_near, together = _moments(setting, rows, refined, poses, near)
    gain = np.abs(refined.fit.complete.gain)
    lag = HELD * refined.levels.level[FAMILIES.index("direction")] * UNITS["direction"][0] * setting.rated
    told = max(float(np.maximum(refined.levels.freedom, 0.0).sum()) / n, 1.0)
    found = []
    for joint in range(n):
        size = float(np.sqrt(level[joint] + lag[joint] ** 2) / gain[joint])
        alike = together[joint] / max(float(np.sqrt(level[joint] * level_near[joint])), 1e-300)
        length = APART / np.sqrt(-2 * np.log(np.clip(alike, *LIKE)))
        found.append(Discrepancy(level=size, level_std=size / np.sqrt(2 * told), length=float(length)))
    return tuple(found)


def _moments(
    setting: Setting, rows: SweepReadings, refined: Refined, poses: Array, near: Array
) -> tuple[Array, Array, Array]:
    """Mean squares (n,) of the discrepancy at poses and at their neighbours, and mean products (n,) [N²·m²]."""
    linear, n, count = refined.linear, setting.arm.n, len(poses)
    complete = refined.fit.complete
    readings = StaticReadings.of(np.vstack([poses, near]), np.zeros((2 * count, n)), 1.0)
    here = replace(
        rows,
        readings=readings,
        swept=np.full(2 * count, -1),
        time=np.full(2 * count, setting.span[1]),
        felt=np.full((2 * count, n), np.nan),
    )
    setting = replace(setting, lags=Lags.unknown(2 * count, n))
    effects = troubles(setting, here, complete, refined.troubles.kept)
    columns = effects.columns * refined.levels.level[effects.family]
    free = np.isin(parameter_names(setting.arm), refined.fit.names)
    slopes = predict_and_jacobian(setting.arm, complete, readings)[1][:, free]
    covariance = np.nan_to_num(refined.fit.covariance)
    value = linear.effects.T @ linear.residual
    spread = np.eye(len(value)) - linear.effects.T @ linear.annihilator @ linear.effects
    across = -covariance @ linear.design.T @ linear.precision @ linear.effects
    known = columns @ value
    doubt = columns @ spread + 2 * slopes @ across
    level = (known**2 + np.maximum(np.einsum("pm,pm->p", doubt, columns), 0.0)).reshape(2, count, n)
    first, second = columns[: count * n], columns[count * n :]
    product = known[: count * n] * known[count * n :] + np.einsum("pm,pm->p", first @ spread, second)
    plain = (known**2 + np.einsum("pm,pm->p", columns @ spread, columns)).reshape(2, count, n).mean(axis=1)
    share = level[0].mean(axis=0) / np.maximum(plain[0], 1e-300)
    together = product.reshape(count, n).mean(axis=0) * share
    return level[0].mean(axis=0), plain[1] * share, together
