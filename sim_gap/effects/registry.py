"""The library of effects in their inverse form, one module a family, and the general laws beside it."""

from collections.abc import Sequence

from sim_gap.effects import base, drive, friction, link, position, torque, transmission
from sim_gap.effects.effect import InverseEffect
from sim_gap.effects.laws import LAWS

FAMILIES = (friction, link, base, position, torque, transmission, drive)
"""Modules with an `EFFECTS`; effects are searched in this order."""
NOT_DIAGNOSED = {"torque.nonlinearity": "noted as the general law `law.load`, which is not attributed"}
"""Catalogue ids without an inverse form, and why."""
_LIBRARY: dict[str, InverseEffect] = {each.id: each for family in FAMILIES for each in family.EFFECTS}
_EFFECTS = _LIBRARY | {law.id: law.effect for law in LAWS.values()}


def effects() -> dict[str, InverseEffect]:
    return _EFFECTS


def library_without(withheld: Sequence[str]) -> list[str]:
    """Ids of the library's effects less those withheld and those that need one of these."""
    return [name for name, effect in _LIBRARY.items() if not {name, *effect.needs} & {*withheld}]
