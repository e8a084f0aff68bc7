"""One reading: averages over samples of an arm at rest or of a creeping joint, and several of them as a batch.

When a joint is at rest, and its average exact enough, is judged from the samples, not from a fixed sleep.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from armlink.link.types import Sample
from calib.arm.sweep_section import SweepSection
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings

DRIFT = 2.5
"""Standard errors by which the means of the window's halves may differ."""
WINDOW_TIMES = 3.0
"""Time constants of the slowest position loop in a window: what drifts more slowly is what one would call creep."""
FEWEST_READINGS = 8
"""Torque readings in a window, at the least."""
QUIET = 1.0
"""Torque scatter that is this many times the standard error asked for has settled whatever its shape."""


@dataclass(frozen=True, eq=False)
class SettleRule:
    """The rule of one arm; all arrays (n,)."""

    window: int
    """Cycles over which it judges."""
    timeout: int
    """Cycles after which a reading is taken as it is."""
    max_samples: int
    span: float
    """Half of what a joint at rest may cover during the window [rad]."""
    scatter: float
    standard_error: Array
    """Asked for [N·m]."""

    @classmethod
    def of(
        cls,
        section: SweepSection,
        standard_error: Array,
        period: float,
        slowest: float = 0.0,
        torque_cycles: int = 1,
    ) -> "SettleRule":
        """From the sweep section; standard error (n,) [N·m] of each reading, cycle `period` [s].

        `slowest` is the longest time constant of the position loops [s], 0 where the drives close them: the window
        covers WINDOW_TIMES of it, unless the arm file names the window. A shorter one takes the slow end of a motion,
        or the turning point of a slow swing, for rest.
        """
        seconds = section.settle_window
        if "settle_window" not in section.model_fields_set:
            seconds = max(seconds, WINDOW_TIMES * slowest)
        window = max(round(seconds / period), FEWEST_READINGS * torque_cycles)
        return cls(
            window=window,
            timeout=round(section.settle_timeout / period),
            max_samples=max(section.max_samples, window),
            span=section.settle_velocity * window * period / 2,
            scatter=section.settle_scatter,
            standard_error=standard_error,
        )

    def settled(self, position: Array, torque: Array, counts: Mask, resolution: Array) -> bool:
        """Whether nothing moves any more: position and torque (W, n) of the last window.

        A joint moves if its position covers more than twice `span` and more than one step of its sensor (an overshoot
        that is turning back covers as much as one that is under way). A torque that `counts` (n,) has settled if it
        scatters no more than its own sample-to-sample noise explains (von Neumann's ratio) and does not drift between
        the window's halves, or scatters too little to matter.
        """
        covered = np.nanmax(position, axis=0) - np.nanmin(position, axis=0)
        if np.any(covered > np.maximum(2 * self.span, 1.5 * resolution)):
            return False
        joints = zip(torque.T, self.standard_error, counts, strict=True)
        return all(self._is_steady(x[np.isfinite(x)], error) for x, error, counted in joints if counted)

    def _is_steady(self, torque: Array, standard_error: float) -> bool:
        """Whether a joint's torque readings (k,) have settled."""
        half = len(torque) // 2
        if half < 2:
            return False
        drift, step = torque[half:].mean() - torque[:half].mean(), float(np.mean(np.diff(torque) ** 2)) / 2
        allowed = max(self.scatter**2 * step, (QUIET * standard_error) ** 2)
        steady = drift**2 <= DRIFT**2 * max(step, standard_error**2) * 4 / len(torque)
        return bool(steady and torque.var() <= allowed)

    def exact(self, torque: Array, counts: Mask) -> bool:
        """Whether the mean of the torque samples (K, n) is as exact as asked for, in every joint that `counts`."""
        error = np.nanstd(torque, axis=0, ddof=1) / np.sqrt(np.isfinite(torque).sum(axis=0))
        return bool(np.all((error <= self.standard_error) | ~counts))


