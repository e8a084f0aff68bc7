"""One effect as drawn for one arm, and how its magnitude is chosen."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from armlink.effect_catalogue import CATALOGUE
from gcomp.arrays import Array, Mask
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.scene import Scene, ServoLaw

OFTEN = 0.08
"""Torque reversals per second from which effects at a reversal show."""

Values = dict[str, float]


class ArmSetting(NamedTuple):
    """An entry of `sim.effects` in an arm file: how the simulated arm gets the effect."""

    effect: str
    joint: str
    parameters: dict[str, Any]


@dataclass(frozen=True)
class DrawnEffect:
    effect: str
    parameters: dict[str, Values]
    """By joint name (`arm` for the whole arm); named as a diagnosis reports them."""
    settings: tuple[ArmSetting, ...] = ()
    """Puts it into joints, drives and sensors of the true arm."""
    links: Callable[[BenchArm], BenchArm] = lambda arm: arm
    """Puts it into the true links and base."""
    law: Callable[[ServoLaw], None] = lambda law: None
    """Puts it into the servos."""
    nominal: Callable[[BenchArm], BenchArm] = lambda arm: arm
    """Changes the nominal model, if need be."""
    implied: tuple[str, ...] = ()
    """Simpler effects that are part of it and may correctly be named as well."""
    undecided: str = ""
    """Why slow motion may not separate it from another effect; empty if the recording can."""
    confused_with: tuple[str, ...] = ()
    """Effects that are an equally good answer if it is undecided."""

    def __post_init__(self) -> None:
        """Raise ValueError for a parameter that is not in the catalogue, which has no controllers."""
        if self.effect not in CATALOGUE and self.effect.startswith("controller."):
            return
        known = {name for name, _ in CATALOGUE[self.effect].reported}
        if unknown := {name for values in self.parameters.values() for name in values} - known:
            raise ValueError(f"{self.effect}: {', '.join(sorted(unknown))} not in the catalogue")

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of its joints; empty for the whole arm."""
        return tuple(name for name in self.parameters if name != "arm")


Draw = Callable[[Scene, np.random.Generator], DrawnEffect | None]
"""Draws an effect for the arm of a scene; None if the arm cannot show it."""


def on_joint(scene: Scene, joint: int, effect: str, values: Values, **more: Any) -> DrawnEffect:
    """An effect of one joint that the simulated arm gets by the same parameters; `more` are fields of DrawnEffect."""
    name = scene.arm.names[joint]
    return DrawnEffect(effect, {name: values}, **{"settings": (ArmSetting(effect, name, values),), **more})


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
    beyond = (np.sign(column[np.abs(column) > limit]) for column, limit in zip(x.T, width, strict=True))
    return np.array([np.count_nonzero(np.diff(signs)) for signs in beyond], float)
