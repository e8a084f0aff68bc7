"""Drives whose replies do not tell whether the motor has power: what is ordered and answered, time and torque show it.

Such a drive follows its commands from the first one that it answers. One that got none for longer than its own watch
of the host waits counts as stopped by that watch, whether it was or not. One that is asked shows by its torque whether
it still follows the newest order.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

from armlink.drives.base import BasicDrives, DriveMemory
from armlink.drives.orders import Power

LOAD_SHARE = 0.02
"""A torque above this share of the drive's range or limit shows whether the drive makes it."""
FOLLOWED_SHARE = 0.5
"""A drive that makes less than this share of the torque that is asked for does not follow."""


@dataclass
class UntoldMemory(DriveMemory):
    on: bool | None = None
    """Follows its commands, as far as the newest that was answered tells; None: not known."""
    commanded: float = -math.inf
    """When the newest command was made [s]."""
    stopped: bool = False
    """It was left without commands for longer than its watch waits."""
    asked: bool = False
    """The next reply tells whether it still makes torque."""


U = TypeVar("U", bound=UntoldMemory)


class UntoldPowerDrives(BasicDrives[U]):
    watch: str
    """Name of the drive's own watch of its host."""

    def let_go_where(self, watched: Iterable[object]) -> None:
        """Drives whose watch is set fall when their host is silent."""
        pairs = zip(self._traits, watched, strict=True)
        self._traits = [replace(traits, silence="falls") if each else traits for traits, each in pairs]

    def expire(self, joint: int, now: float, seconds: float) -> None:
        """Count a drive as stopped that got no command for more than `seconds`."""
        known = self.memory[joint]
        if known.on and now - known.commanded > seconds:
            known.on, known.stopped, self.powers[joint] = None, True, Power.STOPPED

    def answered(self, joint: int, follows: bool | None) -> None:
        """A reading of the torque after the question whether it `follows`; None: nothing is shown."""
        known = self.memory[joint]
        known.asked, known.on, known.stopped = False, follows, follows is False

    def power_shown(self, joint: int, halted: bool) -> Power:
        """`halted`: it has power and was told to stop or damp."""
        known = self.memory[joint]
        if known.stopped or (known.on and halted):
            return Power.STOPPED
        return {True: Power.ON, False: Power.OFF, None: Power.UNKNOWN}[known.on]

    def lets_go(self, joint: int) -> bool:
        return not self.memory[joint].on

    def own_stop(self, joint: int) -> str:
        if not self.memory[joint].stopped:
            return ""
        return f"{self.where(joint)}: no command came within its {self.watch}, so it has switched its torque off"

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        for known in self.memory:
            known.stopped = False


def makes_torque(torque: float, wanted: float, most: float) -> bool | None:
    """Whether a drive makes a torque that it is asked for [N·m]; None where that is too little of `most` to tell."""
    if not abs(wanted) > LOAD_SHARE * most:
        return None
    return torque * math.copysign(1.0, wanted) > FOLLOWED_SHARE * abs(wanted)
