"""Start of the global fit: the model is linear in the reciprocal gains (docs/theory.md, equation (L))."""

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.identifiability import NULL_RATIO
from gcomp.identify.least_squares import linear_least_squares
from gcomp.identify.parameters import Parameters, family_slices, natural_units
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import joint_positions

SANE_GAIN_RATIO = 5.0
"""Factor to the start beyond which a gain counts as not determined by its readings (docs/theory.md, section 7.2)."""


def linear_start(
    arm: Arm, readings: StaticReadings, start: Parameters, free: Mask, *, keep_ratios: bool = False
) -> Parameters:
    """Gains, offsets, mass moments and load point that solve (L) at the start's position gains and offsets.

    κ_i v − ω_i − Y_i (β + μ E_ρ ρ) = μ Y_i E_0 with κ = 1/gain, ω = offset/gain; parameters not in `free` (6n + 3,)
    keep their start. Without a reference mass and with β unknown the equation has no scale: the gain of the joint whose
    torque varies most keeps its start, and so do gains that their readings do not determine. `keep_ratios` leaves only
    a common factor of the gains free.
    """
    places = family_slices(arm.n)
    free_gain = free[places["gain"]].copy()
    if free[places["beta"]].any() and not np.any(readings.load != 0):
        free_gain[_strongest(readings)] = False
    while True:
        kappa, omega, beta, rho = _solve(arm, readings, start, free, free_gain, keep_ratios)
        ratio = kappa * start.gain
        lost = free_gain & ~((np.abs(ratio) > 1 / SANE_GAIN_RATIO) & (np.abs(ratio) < SANE_GAIN_RATIO))
        if not lost.any():
            break
        free_gain &= ~lost
    gain = np.where(free_gain, 1 / np.where(free_gain, kappa, 1.0), start.gain)
    found = {"gain": gain, "offset": omega * gain, "beta": beta, "rho": rho}
    vector = start.vector.copy()
    for family, value in found.items():
        vector[places[family]] = np.where(free[places[family]], value, getattr(start, family))
    return Parameters.from_vector(vector, arm.n)


def _solve(
    arm: Arm, readings: StaticReadings, start: Parameters, free: Mask, free_gain: Mask, keep_ratios: bool
) -> list[Array]:
    """κ (n,), ω (n,), β (2n,), ρ (3,) of least norm; zero if not free."""
    n = arm.n

    def rows(block: StaticReadings) -> Array:
        row, joint = np.nonzero(block.counted)
        columns, target = _linear_rows(arm, block, start, free, free_gain)
        if keep_ratios:
            columns[:, 0] = columns[:, :n] @ (1 / start.gain)
            columns[:, 1:n] = 0.0
        weight = np.abs(start.gain[joint]) / block.sigma[row, joint]
        return np.column_stack([columns, target]) * weight[:, None]

    unit, places = natural_units(arm, readings, start), family_slices(n)
    unit = np.concatenate([1 / unit[places["gain"]], unit[places["offset"]], unit[places["beta"].start :]])
    solution = linear_least_squares(map(rows, readings.blocks()), unit, rcond=NULL_RATIO)
    if keep_ratios:
        solution[:n] = np.where(free_gain, solution[0] / start.gain, 0.0)
    return np.split(solution, [n, 2 * n, 4 * n])


def _linear_rows(
    arm: Arm, readings: StaticReadings, start: Parameters, free: Mask, free_gain: Mask
) -> tuple[Array, Array]:
    """Columns (P, 4n + 3) of (κ, ω, β, ρ) and right-hand side (P,); columns that are not free are zero."""
    n, places = arm.n, family_slices(arm.n)
    row, joint = np.nonzero(readings.counted)
    v, load = readings.torque[row, joint], readings.load[row]
    regressor = gravity_regressor(arm, joint_positions(start, readings))[row, joint]
    fixed, by_point = payload_columns(arm)
    columns = np.zeros((len(row), 4 * n + 3))
    pairs = np.arange(len(row))
    columns[pairs, joint] = v
    columns[pairs, n + joint] = -1.0
    columns[:, 2 * n : 4 * n] = -regressor
    columns[:, 4 * n :] = -load[:, None] * (regressor @ by_point)
    target = load * (regressor @ fixed)
    offset_known = ~free[places["offset"]]
    columns[pairs, joint] -= np.where(offset_known, start.offset, 0.0)[joint]
    is_free = np.concatenate([free_gain, ~offset_known, free[places["beta"]], free[places["rho"]]])
    known = np.concatenate([1 / start.gain, np.zeros(n), start.beta, start.rho])
    target -= columns[:, ~is_free] @ known[~is_free]
    columns[:, ~is_free] = 0.0
    return columns, target


def _strongest(readings: StaticReadings) -> int:
    """The joint whose counted torque varies most against its noise."""
    scaled = np.ma.masked_invalid(readings.torque / readings.sigma)
    return int(np.argmax(scaled.std(axis=0).filled(0.0)))
