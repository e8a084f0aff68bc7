"""CANopen drives with the CiA 402 profile; the canopen package, which takes its time, is imported where it is used."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from armlink.drives.board import NO_STATUS
from armlink.drives.canopen.cia402 import state_of
from armlink.drives.canopen.settings import TRAITS, CanopenSettings
from armlink.drives.family import Discovery, Family


def _late(module: str, name: str) -> Callable[..., Any]:
    """A function or class of a module of this folder, which is imported when it is called."""

    def call(*args: Any) -> Any:
        return getattr(import_module(f"armlink.drives.canopen.{module}"), name)(*args)

    return call


def state_name(code: int) -> str:
    """State in words, from the status word (6041h)."""
    return "unknown" if code == NO_STATUS else state_of(code).value


FAMILY = Family(
    "canopen",
    TRAITS,
    CanopenSettings,
    build=_late("drives", "CanopenDrives"),
    self_test=_late("check.self_test", "self_test"),
    self_test_steps="One joint after the other is then quick-stopped, and later gets no commands for {deadline:.0f} "
    "ms; finally, no joint gets the heartbeat of this host for twice as long.",
    search=_late("check.scan", "scan_report"),
    discovery=Discovery(_late("check.scan", "FoundNodes"), ("moteus", "odrive")),
    examine=_late("check.scan", "arm_findings"),
    state_name=state_name,
    summary="CiA 402 (CANopen), with or without armlink's object 2100h",
)