LEAST_SAMPLES = 5
"""Samples that the average of a bin of a creep, or of a stretch of motion, has at least."""


@dataclass(frozen=True)
class _Json:
    """How pydantic reads and writes an array: as JSON of type `kind`, made by `write`."""

    kind: Any
    write: Callable[[Any], Any] = np.ndarray.tolist

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler.generate_schema(self.kind)
        writer = core_schema.plain_serializer_function_ser_schema(self.write, return_schema=schema)
        return core_schema.no_info_after_validator_function(np.array, schema, serialization=writer)


Vector = Annotated[Array, _Json(list[float])]


@dataclass(frozen=True, eq=False, kw_only=True)
class StaticReading:
    """Averages of one static reading of n joints; also a line of a sweep data set, with the keys in this order."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    kind: Literal["reading"] = "reading"
    """Marks the line in a data set."""
    sweep: str
    """Name of the sweep, or "scout"; empty outside of sweeps."""
    index: int
    """Number of the reading within its sweep."""
    joint: int | None
    """Index of the swept joint; None if no joint was swept alone."""
    direction: Annotated[Array, _Json(Literal[-1, 0, 1], lambda direction: int(direction.sum()))]
    """Sign of each joint's last motion (n,); 0 if unknown. A data set keeps the swept joint's alone, as one number."""
    t: float
    """Time on the clock of its samples [s]: of the last one in a sweep, of the middle of the average elsewhere."""
    count: int
    """Samples averaged."""
    settled: bool
    """False if the settle rule ran out of time."""
    servo: Annotated[Mask, _Json(list[bool])]
    """Joints held by their position loop (n,): their torque sensors read gravity, as the swept joint's does."""
    position: Vector
    """Mean position reading (n,) [rad]."""
    position_std: Vector
    torque: Vector
    """Mean torque sensor reading (n,) [N·m]."""
    torque_std: Vector
    """Standard deviation of one sample (n,) [N·m]."""
    motor_torque: Vector
    """Mean of the drives' own torque estimate (n,) [N·m]; NaN if a drive reports none."""
    speed: Annotated[float | None, Field(exclude_if=lambda value: value is None)] = None
    """Mean speed of the swept joint, which crept through the average [rad/s]; None, and not written, at rest."""
    temperature: Annotated[Vector, Field(exclude_if=lambda values: bool(np.isnan(values).all()))] = field(
        default_factory=lambda: np.array(np.nan)
    )
    """Of the drives (n,) [°C], NaN where one does not tell it; not written where none does."""
    torque_error: Annotated[Vector, Field(exclude=True)] = field(default_factory=lambda: np.array(np.nan))
    """Standard error of the mean torque (n,) as the halves of the average show it [N·m]; NaN if not judged so."""

    def __post_init__(self) -> None:
        if np.ndim(self.temperature) == 0:
            object.__setattr__(self, "temperature", np.full(len(self.position), np.nan))
        if np.ndim(self.direction) == 0:
            moved = np.arange(len(self.position)) == (-1 if self.joint is None else self.joint)
            object.__setattr__(self, "direction", np.where(moved, self.direction, 0.0))

    @classmethod
    def of(
        cls, t: float, position: Array, torque: Array, direction: Array | None = None, **known: Any
    ) -> "StaticReading":
        """A reading outside of any sweep, every sensor counted; statistics that are not `known` are NaN."""
        n = len(position)
        nothing = {name: np.full(n, np.nan) for name in ("position_std", "torque_std", "motor_torque", "torque_error")}
        held = {"sweep": "", "index": 0, "joint": None, "count": 1, "settled": True, "servo": np.ones(n, dtype=bool)}
        sides = np.zeros(n) if direction is None else direction
        return cls(**{**held, **nothing, **known}, t=t, position=position, torque=torque, direction=sides)

    @classmethod
    def of_motion(
        cls, t: float, joint: int, position: Array, torque: float, velocity: float, temperature: float
    ) -> "StaticReading":
        """A reading of one joint at a steady velocity [rad/s], the torque [N·m] of its own motor alone; its drive's
        temperature [°C] is NaN if it is not known."""
        own = np.arange(len(position)) == joint
        return cls.of(
            t,
            position,
            np.where(own, torque, np.nan),
            own * np.sign(velocity),
            joint=joint,
            servo=np.zeros(len(position), dtype=bool),
            speed=abs(velocity),
            temperature=np.where(own, temperature, np.nan),
        )

    def within(self, sweep: str, index: int, servo: Mask, joint: int | None = None, direction: int = 0) -> Self:
        """The same as reading `index` of a sweep of `joint`, approached in `direction`, `servo` (n,) joints held."""
        return replace(self, sweep=sweep, index=index, servo=servo, joint=joint, direction=np.array(direction))

    @property
    def counted(self) -> Mask:
        """Joints whose torque sensor reads gravity (n,)."""
        swept = np.arange(len(self.position)) == (-1 if self.joint is None else self.joint)
        return np.asarray(self.servo | swept, dtype=bool)


