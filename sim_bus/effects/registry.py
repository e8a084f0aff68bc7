"""All effects of the simulated arm: checks an arm file's settings and folds them into one state."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sim_bus.effects.effect import EffectSetting, SimulatedEffect, SimulatedParameter
from sim_bus.effects.forms import EFFECTS
from sim_bus.effects.state import Imperfections

NOT_SIMULATED = {
    "friction.bearing": "all friction of the simulated arm is between motor and torque sensor",
    "torque.nonlinearity": "the simulated sensor is linear apart from hysteresis, dead band and saturation",
}
"""Catalogue ids without a forward form, and why."""
_EFFECTS = {each.id: each for each in sorted(EFFECTS, key=lambda each: each.id)}


def effects() -> dict[str, SimulatedEffect]:
    return dict(_EFFECTS)


def imperfections(names: Sequence[str], settings: Iterable[EffectSetting]) -> Imperfections:
    """Fold the settings, in order, into one state of the joints `names`. Raises ValueError."""
    state = Imperfections(tuple(names))
    for setting in settings:
        check_entry(setting.effect, setting.joint, setting.parameters)
        effect = _EFFECTS[setting.effect]
        values: Mapping[str, Any] = {
            p.name: _value(names, p, setting.parameters.get(p.name, p.domain.default)) for p in effect.parameters
        }
        effect.apply(state, _index(names, setting.joint) if effect.per_joint else -1, values)
    return state


def _value(names: Sequence[str], parameter: SimulatedParameter, value: Any) -> Any:
    return _index(names, value) if parameter.joint else np.asarray(value, float)


def _index(names: Sequence[str], joint: Any) -> int:
    if joint not in names:
        raise ValueError(f"there is no joint {joint!r}; expected one of {', '.join(names)}")
    return list(names).index(joint)


def check_entry(effect_id: str, joint: str | None, parameters: Mapping[str, Any]) -> None:
    """Check one effect's id, joint and parameters. Raises ValueError with what was expected."""
    if effect_id not in _EFFECTS:
        raise ValueError(f"there is no effect {effect_id!r}; expected one of {', '.join(_EFFECTS)}")
    effect = _EFFECTS[effect_id]
    if effect.per_joint and joint is None:
        raise ValueError(f"{effect_id}: key `joint` is missing: name the joint that has this effect")
    if not effect.per_joint and joint is not None:
        raise ValueError(f"{effect_id}: this effect belongs to the whole arm: remove joint {joint!r}")
    names = {parameter.name for parameter in effect.parameters}
    for unknown in sorted(set(parameters) - names):
        raise ValueError(f"{effect_id}: this effect has no parameter {unknown!r}; it has {described(effect)}")
    for parameter in effect.parameters:
        if parameter.name in parameters:
            _check_value(effect, parameter, parameters[parameter.name])
        elif parameter.domain.default is None:
            raise ValueError(f"{effect_id}: parameter {parameter.name} is missing; this effect has {described(effect)}")


def described(effect: SimulatedEffect) -> str:
    return ", ".join(f"{parameter.name} [{parameter.unit}]" for parameter in effect.parameters)


def _check_value(effect: SimulatedEffect, parameter: SimulatedParameter, value: Any) -> None:
    expected = f"{effect.id}: parameter {parameter.name} [{parameter.unit}]: expected"
    if parameter.joint:
        if not isinstance(value, str):
            raise ValueError(f"{expected} the name of a joint, not {value!r}")
        return
    numbers = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    size = len(numbers) if isinstance(value, Sequence) else 0
    finite = all(isinstance(number, int | float) and abs(number) <= sys.float_info.max for number in numbers)
    if finite and not all(parameter.accepts(number) for number in numbers):
        raise ValueError(f"{expected} a number{parameter.bound}, not {value!r}")
    if not finite or size not in parameter.sizes:
        sizes = " or ".join("one number" if size == 0 else f"{size} numbers" for size in parameter.sizes)
        raise ValueError(f"{expected} {sizes}, not {value!r}")
