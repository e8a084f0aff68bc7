"""From the log of a run to its recording: torque sensors, resolution, noise, and rows at uneven times."""

from collections.abc import Iterator

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.motion import RATE
from sim_gap.blind.true_arm import Log, TrueArm

JITTER_S = 4e-4
LATE_SHARE, LOST_SHARE = 0.003, 0.001
"""Share of rows that are late by a good part of a period, and share of rows that are lost."""
SENSOR_BITS = 16
"""Resolution of a torque sensor, over its range of twice the rated torque either way."""
HALVES, SHARES = (0.4, 1.0, 1.8), (0.35, 0.4, 0.25)
"""Half widths of the plays of a hysteresis, as shares of its width, and their weights before normalisation."""


def record(
    truth: TrueArm, log: Log, rate: float, velocity: bool, command: Array, random: np.random.Generator
) -> dict[str, Array]:
    """Columns of a recording at about `rate` Hz: `t` (K,); q, tau, tau_motor, tau_cmd, q_cmd; dq if `velocity`."""
    clock = np.arange(len(log.position)) / RATE
    t = _times(clock[-1], rate, random)
    shape = (len(t), truth.n)
    step = truth.encoder_step
    torque = columns_at(t, clock, _sensor(truth, log.torque, clock)) + truth.torque_noise * random.standard_normal(
        shape
    )
    limit = truth.torque_limit
    resolution = 4.0 * truth.rated / 2**SENSOR_BITS
    motor = columns_at(t, clock, log.motor) + truth.motor_noise * random.standard_normal(shape)
    position = columns_at(t, clock, log.position) / step + 0.4 * random.standard_normal(shape)
    last = (t * RATE + 1e-9).astype(int)  # rows end before the log does
    columns = {
        "t": t,
        "q": np.rint(position) * step,
        "tau": np.rint(np.clip(torque, -limit, limit) / resolution) * resolution,
        "tau_motor": np.rint(motor / (1e-3 * truth.rated))
        * 1e-3
        * truth.rated,  # a drive's estimate in per mille of rated torque
        "tau_cmd": log.command[last],
        "q_cmd": command[last],
    }
    if velocity:
        columns["dq"] = columns_at(t, clock, _drive_velocity(log.position, step, random))
    return columns


def _times(duration: float, rate: float, random: np.random.Generator) -> Array:
    """Uneven times: jitter on every row, some rows late, a few lost."""
    t = np.arange(0.0, duration - 2.0 / rate, 1.0 / rate)
    t[1:] += np.clip(JITTER_S * random.standard_normal(len(t) - 1), -0.4 / rate, 0.4 / rate)
    late = random.random(len(t)) < LATE_SHARE
    t[late] += random.uniform(0.1, 0.3, int(late.sum())) / rate
    kept = random.random(len(t)) >= LOST_SHARE
    kept[0] = True
    return np.asarray(np.sort(t)[kept])


def columns_at(t: Array, clock: Array, values: Array) -> Array:
    """Columns (K, n) at other times, along straight lines."""
    return np.column_stack([np.interp(t, clock, column) for column in values.T])


def _drive_velocity(position: Array, step: float, random: np.random.Generator) -> Array:
    """Velocity that a drive reports: differences of its own reading through a first-order low pass (25 Hz)."""
    from scipy.signal import lfilter

    seen = np.rint(position / step + 0.4 * random.standard_normal(position.shape)) * step
    raw = np.diff(seen, axis=0, prepend=seen[:1]) * RATE
    keep = np.exp(-2 * np.pi * 25.0 / RATE)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], raw, axis=0))


def _sensor(truth: TrueArm, torque: Array, clock: Array) -> Array:
    """Readings without noise: delay, crosstalk, then hysteresis, dead band, saturation, then gain, offset, drift."""
    late = np.column_stack(
        [np.interp(clock - d, clock, column) for d, column in zip(truth.torque_delay, torque.T, strict=True)]
    )
    mixed = late + late @ truth.crosstalk.T
    for j in np.flatnonzero(truth.hysteresis):
        mixed[:, j] = _stays_behind(mixed[:, j], float(truth.hysteresis[j]))
    mixed = np.sign(mixed) * np.maximum(np.abs(mixed) - truth.deadband, 0.0)
    mixed = np.clip(mixed, -truth.torque_limit, truth.torque_limit)
    return np.asarray(truth.torque_gain * mixed + truth.torque_offset + truth.torque_drift * clock[:, None])


def _stays_behind(torque: Array, width: float) -> Array:
    """Prandtl-Ishlinskii hysteresis: plays of several half widths in parallel, which add up to `width`.

    It builds up gradually, as in real strain gauges, and small vibration does not erase it, unlike a Bouc-Wen model.
    """
    shares = np.array(SHARES) / np.dot(SHARES, HALVES)
    read = torque * (1.0 - shares.sum())
    for share, half in zip(shares, HALVES, strict=True):
        read = read + share * np.fromiter(_play(torque, half * width), float, len(torque))
    return np.asarray(read)


def _play(torque: Array, half: float) -> Iterator[float]:
    at = float(torque[0])
    for now in torque.tolist():
        at = min(max(at, now - half), now + half)
        yield at