def stack(each: Sequence[Sample] | Sequence[StaticReading], channel: str) -> Array:
    """One channel of samples or readings (K, n)."""
    return np.array([getattr(one, channel) for one in each])


def batch(readings: Sequence[StaticReading], sigma: ArrayLike) -> StaticReadings:
    """Readings as a batch; `sigma` (K, n), (n,) or a number is the standard deviation of a torque [N·m]."""
    torque = np.where(stack(readings, "counted"), stack(readings, "torque"), np.nan)
    made = StaticReadings.of(stack(readings, "position"), torque, sigma)
    speed = np.array([each.speed or 0.0 for each in readings])[:, None]
    return replace(made, direction=stack(readings, "direction"), velocity=speed * stack(readings, "direction"))


def slope(t: Array, values: Array) -> Array:
    """Mean rate of change of values (K, …) over times (K,) [s], by least squares."""
    centred = t - t.mean()
    return np.asarray(centred @ (values - values.mean(axis=0)) / max(float(centred @ centred), 1e-12))


def average(samples: Sequence[Sample], settled: bool) -> StaticReading:
    """Averages of samples; missing values are left out."""
    position, torque, motor = (stack(samples, name) for name in ("position", "torque", "motor_torque"))
    reported = np.isfinite(motor).sum(axis=0)
    mean = np.nansum(motor, axis=0) / np.maximum(reported, 1)
    return StaticReading.of(
        samples[-1].t,
        np.nanmean(position, axis=0),
        np.nanmean(torque, axis=0),
        count=int(np.isfinite(torque).all(axis=1).sum()),
        settled=settled,
        position_std=np.nanstd(position, axis=0),
        torque_std=np.nanstd(torque, axis=0, ddof=1),
        motor_torque=np.where(reported > 0, mean, np.nan),
    )


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
    found: list[StaticReading | None] = [None] * len(middles)
    for place, middle in enumerate(middles):
        inside = np.abs(position[:, joint] - middle) < width / 2
        q, v, when = position[inside], torque[inside], t[inside]
        if len(q) < LEAST_SAMPLES:
            continue
        speed = float(slope(when, q[:, joint]))
        if speed * side <= 0:
            continue
        weight = 1 + np.cos(2 * np.pi * (q[:, joint] - middle) / width)
        weight /= weight.sum()
        mean_q, mean_v = weight @ q, weight @ v
        found[place] = StaticReading.of(
            float(when.mean()),
            mean_q,
            mean_v,
            count=len(q),
            settled=True,
            position_std=np.sqrt(np.maximum(weight @ (q - mean_q) ** 2, 0.0)),
            torque_std=np.sqrt(np.maximum(weight @ (v - mean_v) ** 2, 0.0)),
            motor_torque=mean_v,
            speed=abs(speed),
            temperature=temperature,
        )
    return found
