"""What an effect is to the diagnosis, and the list of all of them: one small file a family."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import ClassVar

import numpy as np

from sim_gap.rigid import Array
from sim_gap.signals import Signals

FAMILIES = (
    "friction",
    "link",
    "base",
    "position",
    "torque",
    "bending",
    "timing",
    "transmission",
    "soft",
    "actuator",
    "drive",
    "laws",
)
"""Modules of this package, one a family."""
Row = tuple[str, int]
"""A channel and a joint's index: one residual over time."""
Columns = dict[Row, Array]
"""How an effect shows: at each row that it touches, one column per coefficient, (K, p)."""
Shape = tuple[float, ...]
"""Nonlinear parameters of an effect, such as its Stribeck velocity."""


@dataclass(frozen=True)
class Parameter:
    """One reported parameter of an effect."""

    name: str
    unit: str


@dataclass(frozen=True)
class Layout:
    """Which channels a data set has, and what each is compared with.

    The sensor row of a joint is `tau` − model. Where there is a sensor, the motor row is `tau_motor` − `tau`, so that
    what is wrong with the links does not show there; where there is none, it is `tau_motor` − model.
    """

    n: int
    sensor: str | None
    motor: str | None
    command: str | None = None

    @property
    def rows(self) -> tuple[Row, ...]:
        """All residuals: sensor rows first, base to tip, then motor rows, then command rows."""
        channels = [channel for channel in (self.sensor, self.motor, self.command) if channel]
        return tuple((channel, joint) for channel in channels for joint in range(self.n))

    @property
    def against_model(self) -> str:
        """The channel in which links and positions show: the sensor's, else the motor's."""
        channel = self.sensor or self.motor
        assert channel is not None
        return channel

    @property
    def motor_side(self) -> str:
        """The channel in which friction shows: the motor's; where there is none, the only one there is."""
        channel = self.motor or self.sensor
        assert channel is not None
        return channel

    def sensor_columns(self, joint: int, column: Array) -> Columns:
        """A term of the sensor's reading: with its sign in the sensor row, against it in motor − sensor."""
        if self.sensor is None:
            return {(self.motor_side, joint): column}
        out = {(self.sensor, joint): column}
        return out | ({(self.motor, joint): -column} if self.motor else {})


NOISY, QUIETER = 0.05, 0.2
"""A sensor tells nothing where at every joint its noise exceeds this share of the torque; the command is then compared
with the model where its own noise is less than this share of the sensor's."""


def layout_of(signals: list[Signals]) -> Layout:
    """The channels that all recordings have; of these the command alone where all others drown in noise."""
    common = set.intersection(*(set(s.channels) for s in signals))
    others = common - {"tau_cmd"}
    if "tau_cmd" in common and others and all(_drowned(s, channel) for s in signals for channel in others):
        return Layout(signals[0].n, None, "tau_cmd")
    sensor = "tau" if "tau" in common else None
    motor = next((channel for channel in ("tau_motor", "tau_cmd") if channel in common), None)
    command = "tau_cmd" if {"tau_motor", "tau_cmd"} <= common else None
    return Layout(signals[0].n, sensor, motor, command)


def _drowned(s: Signals, channel: str) -> bool:
    """Whether noise hides what a channel reads, and the command is much quieter."""
    noise, torque = s.noise[channel], np.sqrt(np.mean(s.model**2, axis=0))
    return bool(np.all(noise > NOISY * torque) and np.all(s.noise["tau_cmd"] < QUIETER * noise))


class Effect(ABC):
    """The inverse form of one effect: how it shows in a recording, linear in its coefficients at a given shape."""

    id: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    needs: ClassVar[tuple[str, ...]] = ()
    """Effects at the same place that it stands upon: the simpler model beneath it."""
    shapes: ClassVar[tuple[Shape, ...]] = ((),)
    """Shapes tried at first; the best is then refined between its neighbours."""
    rare: ClassVar[int] = 3
    """What it must earn besides, in parameters: 0 for what every arm has, more for what few have."""
    ordinary: ClassVar[float] = 0.0
    """What every arm has of it, as a standard deviation of each coefficient: an interval leaves room for it."""
    counted: ClassVar[frozenset[int]] = frozenset()
    """Which entries of the shape are numbers of something (a joint): they are not refined."""
    whole_arm: ClassVar[bool] = False
    general: ClassVar[bool] = False
    """Whether it is no effect of the library but a law that causes are compared with."""
    secant: ClassVar[bool] = False
    """Whether the shape is the size at which a curved effect's secant is taken: set to the fit, then exact."""

    def places(self, layout: Layout) -> range:
        """Joints or links at which it may sit; empty where these channels cannot show it."""
        return range(1) if self.whole_arm else range(layout.n)

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        """Shapes to start from on these recordings; by default `shapes`."""
        return self.shapes

    def resized(self, coefficients: Array, shape: Shape) -> Shape:
        """The shape that these coefficients ask for, where the effect is fitted by its secant."""
        return (float(coefficients[0]),)

    def covers(self, layout: Layout, place: int) -> tuple[tuple[str, int], ...]:
        """Effects and places whose columns this one contains: they do not stand beside it."""
        return ()

    def settled(self, place: int, shape: Shape) -> tuple[int, Shape]:
        """Place and shape by which it is named, where two show exactly alike."""
        return place, shape

    def bound_to(self, shape: Shape) -> int:
        """The one training recording (from 1) that it is in, 0 where it belongs to the arm for good."""
        return 0

    def made_of(self, layout: Layout, place: int, shape: Shape) -> tuple[tuple[str, int], ...]:
        """Simpler effects and places that together could stand in its place; it must do better than they."""
        return ()

    @abstractmethod
    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        """Its columns at the work rate."""

    def spread(self, signals: Signals, place: int) -> Array:
        """Largest plausible size of each coefficient (a prior standard deviation), (p,); infinite where open."""
        return np.full(1, np.inf)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        """Whether such an effect can exist: friction opposes motion, masses are positive, delays are not foresight."""
        return True

    def plausible_on(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> bool:
        """`plausible`, where that depends on the coefficients of what it stands upon."""
        return self.plausible(coefficients, shape)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        """Reported parameters, one per `parameters`.

        `beneath` holds the coefficients of what it stands upon, and as `nominal` the model's own friction loss.
        """
        return coefficients


@cache
def effects() -> dict[str, Effect]:
    """All effects and general laws by id."""
    found = [effect for family in FAMILIES for effect in import_module(f"sim_gap.effects.{family}").EFFECTS]
    return {effect.id: effect for effect in found}


def library_without(withheld: Sequence[str]) -> list[str]:
    """Ids of the effects that remain where some are taken out: what stands upon one of these goes with it."""
    return [
        name for name, effect in effects().items() if not effect.general and not {name, *effect.needs} & {*withheld}
    ]
