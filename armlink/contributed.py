"""Contributions of installed packages to armlink, by group of entry points.

Looking into every installed package takes tens of milliseconds, and an arm file needs it twice: it is done once in a
process.
"""

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def contributions(group: str) -> tuple[EntryPoint, ...]:
    """Entry points of a group, such as `armlink.commands`."""
    return tuple(installed_entry_points().select(group=group))


def load_contribution(group: str, name: str) -> Any:
    """The first contribution to a group under a name, loaded; None without one."""
    return next((point.load() for point in contributions(group) if point.name == name), None)


@cache
def installed_entry_points() -> Any:
    """Entry points of all packages as they were at the first call."""
    return entry_points()
