"""The inverse form of an effect: how it shows (`Signature`), what is plausible, and hints to the search."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armlink.effect_catalogue import CATALOGUE
from gcomp.arrays import Array
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals

Shape = tuple[float, ...]
"""Nonlinear parameters of an effect, such as its Stribeck velocity."""
Key = tuple[str, int]
"""Id of an effect and the index of a joint or link (0 for the whole arm)."""
Starts = Callable[[Sequence[PreparedSignals], int], tuple[Shape, ...]]
"""Shapes to start with, of recordings and place."""
Column = Callable[[PreparedSignals, int, Shape], Array]
"""The columns of an effect at one place, (K,) or (K, p), from signals, place and shape."""
Beneath = Mapping[str, Array]
"""Coefficients of the effects that one needs, by id. `nominal`: friction loss [N·m] of the joint in the model."""


@dataclass(frozen=True)
class Ratings:
    """How large effects can be at a joint, by its drive, its model and an estimate."""

    friction: float
    damping: float
    armature: float
    """Of the joint in the model, as far as a motor reads it [N·m; N·m·s/rad; kg·m²]."""
    speed: float
    """Usual speed (RMS) [rad/s]."""
    torque: float
    """Largest torque that the drive was seen to make, and that the model's links ask of it, together [N·m]."""
    tip_mass: float
    mass: float
    """Of the model's last link, and of all its links [kg]."""
    dry: float
    """Dry friction of the joint as estimated, `torque` without an estimate [N·m]."""
    own: Array | None = None
    """Coefficients of the effect itself as estimated."""


Bounds = tuple[Array | float, Array | float]
"""Least and largest coefficients of an effect that can exist."""

Channel = Literal["any", "sensor", "motor", "command"]
"""A channel without which an effect cannot show."""
Side = Literal["link", "motor", "drive", "distortion", "reading", "command"]
"""Where in the chain from link to command an effect acts: on the torque of the links, between link and motor, on the
motor's report of all that, in the sensor before its gain, on the sensor's reading, between command and motor."""
Moves = Callable[[PreparedSignals, ChannelLayout, int], Array]
"""Change of a joint's position, velocity and acceleration per unit of each coefficient, (K, p, 3)."""


@dataclass(frozen=True)
class Signature:
    """How an effect shows in a recording."""

    columns: Callable[[PreparedSignals, ChannelLayout, int, Shape], Columns]
    """Columns at the work rate, by row, linear in the coefficients at a given shape."""
    channel: Channel | tuple[Channel, ...] = "any"
    whole_arm: bool = False
    """Whether it belongs to the arm as a whole instead of to one joint or link."""
    recordings: Callable[[Shape], tuple[int, ...]] = lambda _shape: ()
    """Numbers (from 1) of the recordings that it is present in; empty if it belongs to the arm for good."""
    body: bool = False
    """Whether it is a body that recordings may lack."""
    side: Side = "link"
    of_motion: bool = False
    """Whether its columns follow from positions, time and command alone, whatever an estimate finds of torques."""
    moves: Moves | None = None
    """Of an effect that moves the true joint against its reading."""
    offset: Callable[[PreparedSignals, ChannelLayout, Shape], Columns] | None = None
    """Of a nonlinear effect linearised at its shape: what it is beside its columns, (K,) by row."""

    slopes: Callable[[PreparedSignals, ChannelLayout, Shape, Array], Columns] | None = None
    """Of a nonlinear effect: its columns about fitted coefficients."""

    def places(self, layout: ChannelLayout) -> range:
        """Joints or links at which it may be; empty if these channels cannot show it."""
        channels = {"sensor": layout.sensor, "motor": layout.motor, "command": layout.commanded}
        needed = self.channel if isinstance(self.channel, tuple) else (self.channel,)
        if any(each != "any" and channels[each] is None for each in needed):
            return range(0)
        return range(1 if self.whole_arm else layout.n)

    @classmethod
    def at_motor(
        cls, column: Column, channel: Channel = "any", side: Side = "motor", of_motion: bool = False
    ) -> "Signature":
        """An effect between motor and torque sensor, of one joint."""
        return cls(
            lambda s, layout, j, shape: {(layout.motor_side, j): _2d(column(s, j, shape))},
            channel,
            side=side,
            of_motion=of_motion,
        )

    @classmethod
    def at_sensor(cls, column: Column, channel: Channel = "sensor", side: Side = "reading") -> "Signature":
        """An effect on the torque sensor's reading, of one joint."""
        return cls(lambda s, layout, j, shape: layout.sensor_columns(j, _2d(column(s, j, shape))), channel, side=side)

    @classmethod
    def at_link(cls, column: Column) -> "Signature":
        """An effect on the link side, of one joint: it shows against the model."""
        return cls(lambda s, layout, j, shape: {(layout.against_model, j): _2d(column(s, j, shape))})

    @classmethod
    def at_command(cls, column: Column) -> "Signature":
        """An effect between command and motor torque, of one joint."""
        return cls(
            lambda s, layout, j, shape: {(str(layout.commanded), j): _2d(column(s, j, shape))},
            "command",
            side="command",
            of_motion=True,
        )


def _2d(columns: Array) -> Array:
    return columns[:, None] if columns.ndim == 1 else columns


