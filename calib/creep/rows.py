"""Readings of creep sweeps as one batch of rows: one averaged bin of one joint a row."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armlink.link.types import Sample
from calib.dataset import SweepData
from calib.motion.static_reading import StaticReading, stack
from gcomp.arrays import Array, Mask

LEAST_SAMPLES = 5
"""Samples that a bin has at least."""
STEADY = 0.02
"""Largest difference of a bin's speed from the middle one of its creep, as a share: beyond, inertia takes torque."""
ROUGH = 6.0
"""Where the speeds of a creep scatter more: so many times the middle size of these differences."""
LEAST_TEMPERATURE_SPREAD = 1.0
"""Spread of the logged temperatures from which they, and not time, say how warm a drive is [K]."""


def bin_readings(
    samples: Sequence[Sample], joint: int, side: int, middles: Array, temperature: Array | None = None
) -> list[StaticReading | None]:
    """One reading per bin about `middles` (B,) [rad] of a creep of `joint` in direction `side`; None where it has none.

    A bin is averaged with a Hann window over position, which suppresses ripple whose period is at most half its width.
    Only samples count in which the joint has moved on in its direction: at a reversal friction takes a short way to
    turn round. The reading's `speed` is that of the joint within the bin.
    """
    position, torque, t = stack(samples, "position"), stack(samples, "torque"), np.array([each.t for each in samples])
    whole = np.isfinite(position).all(axis=1) & np.isfinite(torque[:, joint])
    position, torque, t = position[whole], torque[whole], t[whole]
    width = float(middles[1] - middles[0])
    own = position[:, joint]
    return [
        _reading(position, torque, t, np.abs(own - middle) < width / 2, middle, width, joint, side, temperature)
        for middle in middles
    ]


def _reading(
    position: Array, torque: Array, t: Array, inside: Array, middle: float, width: float, joint: int, side: int,
    temperature: Array | None,
) -> StaticReading | None:  # fmt: skip
    if inside.sum() < LEAST_SAMPLES:
        return None
    q, v, when = position[inside], torque[inside], t[inside]
    weight = 1 + np.cos(2 * np.pi * (q[:, joint] - middle) / width)
    weight /= weight.sum()
    centred = when - when.mean()
    speed = float(centred @ q[:, joint]) / max(float(centred @ centred), 1e-12)
    if speed * side <= 0:
        return None
    mean_q, mean_v = weight @ q, weight @ v
    return StaticReading.of(
        float(when.mean()),
        mean_q,
        mean_v,
        count=int(inside.sum()),
        settled=True,
        position_std=np.sqrt(np.maximum(weight @ (q - mean_q) ** 2, 0.0)),
        torque_std=np.sqrt(np.maximum(weight @ (v - mean_v) ** 2, 0.0)),
        motor_torque=mean_v,
        speed=abs(speed),
        temperature=temperature,
    )


@dataclass(frozen=True, eq=False)
class CreepRows:
    """R rows; the reading is the drive's own torque, before any calibration in the host."""

    joint: NDArray[np.int64]
    """Joint that crept (R,)."""
    position: Array
    """Mean position readings of all joints (R, n) [rad]."""
    reading: Array
    """Mean torque reading of the creeping joint (R,) [N·m]."""
    velocity: Array
    """Its mean velocity, with sign (R,) [rad/s]."""
    mass: Array
    """Reference mass attached (R,) [kg]."""
    warmth: Array
    """Temperature against that at the end of the last pass [K], or share of the time until then less 1 (R,)."""
    sweep: NDArray[np.int64]
    """Number of the sweep that a row belongs to, both ways, over all passes (R,)."""
    sweeps: tuple[str, ...]
    """Name of each sweep, with its pass."""
    by_temperature: bool
    """Whether `warmth` is in kelvin."""
    warmest: Array
    """Temperature of each joint's drive at which warmth is 0 (n,) [°C]; NaN where it is not in kelvin."""

    def __len__(self) -> int:
        return len(self.joint)

    @property
    def side(self) -> Array:
        """Direction of motion, ±1 (R,)."""
        return np.sign(self.velocity)

    def kept(self, mask: Mask) -> Self:
        names = ("joint", "position", "reading", "velocity", "mass", "warmth", "sweep")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    @classmethod
    def of(cls, passes: Sequence[SweepData]) -> Self:
        """All readings of the passes at steady speed, in the order in which they were made."""
        ordered = sorted(passes, key=lambda data: (data.manifest.created, data.path.name))
        found: list[tuple[StaticReading, SweepData, float, str]] = []
        clock = 0.0
        for number, data in enumerate(ordered, start=1):
            own = [each for each in data.readings if each.speed is not None]
            shift = max(clock - min((each.t for each in own), default=clock), 0.0)
            found += [(each, data, each.t + shift, f"pass {number}, {each.sweep}") for each in own]
            clock = max((each.t + shift for each in own), default=clock)
        readings = [each for each, *_ in found]
        joint = np.array([each.joint for each in readings], dtype=np.int64)
        raw = [data.manifest.installed.apply(each.torque) for each, data, *_ in found]
        rows = np.arange(len(joint))
        names = tuple(dict.fromkeys(name for *_, name in found))
        side = np.array([each.direction.sum() for each in readings])
        warmth, warmest = _warmth(readings, joint, np.array([t for *_, t, _ in found]), ordered)
        made = cls(
            joint=joint,
            position=np.array([each.position for each in readings]),
            reading=np.array(raw)[rows, joint],
            velocity=side * np.array([each.speed for each in readings]),
            mass=np.array([data.manifest.reference_mass for _, data, *_ in found]),
            warmth=warmth,
            sweep=np.array([names.index(name) for *_, name in found], dtype=np.int64),
            sweeps=names,
            by_temperature=bool(np.isfinite(warmest).any()),
            warmest=warmest,
        )
        return made.kept(_steady(made))


def _steady(rows: CreepRows) -> Mask:
    """Rows at the constant speed of their creep (R,): a loop that still settles at its beginning speeds up or slows."""
    steady = np.ones(len(rows), dtype=bool)
    for sweep in range(len(rows.sweeps)):
        for side in (-1.0, 1.0):
            own = np.flatnonzero((rows.sweep == sweep) & (rows.side == side))
            if own.size:
                speed = np.abs(rows.velocity[own])
                off = np.abs(speed / np.median(speed) - 1)
                steady[own] = off <= max(STEADY, ROUGH * float(np.median(off)))
    return steady


def _warmth(
    readings: list[StaticReading], joint: NDArray[np.int64], t: Array, passes: Sequence[SweepData]
) -> tuple[Array, Array]:
    """(How much colder each row's drive was than at the end (R,), temperature of each drive then (n,) [°C] or NaN)."""
    n = len(passes[0].manifest.names) if passes else 0
    temperature = np.array([each.temperature[j] for each, j in zip(readings, joint, strict=True)])
    known = bool(np.isfinite(temperature).all())
    if known and np.ptp(temperature) >= LEAST_TEMPERATURE_SPREAD:
        warm = np.array([temperature[joint == j].max(initial=-np.inf) for j in range(n)])
        return temperature - warm[joint], np.where(np.isfinite(warm), warm, np.nan)
    span = max(float(np.ptp(t)), 1.0) if len(t) else 1.0
    return (t - t.max(initial=0.0)) / span, np.full(n, np.nan)
