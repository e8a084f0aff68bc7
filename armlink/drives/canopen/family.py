"""CANopen drives with the CiA 402 profile."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from armlink.arm_file import ArmFile, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.drives.board import NO_STATUS
from armlink.drives.canopen.cia402 import state_of
from armlink.drives.canopen.settings import CanopenSettings
from armlink.drives.family import Drives, Family
from armlink.drives.findings import FoundDrives, Result, SetupFinding
from armlink.drives.orders import Limits
from armlink.drives.traits import Traits

TRAITS = Traits(
    torque="link",
    calibration="controller",
    silence="holds",
    bounds=("torque", "window"),
    cadence="sync",
    frame="11",
)
"""Of a drive with our torque sensor record."""


def build(arm: ArmFile, joints: Sequence[LinkJoint]) -> Drives:
    from armlink.drives.canopen.drives import CanopenDrives  # imports the canopen package, which takes its time

    return CanopenDrives(arm, joints, TRAITS)


def search(
    arm: ArmFile | None, bus: str | None, json: Path | None, write: Callable[..., None], show: Callable[..., None]
) -> int:
    """All nodes of a bus; see `armlink.drives.canopen.check.scan_report`."""
    from armlink.drives.canopen.check.scan_report import scan_report

    return scan_report(arm, bus, json, write, show)


def self_test(
    link: Any, drives: Any, limits: Sequence[Limits], power: bool, progress: Callable[[str], None]
) -> list[Result]:
    """The self-test of CiA 402 controllers; see `armlink.drives.canopen.check.self_test`."""
    from armlink.drives.canopen.check.self_test import CanopenSelfTest

    return CanopenSelfTest(link, drives, limits, progress).run(power)


def state_name(code: int) -> str:
    """State in words, from the status word (6041h)."""
    return "unknown" if code == NO_STATUS else state_of(code).value


def find(bus: CanBus) -> FoundDrives:
    """Nodes on a bus with their ratings; see `armlink.drives.canopen.check.found_drives`."""
    from armlink.drives.canopen.check.found_drives import FoundNodes

    return FoundNodes(bus)


def examine(arm: ArmFile, bus: CanBus, name: str) -> Iterator[SetupFinding]:
    """Contradictions between nodes and arm file; see `armlink.drives.canopen.check.arm_findings`."""
    from armlink.drives.canopen.check.arm_findings import arm_findings

    return arm_findings(arm, bus, name)


FAMILY = Family(
    "canopen",
    TRAITS,
    CanopenSettings,
    build,
    self_test=self_test,
    search=search,
    find=find,
    examine=examine,
    state_name=state_name,
    summary="CiA 402 (CANopen), with or without our torque sensor object 2100h",
)
