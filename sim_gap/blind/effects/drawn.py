"""One effect as drawn for one arm, and how its magnitude is chosen."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_gap.blind.cases.arms import Arm, Array
from sim_gap.blind.cases.scene import Scene, rms
from sim_gap.blind.cases.truth import Truth

SENSOR_LEAST = 0.12
MOTOR_LEAST = 0.3
"""Least RMS that an effect causes in its channel [N·m], whatever the torque."""
SHARES = (0.06, 0.14)
"""RMS that an effect causes, as a share of the joint's RMS torque: several times what small errors cause."""

OFTEN = 0.08
"""Torque reversals a second that show what happens at a reversal."""

Values = dict[str, float]


@dataclass(frozen=True)
class Drawn:
    """An effect on one arm. `apply` puts it into the truth; `nominal` changes the nominal model, where need be."""

    effect: str
    parameters: dict[str, Values]
    """By joint name (`arm` for the whole arm)."""
    apply: Callable[[Truth], None]
    nominal: Callable[[Arm], Arm] | None = None
    implied: tuple[str, ...] = ()
    """Simpler effects that are part of it and may rightly be named beside it."""
    undecided: str = ""
    """Why slow motion may not tell it from another effect; empty where the recording can tell."""
    confused_with: tuple[str, ...] = ()
    """Effects that are as good an answer where it is undecided."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that it sits on; empty for the whole arm."""
        return tuple(name for name in self.parameters if name != "arm")


Draw = Callable[[Scene, np.random.Generator], Drawn | None]


def sensor_level(scene: Scene, random: np.random.Generator) -> Array:
    """RMS that an effect should cause in `tau` − model, (n,) [N·m]."""
    return np.maximum(SENSOR_LEAST, random.uniform(*SHARES) * rms(scene.torque))


def motor_level(scene: Scene, random: np.random.Generator) -> Array:
    """RMS that an effect should cause in `tau_motor` − model, (n,) [N·m]."""
    return np.maximum(MOTOR_LEAST, random.uniform(*SHARES) * rms(scene.torque + scene.rotor_torque))


def pick(
    wanted: Array, cap: float | Array, random: np.random.Generator, allowed: NDArray[np.bool_] | None = None
) -> int | None:
    """A joint whose wanted magnitude is finite and within the cap; None where there is none."""
    fit = np.isfinite(wanted) & (wanted <= cap)
    if allowed is not None:
        fit &= allowed
    return int(random.choice(np.flatnonzero(fit))) if fit.any() else None


def sign(random: np.random.Generator) -> float:
    """Plus or minus one."""
    return float(random.choice([-1.0, 1.0]))


def reversals(x: Array, width: Array) -> Array:
    """How often each column passes from beyond +width to beyond −width or back, (n,)."""
    out = np.zeros(x.shape[1])
    for j, column in enumerate(x.T):
        beyond = np.sign(column[np.abs(column) > width[j]])
        out[j] = np.count_nonzero(np.diff(beyond))
    return out
