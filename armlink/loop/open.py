"""Opens an arm for a job: in a process of its own, or in this one if its bus is in this one."""

from armlink.arm_file import ArmFile
from armlink.bus.open import resolve_bus
from armlink.link.link import Link
from armlink.loop.driver import ArmDriver
from armlink.loop.remote_link import RemoteLink

IN_PROCESS = ("armlink_sim", "virtual")
"""Interfaces of python-can whose bus another process cannot open."""


def open_arm(arm: ArmFile, bus: str | None = None) -> ArmDriver:
    """The arm on bus `INTERFACE:CHANNEL[@BITRATE]`, by default the arm file's; raises BadInput, BusFault."""
    section = arm.require_link()
    if bus is None and section.buses:
        return RemoteLink(arm, bus)
    if resolve_bus(bus, section.bus).interface in IN_PROCESS:
        return Link.open(arm, bus)
    return RemoteLink(arm, bus)
