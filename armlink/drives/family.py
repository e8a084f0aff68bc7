"""A drive family: a folder under `armlink/drives`, or any installed package, with a `Family` object.

It is named in the entry-point group `armlink.drives`:

    [project.entry-points."armlink.drives"]
    damiao = "armlink.drives.damiao.drives:FAMILY"
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.contributed import contributions, load_contribution
from armlink.drives.base import BasicDrives
from armlink.drives.findings import FoundDrive, FoundDrives, Result, SetupFinding
from armlink.drives.orders import power_name
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BadInput

GROUP = "armlink.drives"


@dataclass(frozen=True)
class Discovery:
    """How the drives of a family are found."""

    find: Callable[[SearchedBus], Sequence[FoundDrive] | FoundDrives]
    """Sends nothing but frames that read."""
    spares: tuple[str, ...] = ()
    """Families whose drives its requests or answers could command, or whose frames look alike: it is not looked for
    beside them."""


@dataclass(frozen=True)
class Family:
    name: str
    traits: Traits
    """Of a drive with the default keys; for `armlink drives`."""
    settings: type[DriveSettings]
    """Keys of `link.joints[].drive`."""
    build: Callable[[ArmFile, Sequence[LinkJoint]], BasicDrives[Any]]
    """`build(arm, joints)`: the drives of these joints of an arm, all on one bus; sends nothing. Raises BadInput."""
    self_test: Callable[..., list[Result]] | None = None
    """`self_test(link, drives, limits, power, progress)` of an arm with these drives alone, open and not started, where
    it goes further than the one for all families."""
    self_test_steps: str = ""
    """Sentences on what that test does to joints with power; `{deadline}` is `link.deadline` [ms]."""
    search: Callable[..., int] | None = None
    """`search(arm, bus or None, json, write, show)`: `armlink scan` of an arm; None: each drive is asked by its id."""
    discovery: Discovery | None = None
    """How its drives are found without an arm file; None: they are found by their ids alone."""
    examine: Callable[[ArmFile, CanBus, str], Iterator[SetupFinding]] | None = None
    """`examine(arm, bus, name)`: what the drives of an arm with this family alone say against its file, on an open bus
    of this name; they are only read. None: each drive is asked who it is."""
    state_name: Callable[[int], str] = power_name
    """State of a drive in words, from its code in `Sample.status`; by default an index of Power."""
    summary: str = ""
    """Which devices these are, in a line."""


def family_names() -> list[str]:
    return sorted({point.name for point in contributions(GROUP)})


@cache
def family(name: str) -> Family:
    """The family of this name; raises BadInput."""
    found: Family | None = load_contribution(GROUP, name)
    if found is None:
        raise BadInput(f"drive family {name!r} is unknown; expected one of {', '.join(family_names())}")
    return found
