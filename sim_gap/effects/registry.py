"""What an effect is to the diagnosis, and the list of all of them: one small file a family."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import ClassVar

import numpy as np

from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

FAMILIES = (
    "friction",
    "link",
    "base",
    "position",
    "torque",
    "sensor_nonlinearity",
    "timing",
    "transmission",
    "elasticity_backlash",
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
    what is wrong with the links does not show there; where there is none, it is `tau_motor` − model. The command row is
    `tau_cmd` − `tau_motor`, or at a joint where that estimate is noisy, `tau_cmd` − `tau` or − model (`passed_over`).
    """

    n: int
    sensor: str | None
    motor: str | None
    command: str | None = None
    passed_over: tuple[int, ...] = ()
    """How many channels the command of each joint is compared beyond: 0 with the motor's, 1 with the next, then the
    model; empty is 0 everywhere."""

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

    @property
    def chain(self) -> tuple[str, ...]:
        """Channels from the command down to the model, without these two."""
        return tuple(channel for channel in (self.motor, self.sensor) if channel)

    def beyond(self, joint: int) -> int:
        """How many channels of the chain the joint's command is compared beyond."""
        return self.passed_over[joint] if self.passed_over else 0

    def reference(self, row: Row) -> str | None:
        """The channel that a row is compared with; None is the model."""
        chain: tuple[str | None, ...] = (*((self.command,) if self.command else ()), *self.chain, None)
        ahead = self.beyond(row[1]) if row[0] == self.command else 0
        return chain[chain.index(row[0]) + 1 + ahead]

    def compared(self, rows: Columns) -> Columns:
        """Columns (or residuals) as each channel is compared with the next, as they are with the rows' references."""
        out = dict(rows)
        for joint in range(self.n if self.command else 0):
            parts = [(channel, joint) for channel in (self.command, *self.chain[: self.beyond(joint)]) if channel]
            there = [rows[part] for part in parts if part in rows]
            if there:
                out[str(self.command), joint] = np.sum(there, axis=0)
        return out

    def sensor_columns(self, joint: int, column: Array) -> Columns:
        """A term of the sensor's reading: with its sign in the sensor row, against it in motor − sensor."""
        if self.sensor is None:
            return {(self.motor_side, joint): column}
        out = {(self.sensor, joint): column}
        return out | ({(self.motor, joint): -column} if self.motor else {})


DOUBTED, DOUBTED_INNER = 0.01, 0.003
"""Share of a joint's torque by which the model, and the friction between motor and sensor, may be wrong unfound."""
QUIETER = 0.5
"""A command is compared beyond the motor's estimate where that lets less than this share of the doubt in."""


def layout_of(signals: list[Signals]) -> Layout:
    """The channels that all recordings have, and what each joint's command is best compared with."""
    common = set.intersection(*(set(s.channels) for s in signals))
    sensor = "tau" if "tau" in common else None
    motor = next((channel for channel in ("tau_motor", "tau_cmd") if channel in common), None)
    command = "tau_cmd" if {"tau_motor", "tau_cmd"} <= common else None
    n = signals[0].n
    if command is None:
        return Layout(n, sensor, motor)
    torque = np.sqrt(np.mean([np.mean(s.model**2, axis=0) for s in signals], axis=0))
    doubts = [_noise(signals, "tau_motor"), DOUBTED * torque]
    if sensor:
        doubts.insert(1, np.hypot(_noise(signals, sensor), DOUBTED_INNER * torque))
    doubt = np.array(doubts)
    best = np.argmin(doubt, axis=0)
    clear = doubt[best, np.arange(n)] < QUIETER * doubt[0]
    return Layout(n, sensor, motor, command, tuple(np.where(clear, best, 0).tolist()))


def _noise(signals: list[Signals], channel: str) -> Array:
    """Noise of a channel that the command does not have as well, (n,): no more than what their difference shows."""
    told = [
        np.minimum(s.noise[channel], s.upper_half(s.filtered(s.reading["tau_cmd"] - s.reading[channel])))
        for s in signals
    ]
    return np.asarray(np.mean(told, axis=0))


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
    usual: ClassVar[float] = 0.0
    """About which its coefficients are spread: 1 where the shape says all and they need not be seen to be known."""
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
        """Prior standard deviation of each coefficient from `usual`, its largest plausible size, (p,); or infinite."""
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
