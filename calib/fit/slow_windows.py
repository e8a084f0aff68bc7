"""Rows for a field calibration: slow windows of a recording, or the unloaded readings of sweeps."""

from dataclasses import dataclass, replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from armlink.torque_calibration import TorqueCalibration
from calib.dataset import SweepData
from calib.fit.sweep_readings import sweep_readings
from calib.motion.static_reading import slope
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings

WINDOW = 0.25
"""Length of a window, which is averaged to one row [s]."""
FEWEST_SAMPLES = 3
"""Samples of a window; its slope and scatter need as many."""
SLOW = 0.1
"""Largest speed of any joint in a window that counts: centrifugal torque is then below 0.1 N·m at 10 kg·m² [rad/s]."""
STEADY = 0.05
"""Largest change of any joint's speed [rad/s²] (docs/theory.md, section 6.1)."""
MOVED = 0.004
"""Motion of a joint after which its direction counts as changed [rad]."""
FEWEST_ROWS = 12
"""Rows that a recording must have: three unknowns a joint, and some more for the scatter."""


@dataclass(frozen=True, eq=False)
class WindowAverages:
    """Of W windows of a recording; all (W, n) but `slow`."""

    position: Array
    """[rad]"""
    velocity: Array
    """[rad/s]"""
    acceleration: Array
    """[rad/s²]"""
    torque: Array
    """[N·m]"""
    sigma: Array
    """Standard deviation of the torque, by its scatter about a straight line [N·m]."""
    direction: Array
    """Sign of each joint's last motion."""
    slow: Mask
    """Windows in which all joints move slowly and steadily (W,)."""


def windows_of(t: Array, position: Array, torque: Array, source: str) -> WindowAverages:
    """Averages over windows of times (K,) [s] with positions and torques (K, n); raises BadInput if there is none."""
    windows = _windows(t)
    if not windows:
        raise BadInput(f"{source}: no window of {WINDOW} s has {FEWEST_SAMPLES} samples of every joint")
    slopes = np.array([slope(t[each], position[each]) for each in windows])
    middles = np.array([t[each].mean() for each in windows])
    change = np.abs(np.diff(slopes, axis=0)) / np.diff(middles)[:, None]
    padded = np.concatenate([change[:1], change, change[-1:]]) if len(change) else np.zeros((2, position.shape[1]))
    steady = np.maximum(padded[:-1], padded[1:]).max(axis=1) <= STEADY
    means = np.array([position[each].mean(axis=0) for each in windows])
    return WindowAverages(
        position=means,
        velocity=slopes,
        acceleration=np.array([2 * np.polyfit(t[each] - t[each].mean(), position[each], 2)[0] for each in windows]),
        torque=np.array([torque[each].mean(axis=0) for each in windows]),
        sigma=np.array([_scatter(t[each], torque[each]) / np.sqrt(len(t[each])) for each in windows]),
        direction=directions(means),
        slow=(np.abs(slopes).max(axis=1) <= SLOW) & steady,
    )


def rows_of_recording(recording: Recording, held: TorqueCalibration[Array], number: int, source: str) -> StaticReadings:
    """Windows of a recording in which all joints move slowly and steadily.

    `held` (n,) is what the controllers held: what they sent is turned back into the sensors' own readings. Raises
    BadInput if there is no joint torque, or nothing slow enough.
    """
    if recording.torque is None:
        raise BadInput(
            f"{source}: there is no joint torque (columns tau_1 …), but calibration needs the readings of the "
            "torque sensors"
        )
    keep = np.isfinite(recording.position).all(axis=1) & np.isfinite(recording.torque).all(axis=1)
    windows = windows_of(recording.t[keep], recording.position[keep], held.apply(recording.torque[keep]), source)
    slow = windows.slow
    if slow.sum() < FEWEST_ROWS:
        raise BadInput(
            f"{source}: only {int(slow.sum())} windows of {WINDOW} s are slow enough, at least {FEWEST_ROWS} are "
            f"needed: record an arm that stands still in several poses, or moves smoothly below {SLOW} rad/s"
        )
    typical = np.sqrt(np.median(windows.sigma[slow] ** 2, axis=0))
    return StaticReadings(
        windows.position[slow],
        windows.torque[slow],
        np.maximum(typical, 1e-6),
        direction=windows.direction[slow],
        series=np.full(slow.sum(), number),
    )


def rows_of_sweeps(data: SweepData, number: int) -> StaticReadings:
    """The readings of a sweep at rest; raises BadInput for creep sweeps, and if a reference mass was attached."""
    if data.creeps:
        raise BadInput(f"{data.path}: these are creep sweeps: use armlink calibrate {data.path}")
    if data.manifest.reference_mass > 0:
        raise BadInput(
            f"{data.path} was swept with a reference mass of {data.manifest.reference_mass:g} kg, but the field "
            f"calibration needs the arm without a mass; sweeps with a mass are for armlink calibrate {data.path}"
        )
    readings = sweep_readings([data]).readings
    return replace(readings, series=np.full(len(readings), number))


def _windows(t: Array) -> list[slice]:
    """Windows of WINDOW seconds with enough samples and without gaps."""
    windows, begin = [], 0
    while begin < len(t):
        end = int(np.searchsorted(t, t[begin] + WINDOW))
        if end - begin >= FEWEST_SAMPLES and t[end - 1] - t[begin] >= WINDOW / 2:
            windows.append(slice(begin, end))
        begin = max(end, begin + 1)
    return windows


def _scatter(t: Array, values: Array) -> Array:
    """Standard deviation (n,) about a straight line."""
    line = np.outer(t - t.mean(), slope(t, values)) + values.mean(axis=0)
    scatter: Array = np.sqrt(((values - line) ** 2).sum(axis=0) / max(len(t) - 2, 1))
    return scatter


def directions(positions: Array) -> Array:
    """Sign of each joint's last motion of at least MOVED, row by row (K, n)."""
    direction, now = np.zeros_like(positions), np.zeros(positions.shape[1])
    anchor = positions[0].copy()
    for row, here in enumerate(positions):
        moved = np.abs(here - anchor) > MOVED
        now = np.where(moved, np.sign(here - anchor), now)
        anchor = np.where(moved, here, anchor)
        direction[row] = now
    return direction
