"""The forward form of an effect: what it does to the simulated arm, and which parameter values it accepts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from armlink import effect_catalogue as catalogue
from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

Values = Mapping[str, Any]
"""Parameter values by name: numbers, arrays, or the index of a joint."""
Apply = Callable[[Imperfections, int, Values], None]
"""Writes the effect into the state of joint (or link) `joint`; −1 for an effect on the whole arm."""


class EffectSetting(Protocol):
    """One effect with its parameter values, as an arm file gives it."""

    @property
    def effect(self) -> str: ...
    @property
    def joint(self) -> str | None: ...
    @property
    def parameters(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class Domain:
    """Values of one parameter that the simulated arm accepts; every number if nothing is set."""

    least: float | None = None
    above: float | None = None
    """The value must be at least `least`, and greater than `above`."""
    default: float | None = None
    """Value of a parameter that is not given; None if it must be."""
    sizes: tuple[int, ...] = ()
    """Allowed lengths of a list; empty for the number of components in the catalogue."""


NOT_NEGATIVE, POSITIVE, ZERO_BY_DEFAULT = Domain(least=0.0), Domain(above=0.0), Domain(default=0.0)


@dataclass(frozen=True)
class SimulatedParameter:
    """One parameter of an effect: its catalogue entry together with the accepted values."""

    name: str
    unit: str
    sizes: tuple[int, ...] = (0,)
    """Allowed lengths; 0 is a plain number."""
    domain: Domain = Domain()

    @property
    def joint(self) -> bool:
        return self.unit == catalogue.JOINT

    @property
    def bound(self) -> str:
        """The bound on the value in words; empty if there is none."""
        least, above = self.domain.least, self.domain.above
        return f" of at least {least:g}" if least is not None else f" above {above:g}" if above is not None else ""

    def accepts(self, value: float) -> bool:
        least, above = self.domain.least, self.domain.above
        return (least is None or value >= least) and (above is None or value > above)


@dataclass(frozen=True)
class SimulatedEffect:
    id: str
    parameters: tuple[SimulatedParameter, ...]
    apply: Apply
    per_joint: bool = True


def effect(effect_id: str, apply: Apply, **domains: Domain) -> SimulatedEffect:
    """The forward form of a catalogue entry; `domains` restricts the values of some of its parameters."""
    entry, free = catalogue.CATALOGUE[effect_id], Domain()
    if unknown := set(domains) - {parameter.name for parameter in entry.parameters}:
        raise ValueError(f"{effect_id}: the catalogue has no parameter {', '.join(sorted(unknown))}")
    parameters = tuple(
        SimulatedParameter(each.name, each.unit, domain.sizes or (len(each.components),), domain)
        for each in entry.parameters
        for domain in (domains.get(each.name, free),)
    )
    return SimulatedEffect(effect_id, parameters, apply, not entry.whole_arm)


def changes(how: Callable[[Any, Any], Any], array: Callable[[Imperfections], Array], parameter: str) -> Apply:
    """An effect that changes one entry of an array of the state by its parameter."""

    def apply(state: Imperfections, joint: int, values: Values) -> None:
        array(state)[joint] = how(array(state)[joint], values[parameter])

    return apply


adds, scales, limits = partial(changes, np.add), partial(changes, np.multiply), partial(changes, np.minimum)


def sets(array: Callable[[Imperfections], Array], *parameters: str) -> Apply:
    """An effect whose parameters are one row of an array of the state."""

    def apply(state: Imperfections, joint: int, values: Values) -> None:
        array(state)[joint] = [values[name] for name in parameters]

    return apply
