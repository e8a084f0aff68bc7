"""From sweep data sets to the rows of the fit: raw readings, which of them count, and how exact each is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from armlink.errors import BadInput
from calib.sweep.dataset import SweepData
from gcomp.identify.readings import Readings

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

UNSETTLED = 3.0
"""Factor on the standard deviation of a reading that was taken before it had settled; what its samples scatter beyond
their noise, by a swing or a creep, counts whole beside it, for no average takes that out."""
FLOOR = 2e-5
"""Smallest standard deviation of a reading, as a share of rated torque: sensors have a last bit too."""


@dataclass(frozen=True, eq=False)
class FitRows:
    """K static readings of n joints, all passes together."""

    readings: Readings
    swept: npt.NDArray[np.int64]
    """Index of the swept joint (K,); -1 where all were held."""
    direction: npt.NDArray[np.int64]
    """Side of approach (K,)."""
    sweep: tuple[str, ...]
    """Name of pass and sweep (K,), as DIRECTORY/sweep."""
    noise: Array
    """Standard deviation of one torque sample (n,) [N·m]."""
    position_sigma: Array
    """Standard deviation of a position reading from its resolution (n,) [rad]."""
    resolution: Array
    """Smallest step seen in each joint's position reading (n,) [rad]; 0 where it is not known."""
    time: Array
    """When each was taken, passes one after the other (K,) [s]."""
    motor_torque: Array
    """The drives' own estimates (K, n) [N·m]; NaN where missing."""
    target: Array
    """Where the plan wanted the joints under position control (K, n) [rad]; NaN for the others."""

    @property
    def own(self) -> Flags:
        """Which readings are of the swept joint's own sensor (K, n)."""
        flags = np.zeros(self.readings.position.shape, dtype=bool)
        rows = np.flatnonzero(self.swept >= 0)
        flags[rows, self.swept[rows]] = True
        return flags

    @property
    def masses(self) -> tuple[float, ...]:
        """Reference masses in the data, sorted [kg]; 0 is none."""
        return tuple(sorted(set(self.readings.load.tolist())))


def fit_rows(data: Sequence[SweepData]) -> FitRows:
    """Stack data sets of one arm; raises BadInput where there is nothing to fit or they are of different arms."""
    if not data or not any(each.readings for each in data):
        raise BadInput("no sweep readings: give the directories that armlink sweep wrote")
    first = data[0].manifest
    for each in data[1:]:
        if (each.manifest.names, each.manifest.description_hash) != (first.names, first.description_hash):
            raise BadInput(f"{each.path}: swept on another arm or description than {data[0].path}")
    rows = [(each, reading) for each in data for reading in each.readings]
    raw = np.concatenate([_raw(each) for each in data if each.readings])
    position = np.array([reading.position for _, reading in rows])
    servo = np.array([reading.servo for _, reading in rows], dtype=bool)
    swept = np.array([-1 if reading.joint is None else reading.joint for _, reading in rows])
    counts = servo | (np.arange(len(first.names)) == swept[:, None])
    std = np.array([reading.torque_std for _, reading in rows])
    count = np.array([reading.count for _, reading in rows])
    noise = np.sqrt(np.nanmedian(np.where(counts, std, np.nan) ** 2, axis=0))
    noise = np.maximum(np.nan_to_num(noise), 0.0)
    rated = np.array(first.rated_torque)
    unsettled = ~np.array([reading.settled for _, reading in rows])
    sigma = np.hypot(noise / np.sqrt(count)[:, None], FLOOR * rated)
    swing = np.sqrt(np.maximum(np.nan_to_num(std[unsettled]) ** 2 - noise**2, 0.0))  # NaN: a sensor that was silent
    sigma[unsettled] = np.hypot(UNSETTLED * sigma[unsettled], swing)
    load = np.array([each.manifest.reference_mass for each, _ in rows])
    resolution = np.max([each.resolution for each in data], axis=0)
    return FitRows(
        Readings.of(position, np.where(counts, raw, np.nan), sigma, load),
        swept,
        np.array([reading.direction for _, reading in rows]),
        tuple(f"{each.path.name}/{reading.sweep}" for each, reading in rows),
        noise,
        _rounding(position, resolution),
        resolution,
        _time(data),
        np.array([reading.motor_torque for _, reading in rows]),
        np.concatenate([_targets(each) for each in data if each.readings]),
    )


def _time(data: Sequence[SweepData]) -> Array:
    """Seconds (K,) since the first reading; a pass begins where the one before it ended."""
    parts, before = [], 0.0
    for each in data:
        if each.readings:
            t = each.array("t")
            parts.append(t - t.min() + before)
            before = float(parts[-1].max())
    return np.concatenate(parts)


def _targets(data: SweepData) -> Array:
    """Positions (K, n) [rad] that the plan asked for; NaN for joints pressed on stops."""
    targets = np.full((len(data.readings), len(data.manifest.names)), np.nan)
    if data.plan is None:
        return targets
    sweeps = {sweep.name: sweep for sweep in data.plan.sweeps}
    scouted = iter(data.plan.scout)
    for row, reading in enumerate(data.readings):
        if reading.joint is None:
            targets[row] = next(scouted, np.nan)
            continue
        sweep = sweeps.get(reading.sweep)
        if sweep is None or reading.index >= sweep.readings:
            continue
        targets[row] = np.where(sweep.servo, sweep.rest, np.nan)
        targets[row, sweep.joint] = sweep.target(reading.index)[0]
    return targets


def _rounding(position: Array, resolution: Array) -> Array:
    """Standard deviation (n,) [rad] of the rounding of positions (K, n), as if each row's were independent.

    A resting joint repeats the same reading, and with it the same error, in many rows; that averages out no further.
    """
    sigma = np.zeros(len(resolution))
    for joint in np.flatnonzero(resolution > 0):
        distinct = len(np.unique(np.rint(position[:, joint] / resolution[joint])))
        sigma[joint] = resolution[joint] / np.sqrt(12.0) * np.sqrt(len(position) / distinct)
    return sigma


def _raw(data: SweepData) -> Array:
    """Torque readings (K, n) as the sensor gives them, the controllers' own calibration taken out [N·m]."""
    return data.manifest.installed.apply(data.array("torque"))
