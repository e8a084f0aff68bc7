"""Opens an arm for a job: in a process of its own, or in this one if its bus is in this one."""

from armlink.arm_file import ArmFile
from armlink.bus.open import resolve_bus
from armlink.link.link import Link
from armlink.loop.remote_link import RemoteLink

IN_PROCESS = ("armlink_sim", "virtual")
"""Interfaces of python-can whose bus another process cannot open."""
ArmDriver = Link | RemoteLink
"""Drives the joints of one arm. A Link makes each cycle when it is asked for the next sample. The process of a
RemoteLink keeps the cycle whatever the job is doing: the last command stays in force until the next one comes."""


def is_in_process(arm: ArmFile, bus: str | None = None) -> bool:
    """Whether this bus of an arm is one of this process; raises BadInput."""
    section = arm.require_link()
    if bus is None and section.buses:
        return False
    return resolve_bus(bus, section.bus).interface in IN_PROCESS


def first_check(arm: ArmFile, word: str, bus: str | None = None) -> list[str]:
    """Words of the check that an arm begins with: without power, unless it is simulated in this process."""
    return ["check", word] if is_in_process(arm, bus) else ["check", word, "--passive"]


def open_arm(arm: ArmFile, bus: str | None = None) -> ArmDriver:
    """The arm on bus `INTERFACE:CHANNEL[@BITRATE]`, by default the arm file's; raises BadInput, BusFault."""
    return Link.open(arm, bus) if is_in_process(arm, bus) else RemoteLink(arm, bus)
