"""The static readings of sweep data sets as the fit takes them: which count, how exact each is, where it comes from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from armlink.errors import BadInput
from armlink.torque_calibration import TorqueCalibration
from calib.dataset import SweepData, labels
from calib.motion.static_reading import StaticReading, batch, stack
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings

UNSETTLED = 3.0
"""Factor on the standard deviation of a reading that was taken before it had settled. What its samples scatter beyond
their noise, by a swing or a creep, is added whole: averaging does not reduce it."""
FLOOR = 2e-5
"""Smallest standard deviation of a reading, as a share of rated torque: the resolution of a sensor."""


@dataclass(frozen=True, eq=False)
class SweepReadings:
    """K static readings of n joints from all passes, with what the data sets know of them."""

    readings: StaticReadings
    """As the sensors gave them: the calibration that the controllers had installed is taken out."""
    sweeps: tuple[str, ...]
    """Names of the sweeps, as DIRECTORY/sweep; `readings.series` counts them."""
    swept: npt.NDArray[np.int64]
    """Index of the swept joint (K,); -1 if all were held."""
    time: Array
    """When each was taken, passes one after the other (K,) [s]."""
    felt: Array
    """Torque readings of all sensors (K, n) [N·m], those of joints pressed on stops included; like `readings.torque`,
    as the sensors gave them."""
    motor_torque: Array
    """The drives' own estimates (K, n) [N·m]; NaN if missing."""
    target: Array
    """Where the plan wanted the joints under position control (K, n) [rad]; NaN for the others."""
    position_sigma: Array
    """Standard deviation of a position reading from its resolution (n,) [rad]."""
    resolution: Array
    """Smallest step seen in each joint's position reading (n,) [rad]; 0 if unknown."""

    @property
    def own(self) -> Mask:
        """Readings of the swept joint's own sensor (K, n)."""
        own: Mask = np.arange(self.readings.position.shape[1]) == self.swept[:, None]
        return own

    @property
    def masses(self) -> tuple[float, ...]:
        """Reference masses in the data, sorted [kg]; 0 for none."""
        return tuple(sorted(set(self.readings.load.tolist())))


def sweep_readings(data: Sequence[SweepData]) -> SweepReadings:
    """All readings of data sets of one arm; raises BadInput if there are none or the arms differ."""
    _require_one_arm(data)
    taken = [reading for each in data for reading in each.readings]
    folders = labels([each.path for each in data])
    names = [f"{folder}/{reading.sweep}" for folder, one in zip(folders, data, strict=True) for reading in one.readings]
    source = np.repeat(np.arange(len(data)), [len(each.readings) for each in data])
    sweeps = tuple(dict.fromkeys(names))
    sigma = _sigma(taken, np.array(data[0].manifest.rated_torque))
    resolution = np.max([each.resolution for each in data], axis=0)
    sent = batch(taken, sigma)
    gain = np.array([each.manifest.installed_gain for each in data])[source]
    offset = np.array([each.manifest.installed_offset for each in data])[source]
    readings = replace(
        sent,
        torque=TorqueCalibration(gain, offset).apply(sent.torque),
        load=np.array([each.manifest.reference_mass for each in data])[source],
        series=np.array([sweeps.index(name) for name in names]),
    )
    return SweepReadings(
        readings=readings,
        sweeps=sweeps,
        swept=np.array([-1 if reading.joint is None else reading.joint for reading in taken]),
        time=_time(data),
        felt=TorqueCalibration(gain, offset).apply(stack(taken, "torque")),
        motor_torque=stack(taken, "motor_torque"),
        target=np.concatenate([_targets(each) for each in data if each.readings]),
        position_sigma=_rounding(readings.position, resolution),
        resolution=resolution,
    )


def _require_one_arm(data: Sequence[SweepData]) -> None:
    if not any(each.readings for each in data):
        raise BadInput("there are no sweep readings: give the directories that sweep wrote")
    first = data[0].manifest
    for each in data[1:]:
        if (each.manifest.names, each.manifest.description_hash) != (first.names, first.description_hash):
            raise BadInput(f"{each.path} was swept on another arm or with another arm file than {data[0].path}")


def _sigma(taken: Sequence[StaticReading], rated: Array) -> Array:
    """Standard deviations of the readings (K, n) [N·m]."""
    std, count = stack(taken, "torque_std"), stack(taken, "count")
    noise = np.sqrt(np.nanmedian(np.where(stack(taken, "counted"), std, np.nan) ** 2, axis=0))
    noise = np.maximum(np.nan_to_num(noise), 0.0)
    unsettled = ~np.array([reading.settled for reading in taken])
    sigma: Array = np.hypot(noise / np.sqrt(count)[:, None], FLOOR * rated)
    swing = np.sqrt(np.maximum(np.nan_to_num(std[unsettled]) ** 2 - noise**2, 0.0))  # NaN: a sensor that was silent
    sigma[unsettled] = np.hypot(UNSETTLED * sigma[unsettled], swing)
    return sigma


def _time(data: Sequence[SweepData]) -> Array:
    """Seconds (K,) since the first reading; a pass begins when the one before it ended."""
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

    A resting joint repeats the same reading, and with it the same error, in many rows, which does not average out.
    """
    sigma = np.zeros(len(resolution))
    for joint in np.flatnonzero(resolution > 0):
        distinct = len(np.unique(np.rint(position[:, joint] / resolution[joint])))
        sigma[joint] = resolution[joint] / np.sqrt(12.0) * np.sqrt(len(position) / distinct)
    return sigma
