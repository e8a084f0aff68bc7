"""One effect as drawn for one arm, and how its magnitude is chosen."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armlink.effect_catalogue import CATALOGUE
from gcomp.arrays import Array, Mask
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

SENSOR_LEAST = 0.12
MOTOR_LEAST = 0.3
"""Least RMS that an effect causes in its channel [N·m], for every torque."""
SHARES = (0.06, 0.14)
"""RMS that an effect causes, as a share of the joint's RMS torque: several times that of small background errors."""
OFTEN = 0.08
"""Torque reversals per second from which effects at a reversal show."""

Values = dict[str, float]
Apply = Callable[[TrueArm], None]


@dataclass(frozen=True)
class DrawnEffect:
    effect: str
    parameters: dict[str, Values]
    """By joint name (`arm` for the whole arm); named as a diagnosis reports them."""
    apply: Apply
    """Puts the effect into the true arm."""
    nominal: Callable[[BenchArm], BenchArm] | None = None
    """Changes the nominal model, if need be."""
    implied: tuple[str, ...] = ()
    """Simpler effects that are part of it and may correctly be named as well."""
    undecided: str = ""
    """Why slow motion may not separate it from another effect; empty if the recording can."""
    confused_with: tuple[str, ...] = ()
    """Effects that are an equally good answer if it is undecided."""

    def __post_init__(self) -> None:
        """Raise ValueError for a parameter that is not in the catalogue."""
        known = {name for name, _ in CATALOGUE[self.effect].reported}
        if unknown := {name for values in self.parameters.values() for name in values} - known:
            raise ValueError(f"{self.effect}: {', '.join(sorted(unknown))} not in the catalogue")

    @classmethod
    def at(
        cls,
        scene: Scene,
        joint: int,
        effect: str,
        values: Values,
        apply: Apply,
        nominal: Callable[[BenchArm], BenchArm] | None = None,
        implied: tuple[str, ...] = (),
        undecided: str = "",
        confused_with: tuple[str, ...] = (),
    ) -> "DrawnEffect":
        name = scene.arm.names[joint]
        return cls(effect, {name: values}, apply, nominal, implied, undecided, confused_with)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of its joints; empty for the whole arm."""
        return tuple(name for name in self.parameters if name != "arm")


Draw = Callable[[Scene, np.random.Generator], DrawnEffect | None]
"""Draws an effect for the arm of a scene; None if the arm cannot show it."""


def set_entry(array: Callable[[TrueArm], Array], index: int, value: float) -> Apply:
    """An effect that sets one entry of an array."""

    def apply(true: TrueArm) -> None:
        array(true)[index] = value

    return apply


def add_to_entry(array: Callable[[TrueArm], Array], index: int, value: float) -> Apply:
    """An effect that adds to one entry of an array."""

    def apply(true: TrueArm) -> None:
        array(true)[index] += value

    return apply


def sensor_level(scene: Scene, random: np.random.Generator) -> Array:
    """RMS that an effect should cause in `tau` − model, (n,) [N·m]."""
    return np.maximum(SENSOR_LEAST, random.uniform(*SHARES) * rms(scene.torque))


def motor_level(scene: Scene, random: np.random.Generator) -> Array:
    """RMS that an effect should cause in `tau_motor` − model, (n,) [N·m]."""
    return np.maximum(MOTOR_LEAST, random.uniform(*SHARES) * rms(scene.torque + scene.rotor_torque))


def pick(wanted: Array, cap: float | Array, random: np.random.Generator, allowed: Mask | None = None) -> int | None:
    """A joint with a wanted magnitude that is finite and within the cap; None if there is none."""
    fit = np.isfinite(wanted) & (wanted <= cap)
    if allowed is not None:
        fit &= allowed
    return int(random.choice(np.flatnonzero(fit))) if fit.any() else None


def sign(random: np.random.Generator) -> float:
    return float(random.choice([-1.0, 1.0]))


def reversals(x: Array, width: Array) -> Array:
    """How often each column passes from beyond +width to beyond −width or back, (n,)."""
    out = np.zeros(x.shape[1])
    for j, column in enumerate(x.T):
        beyond = np.sign(column[np.abs(column) > width[j]])
        out[j] = np.count_nonzero(np.diff(beyond))
    return out
