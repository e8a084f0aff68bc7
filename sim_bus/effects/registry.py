"""Which effects there are (contract 4), with their parameters and units; the forward form lies in the family's file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sim_bus.effects.state import Imperfections

Apply = Callable[["Imperfections", int, Mapping[str, Any]], None]


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect."""

    name: str
    unit: str
    sizes: tuple[int, ...] = (0,)
    """Allowed lengths; 0 is a plain number."""
    default: float | None = None
    joint: bool = False
    """Whether the value is a joint's name."""
    least: float | None = None
    above: float | None = None
    """The value must be at least `least`, and greater than `above`."""

    @property
    def bound(self) -> str:
        """What the value must keep to, in words; empty where it is free."""
        return f" of at least {self.least:g}" if self.least is not None else f" above {self.above:g}"

    def holds(self, value: float) -> bool:
        """Whether a number keeps to the bounds."""
        return (self.least is None or value >= self.least) and (self.above is None or value > self.above)


@dataclass(frozen=True)
class Effect:
    """One effect: its id, its parameters, whether it belongs to a joint, and what it does to the simulated arm."""

    id: str
    parameters: tuple[Parameter, ...]
    apply: Apply
    per_joint: bool = True


FAMILIES = ("actuator", "base", "friction", "link", "position", "timing", "torque", "transmission")
_effects: dict[str, Effect] = {}


def effects() -> dict[str, Effect]:
    """All effects by id, sorted."""
    if not _effects:
        for family in FAMILIES:
            for effect in import_module(f"sim_bus.effects.{family}").EFFECTS:
                _effects[effect.id] = effect
    return dict(sorted(_effects.items()))


def check_entry(effect_id: str, joint: str | None, parameters: Mapping[str, Any]) -> None:
    """Check one effect's id, joint and parameters. Raises ValueError that says what was expected."""
    known = effects()
    if effect_id not in known:
        raise ValueError(f"no effect {effect_id!r}; there are {', '.join(known)}")
    effect = known[effect_id]
    if effect.per_joint and joint is None:
        raise ValueError(f"{effect_id}: key joint is missing: name the joint it acts on")
    if not effect.per_joint and joint is not None:
        raise ValueError(f"{effect_id}: acts on the whole arm; remove joint {joint!r}")
    names = {parameter.name for parameter in effect.parameters}
    for unknown in sorted(set(parameters) - names):
        raise ValueError(f"{effect_id}: no parameter {unknown!r}; it has {described(effect)}")
    for parameter in effect.parameters:
        if parameter.name in parameters:
            _check_value(effect, parameter, parameters[parameter.name])
        elif parameter.default is None:
            raise ValueError(f"{effect_id}: parameter {parameter.name} is missing; it has {described(effect)}")


def described(effect: Effect) -> str:
    """The effect's parameters with units, for messages and documentation."""
    return ", ".join(f"{parameter.name} [{parameter.unit}]" for parameter in effect.parameters)


def _check_value(effect: Effect, parameter: Parameter, value: Any) -> None:
    wanted = f"{effect.id}: parameter {parameter.name} [{parameter.unit}]: expected"
    if parameter.joint:
        if not isinstance(value, str):
            raise ValueError(f"{wanted} a joint's name, not {value!r}")
        return
    numbers = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    size = len(numbers) if isinstance(value, Sequence) else 0
    finite = all(isinstance(number, int | float) and np.isfinite(number) for number in numbers)
    if finite and not all(parameter.holds(number) for number in numbers):
        raise ValueError(f"{wanted} a number{parameter.bound}, not {value!r}")
    if not finite or size not in parameter.sizes:
        sizes = " or ".join("one number" if size == 0 else f"{size} numbers" for size in parameter.sizes)
        raise ValueError(f"{wanted} {sizes}, not {value!r}")
