"""The readings of sweep data sets as the fits take them: which count, how exact each is, where it comes from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from armlink.errors import BadInput
from armlink.torque_calibration import TorqueCalibration
from calib.dataset import SweepData, all_creep, labels
from calib.motion.static_reading import StaticReading, stack
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings

UNSETTLED = 3.0
"""Factor on the standard deviation of a reading that was taken before it had settled. What its samples scatter beyond
their noise, by a swing or a creep, is added whole: averaging does not reduce it."""
FLOOR = 2e-5
"""Smallest standard deviation of a reading, as a share of rated torque: the resolution of a sensor."""
FEWEST = 6
"""Readings of a joint below which nothing is judged by them: a standard error would be meaningless."""
STEADY = 0.02
"""Largest difference of a bin's speed from the middle one of its creep, as a share: beyond, inertia takes torque."""
ROUGH = 6.0
"""Where the speeds of a creep scatter more: so many times the middle size of these differences."""
LEAST_TEMPERATURE_SPREAD = 1.0
"""Spread of the logged temperatures from which they, and not time, say how warm a drive is [K]."""


@dataclass(frozen=True, eq=False)
class SweepReadings:
    """K readings of n joints from all passes, at rest or creeping, with what the data sets know of them."""

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
    warmest: Array
    """Temperature of each joint's drive at which its warmth is 0 (n,) [°C]; NaN where warmth is not in kelvin."""

    def __len__(self) -> int:
        return len(self.swept)

    def swept_value(self, values: Array) -> Array:
        """Of values (K, n), those of the swept joint (K,)."""
        return values[np.arange(len(self)), self.swept]

    @property
    def reading(self) -> Array:
        """Torque reading of the swept joint (K,) [N·m]."""
        return self.swept_value(self.readings.torque)

    @property
    def side(self) -> Array:
        """Direction of the swept joint, ±1 (K,)."""
        return self.swept_value(self.readings.direction)

    @property
    def by_temperature(self) -> bool:
        """Whether warmth is in kelvin."""
        return bool(np.isfinite(self.warmest).any())

    def kept(self, mask: Mask) -> Self:
        rows = ("swept", "time", "felt", "motor_torque", "target")
        return replace(self, readings=self.readings.rows(mask), **{name: getattr(self, name)[mask] for name in rows})

    @property
    def own(self) -> Mask:
        """Readings of the swept joint's own sensor (K, n)."""
        return np.asarray(np.arange(self.readings.position.shape[1]) == self.swept[:, None])

    @property
    def masses(self) -> tuple[float, ...]:
        """Reference masses in the data, sorted [kg]; 0 for none."""
        return tuple(sorted(set(self.readings.load.tolist())))


def sweep_readings(data: Sequence[SweepData]) -> SweepReadings:
    """All readings of data sets of one arm; raises BadInput if there are none or the arms differ.

    Of creeps, those at steady speed, in the order in which the passes were made.
    """
    _require_one_arm(data)
    if all_creep(data):
        data = sorted(data, key=lambda each: (each.manifest.created, each.path.name))
    taken = [reading for each in data for reading in each.readings]
    folders = labels([each.path for each in data])
    names = [f"{folder}/{reading.sweep}" for folder, one in zip(folders, data, strict=True) for reading in one.readings]
    source = np.repeat(np.arange(len(data)), [len(each.readings) for each in data])
    sweeps = tuple(dict.fromkeys(names))
    sigma = _sigma(taken, np.array(data[0].manifest.rated_torque))
    resolution = np.max([each.resolution for each in data], axis=0)
    gain = np.array([each.manifest.installed_gain for each in data])[source]
    offset = np.array([each.manifest.installed_offset for each in data])[source]
    felt, time = TorqueCalibration(gain, offset).apply(stack(taken, "torque")), _time(data)
    swept = np.array([-1 if reading.joint is None else reading.joint for reading in taken])
    own = np.arange(len(resolution)) == swept[:, None]
    speed = np.array([each.speed or 0.0 for each in taken])
    creeping = (speed > 0)[:, None]
    warmth, warmest = _warmth(stack(taken, "temperature"), own & creeping, time)
    direction = stack(taken, "direction")
    readings = StaticReadings(
        stack(taken, "position"),
        np.where(np.where(creeping, own, stack(taken, "counted")), felt, np.nan),
        sigma,
        load=np.array([each.manifest.reference_mass for each in data])[source],
        direction=direction,
        series=np.array([sweeps.index(name) for name in names]),
        velocity=direction * speed[:, None],
        warmth=warmth,
    )
    found = SweepReadings(
        readings=readings,
        sweeps=sweeps,
        swept=swept,
        time=time,
        felt=felt,
        motor_torque=stack(taken, "motor_torque"),
        target=np.concatenate([_targets(each) for each in data if each.readings]),
        position_sigma=_rounding(readings.position, resolution),
        resolution=resolution,
        warmest=warmest,
    )
    return found.kept(steady(found))


def steady(rows: SweepReadings) -> Mask:
    """Rows at rest, or at the constant speed of their creep (K,): a loop that still settles at its beginning speeds up
    or slows."""
    found, speed = np.ones(len(rows), dtype=bool), np.abs(rows.readings.velocity).max(axis=1)
    for sweep in range(len(rows.sweeps)):
        for side in (-1.0, 1.0):
            own = np.flatnonzero((rows.readings.series == sweep) & (rows.side == side) & (speed > 0))
            if own.size:
                off = np.abs(speed[own] / np.median(speed[own]) - 1)
                found[own] = off <= max(STEADY, ROUGH * float(np.median(off)))
    return found


def _warmth(temperature: Array, creeping: Mask, time: Array) -> tuple[Array, Array]:
    """(How much colder each creeping drive was than at the end (K, n), its temperature then (n,) [°C] or NaN)."""
    nowhere = np.full(creeping.shape[1], np.nan)
    if not creeping.any():
        return np.zeros(creeping.shape), nowhere
    own = temperature[creeping]
    if np.isfinite(own).all() and np.ptp(own) >= LEAST_TEMPERATURE_SPREAD:
        warmest = np.max(temperature, axis=0, where=creeping, initial=-np.inf)
        return np.where(creeping, temperature - warmest, 0.0), np.where(np.isfinite(warmest), warmest, np.nan)
    since = time[creeping.any(axis=1)]
    share = (time - since.max()) / max(float(np.ptp(since)), 1.0)
    return np.where(creeping, share[:, None], 0.0), nowhere


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
