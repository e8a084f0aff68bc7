"""Drive families by name, from the entry-point group `armlink.drives`."""

from functools import cache
from importlib.metadata import entry_points

from armlink.drives.family import Family
from armlink.errors import BadInput

GROUP = "armlink.drives"


def family_names() -> list[str]:
    """Names of the installed families."""
    return sorted({point.name for point in entry_points(group=GROUP)})


@cache
def family(name: str) -> Family:
    """The family of this name; raises BadInput."""
    points = entry_points(group=GROUP, name=name)
    if not points:
        raise BadInput(f"no drive family {name!r}; there are {', '.join(family_names())}")
    found: Family = next(iter(points)).load()
    return found