@dataclass(frozen=True)
class Plausibility:
    """Priors of an effect, and the values that can exist."""

    every_joint: bool = False
    """Whether every joint has it, as all gears rub: then only its size is in question, and it costs nothing."""
    prior_penalty: int = 3
    """Number of extra coefficients that the effect is charged for: 0 if many arms have it, more if few have."""
    prior_mean: float = 0.0
    """Prior mean of the coefficients: 1 if the shape alone determines the effect."""
    prior_std: float | Array | Callable[[PreparedSignals, int], float | Array] = np.inf
    """Prior standard deviation of each coefficient, its largest plausible size, of signals and place; infinite for
    none."""
    background_std: float | Array | Callable[[Shape], float] = 0.0
    """Standard deviation of each coefficient over sound arms, or what is not known of its law, of a shape; confidence
    intervals include it."""
    background_nm: bool = False
    """Whether it is a torque, and so smaller on arms of little strength."""
    bounds: Bounds | Callable[[Ratings, Shape], Bounds] = (-np.inf, np.inf)
    """Least and largest coefficients that can exist, of ratings and shape."""

    def spread(self, signals: PreparedSignals, place: int) -> float | Array:
        return self.prior_std(signals, place) if callable(self.prior_std) else self.prior_std

    def limits(self, ratings: Ratings, shape: Shape) -> Bounds:
        return self.bounds(ratings, shape) if callable(self.bounds) else self.bounds


@dataclass(frozen=True)
class SearchHints:
    """Where the search starts, what it refines, and which simpler effects compete."""

    shapes: tuple[Shape, ...] = ((),)
    """Shapes to start with; the best one is then refined between its neighbours."""
    shapes_for: Starts | None = None
    """The same for given recordings and place."""
    discrete: frozenset[int] = frozenset()
    """Entries of the shape that are the number of something (a joint, a recording): they are not refined."""
    forms: Callable[[Shape], tuple[Shape, ...]] = lambda shape: (shape,)
    """The same effect in other forms, which are compared once it is found."""
    linearised_at: int | None = None
    """Entry of the shape at which a nonlinear effect is linearised, by its secant; None if it is linear."""
    relinearise: Callable[[Array, Shape], Shape] = lambda coefficients, _shape: (float(coefficients[0]),)
    """The shape at which to linearise again, from the coefficients fitted at the last one."""
    covers: Callable[[ChannelLayout, int], tuple[Key, ...]] = lambda _layout, _place: ()
    """Effects whose columns this one contains: they are not fitted beside it."""
    alternatives: Callable[[ChannelLayout, int, Shape], tuple[Key, ...]] = lambda _layout, _place, _shape: ()
    """Simpler effects that together could replace this one; it must do better than they."""
    canonical: Callable[[int, Shape], tuple[int, Shape]] = lambda place, shape: (place, shape)
    """Place and shape under which it is reported, if two of them show alike."""

    def grid(self, signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
        return self.shapes if self.shapes_for is None else self.shapes_for(signals, place)


@dataclass(frozen=True)
class InverseEffect:
    """The inverse form of one effect."""

    id: str
    signature: Signature
    plausibility: Plausibility = Plausibility()
    hints: SearchHints = SearchHints()
    needs: tuple[str, ...] = ()
    """Effects at the same place that it builds on: the simpler model."""
    parameters_of: Callable[[Array, Shape, Beneath], Array | list[float]] = lambda c, _shape, _beneath: c
    """Reported parameters from coefficients, shape and the coefficients of `needs`, in the catalogue's order."""

    @property
    def reported(self) -> tuple[tuple[str, str], ...]:
        return CATALOGUE[self.id].reported


SHORTEST_DELAY = 1e-3
"""Shortest time that counts as a delay or a lag, and by which sound arms have one: between the time of a row and that
at which a channel in it was set or read [s]."""
NEAR_ONE = (0.6, 1.6)
"""Bounds of a coefficient whose effect the shape alone determines."""
CUT_OFF = Plausibility(prior_mean=1.0, prior_std=0.2, bounds=NEAR_ONE)
"""Of a level, beyond which all is cut off."""


def exceeded_levels(signal: Callable[[PreparedSignals, int], Array]) -> Starts:
    """Levels that a signal (K,) of recording and joint exceeds during some of the time, to start with."""
    shares = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.995, 0.999)

    def levels(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
        values = np.abs(np.concatenate([signal(s, place) for s in signals]))
        return tuple((float(level),) for level in np.quantile(values, shares))

    return levels


def delay_effect(effect_id: str, signature: Signature, start: float, longest: float) -> InverseEffect:
    """An effect whose shape is a time: the search starts at `start` and goes up to `longest` [s]."""

    def relinearise(coefficients: Array, shape: Shape) -> Shape:
        return (float(np.clip(coefficients[0] * shape[0], SHORTEST_DELAY, longest)),)

    return InverseEffect(
        effect_id,
        signature,
        Plausibility(
            background_std=lambda shape: SHORTEST_DELAY / shape[0],
            bounds=lambda _ratings, shape: (SHORTEST_DELAY / shape[0], longest / shape[0]),
        ),
        SearchHints(shapes=((start,),), linearised_at=0, relinearise=relinearise),
        parameters_of=lambda c, shape, _: c * shape[0],
    )
