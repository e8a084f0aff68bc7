"""One effect as drawn for one arm, and how its magnitude is chosen."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gcomp.arrays import Array, Mask
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.scene import Scene, ServoLaw

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


@dataclass(frozen=True)
class SizedDraw:
    """Draws one parameter at one joint of those that can show it."""

    effect: str
    parameter: str
    size: Callable[[Scene, np.random.Generator], Array]
    """Size that shows at each joint, (n,); not finite where none does."""
    least: float = 0.0
    most: float | Callable[[Scene], Array] = np.inf
    """Range of sizes: a joint that would need a larger one does not get the effect."""
    shows: Callable[[Scene, Array], Mask] | None = None
    """Joints that show these sizes, (n,), if not all do."""
    sound: float | None = None
    """Value of a sound arm, from which the size goes to either side; None if the size is the value."""
    make: Callable[..., DrawnEffect] = on_joint
    more: Callable[[Scene, int], dict[str, Any]] = lambda scene, joint: {}
    """Further fields of the effect of a joint."""

    def __call__(self, scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
        sizes = np.maximum(self.size(scene, random), self.least)
        fit = np.isfinite(sizes) & (sizes <= (self.most(scene) if callable(self.most) else self.most))
        joint = pick(fit if self.shows is None else fit & self.shows(scene, sizes), random)
        if joint is None:
            return None
        value = float(sizes[joint]) if self.sound is None else self.sound + sign(random) * float(sizes[joint])
        return self.make(scene, joint, self.effect, {self.parameter: value}, **self.more(scene, joint))


def pick(fit: Mask, random: np.random.Generator) -> int | None:
    """One of the joints that fit, (n,); None if none does."""
    return int(random.choice(np.flatnonzero(fit))) if fit.any() else None


def sign(random: np.random.Generator) -> float:
    return float(random.choice([-1.0, 1.0]))


def reverses_often(scene: Scene, width: Array) -> Mask:
    """Joints whose torque passes from beyond +width to beyond −width or back every 12.5 s or more often, (n,)."""
    beyond = (np.sign(column[np.abs(column) > limit]) for column, limit in zip(scene.torque.T, width, strict=True))
    counts = np.array([np.count_nonzero(np.diff(signs)) for signs in beyond])
    return np.asarray(counts >= 0.08 * scene.seconds)
