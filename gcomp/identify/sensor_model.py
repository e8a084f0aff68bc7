"""Sensor readings at given parameters, and their Jacobian (docs/theory.md, section 7.1)."""

from dataclasses import replace

import numpy as np

from gcomp.arm.arm import Arm, bar_frames
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, cross
from gcomp.gravity.torque import composite_moments
from gcomp.identify.parameters import Parameters, family_slices
from gcomp.identify.readings import StaticReadings


def joint_positions(parameters: Parameters, readings: StaticReadings) -> Array:
    """Joint positions q = c φ + θ0 (K, n) [rad]."""
    return readings.position * parameters.position_gain + parameters.position_offset


def row_moments(arm: Arm, parameters: Parameters, load: Array) -> Array:
    """Mass moments of each row, reference mass included: β + μ (E_0 + E_ρ ρ) as (K, n, 2) [kg·m]."""
    fixed, by_point = payload_columns(arm)
    return (parameters.beta + load[:, None] * (fixed + by_point @ parameters.rho)).reshape(-1, arm.n, 2)


def predict(arm: Arm, parameters: Parameters, readings: StaticReadings) -> Array:
    """Modelled torque readings (K, n) [N·m] of every joint, whether they count or not."""
    frames = bar_frames(arm, joint_positions(parameters, readings))
    composite = composite_moments(frames.rotation, row_moments(arm, parameters, readings.load))
    reading: Array = parameters.gain * np.einsum("kid,kid->ki", frames.lever, composite) + parameters.offset
    return reading


def expected_readings(arm: Arm, parameters: Parameters, design: StaticReadings) -> StaticReadings:
    """The design's readings with modelled torques in place of its own; what does not count stays NaN."""
    return replace(design, torque=np.where(design.counted, predict(arm, parameters, design), np.nan))


def predict_and_jacobian(arm: Arm, parameters: Parameters, readings: StaticReadings) -> tuple[Array, Array, Array]:
    """(Modelled counted readings (P,), their Jacobian (P, 6n + 3), their slope by position reading (P, n)).

    The P counted readings are in row order, then joint order.
    """
    n, counted = arm.n, readings.counted
    row, joint = np.nonzero(counted)
    frames = bar_frames(arm, joint_positions(parameters, readings))
    composite = composite_moments(frames.rotation, row_moments(arm, parameters, readings.load))
    torque = np.einsum("kid,kid->ki", frames.lever, composite)[counted]
    gain = parameters.gain[joint]

    turned = cross(frames.rotation[..., 2], composite)
    below = np.einsum("pd,pld->pl", turned[row, joint], frames.lever[row])
    above = np.einsum("pd,pld->pl", frames.lever[row, joint], turned[row])
    stiffness = np.where(np.arange(n) <= joint[:, None], below, above) * gain[:, None]

    regressor = np.einsum("pd,pjdc->pjc", frames.lever[row, joint], frames.rotation[row][..., :2])
    regressor *= (np.arange(n) >= joint[:, None])[..., None] * gain[:, None, None]

    jacobian = np.zeros((len(row), 6 * n + 3))
    places, pairs = family_slices(n), np.arange(len(row))
    jacobian[pairs, places["gain"].start + joint] = torque
    jacobian[pairs, places["offset"].start + joint] = 1.0
    jacobian[:, places["position_gain"]] = stiffness * readings.position[row]
    jacobian[:, places["position_offset"]] = stiffness
    jacobian[:, places["beta"]] = regressor.reshape(len(row), 2 * n)
    jacobian[:, places["rho"]] = readings.load[row, None] * (jacobian[:, places["beta"]] @ payload_columns(arm)[1])
    return gain * torque + parameters.offset[joint], jacobian, stiffness * parameters.position_gain
