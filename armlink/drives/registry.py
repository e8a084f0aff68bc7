"""Drive families by name, from the entry-point group `armlink.drives`."""

from functools import cache

from armlink.bus.can_bus import CanBus
from armlink.contributed import contributed, named
from armlink.drives.family import Family
from armlink.drives.findings import FoundDrives
from armlink.errors import BadInput

GROUP = "armlink.drives"


def family_names() -> list[str]:
    return sorted({point.name for point in contributed(GROUP)})


@cache
def family(name: str) -> Family:
    """The family of this name; raises BadInput."""
    found: Family | None = named(GROUP, name)
    if found is None:
        raise BadInput(f"drive family {name!r} is unknown; there are {', '.join(family_names())}")
    return found


def found_drives(bus: CanBus) -> FoundDrives:
    """The drives on an open bus of the first family whose drives can be found without an arm file; raises BusFault."""
    for name in family_names():
        find = family(name).find
        if find is not None:
            return find(bus)
    raise BadInput(
        f"drives of the families {', '.join(family_names())} can only be found with an arm file that gives their ids"
    )


def not_looked_for() -> str:
    """Which families a search without an arm file passes over, and the way to their drives."""
    by_search = {name: family(name).find is not None for name in family_names()}
    asked, others = ([name for name in by_search if by_search[name] is found] for found in (True, False))
    return (
        f"only {', '.join(asked)} drives were looked for; to find {', '.join(others)} drives, give an arm "
        "file with their ids: armlink scan ARM.yaml --bus …"
    )
