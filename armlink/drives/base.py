"""Base of all drive families: names, power states, faults told by readings. Families derive from it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from armlink.arm_file import LinkJoint
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.family import Ask
from armlink.drives.orders import DriveIdentity, Limits, Order, Power, Reading
from armlink.drives.traits import Traits
from armlink.errors import BusFault, Stall

LONG_IDENTIFIER = 25
"""Bits that an identifier of 29 bits takes more than one of 11, stuff bits included."""


class BasicDrives:
    """Keeps the newest power state, fault and temperature of m drives; `note` takes every reading.

    A family implements routes, commands, identify, set_up, frames, sent, take and command_of, and calls `note(reading)`
    in take before it returns the reading.
    """

    def __init__(self, joints: Sequence[LinkJoint], traits: Traits) -> None:
        """The drives of these joints; `traits` of all of them, but for who calibrates."""
        self.rows = tuple(joints)
        self.names = tuple(joint.name for joint in joints)
        self.m = len(self.rows)
        self.powers = [Power.UNKNOWN] * self.m
        """Newest power states."""
        self.faults = [""] * self.m
        """Newest faults, in words; empty: none."""
        self.temperatures = [math.nan] * self.m
        """[°C]."""
        self._traits = [
            traits
            if joint.settings.calibration is None
            else Traits(**{**vars(traits), "calibration": joint.settings.calibration})
            for joint in joints
        ]

    def where(self, joint: int) -> str:
        """Joint's name and its id on the bus, to begin a message with."""
        return f"{self.names[joint]} ({self.rows[joint].settings.address})"

    def note(self, reading: Reading) -> Reading:
        """Keep what a reading tells of power, fault and temperature; returns it."""
        joint = reading.joint
        if reading.power is not None:
            self.powers[joint] = reading.power
        if reading.fault is not None:
            self.faults[joint] = reading.fault
        if reading.temperature == reading.temperature:  # not NaN
            self.temperatures[joint] = reading.temperature
        return reading

    def traits(self, joint: int) -> Traits:
        return self._traits[joint]

    def power(self, joint: int) -> Power:
        return self.powers[joint]

    def state_request(self, joint: int) -> list[Frame]:
        """See Drives: it tells by itself."""
        return []

    def lets_go(self, joint: int) -> bool:
        """See Drives: by its power state; a family whose drives fall where they stop by themselves overrides it."""
        return self.powers[joint] in (Power.OFF, Power.READY, Power.FAULT)

    def ready(self, joint: int) -> bool:
        return self.powers[joint] is Power.ON

    def alarm(self) -> BusFault | None:
        """See Drives; faults are states here, which `fault` tells."""
        return None

    def fault(self, modes: Sequence[int], now: float) -> BusFault | None:
        """See Drives. Most cycles find every drive on and well, and look no further."""
        if self.powers.count(Power.ON) == self.m and not any(self.faults):
            return None
        for joint, mode in enumerate(modes):
            if mode and (stopped := self.own_stop(joint)):
                return Stall(stopped)
        for joint, mode in enumerate(modes):
            power = self.powers[joint]
            if self.faults[joint]:
                return BusFault(f"{self.where(joint)}: {self.faults[joint]}")
            if power is Power.FAULT:
                return BusFault(f"{self.where(joint)}: the drive has a fault")
            if mode and power not in (Power.ON, Power.UNKNOWN):
                return BusFault(f"{self.where(joint)}: power is {power.value}, expected on")
        return None

    def has_restarted(self, joint: int) -> bool:
        """See Drives: no drive tells."""
        return False

    def own_stop(self, joint: int) -> str:
        if self.powers[joint] is not Power.STOPPED:
            return ""
        return f"{self.where(joint)} stopped itself: it did not hear its host"

    def stuck(self, joint: int, target: Power, seconds: float) -> str:
        if self.faults[joint]:
            return f"{self.where(joint)}: {self.faults[joint]}"
        found = self.powers[joint].value
        return f"{self.where(joint)}: power stays {found}, expected {target.value} within {seconds:g} s"

    def forget(self, restarts: bool = False) -> None:
        self.faults = [""] * self.m

    def missing(self, ask: Ask) -> list[int]:
        """See Drives: those that `identify` does not find."""
        return [each.joint for each in self.identify(ask) if not each.present]

    def commands(self) -> Mapping[int, str]:
        raise NotImplementedError

    def intrusion(self, can_id: int, data: bytes) -> str:
        """See Drives: the identifiers of `commands`."""
        return self.commands().get(can_id, "")

    def identify(self, ask: Ask) -> list[DriveIdentity]:
        raise NotImplementedError

    def cycle_bits(self) -> float:
        """See Drives: a command and a reply of eight bytes each."""
        longer = sum(LONG_IDENTIFIER for traits in self._traits if traits.frame == "29")
        return 2 * (self.m * longest_frame_bits(8) + longer)

    def cycle_ids(self) -> frozenset[int]:
        """See Drives: none."""
        return frozenset()

    def reading_ids(self) -> Mapping[int, int]:
        """See Drives: all that belongs to one joint."""
        return {can_id: joint for can_id, joint in self.routes().items() if joint >= 0}

    def routes(self) -> Mapping[int, int]:
        raise NotImplementedError

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        """See Drives: its id on the bus."""
        return {"id": self.rows[joint].settings.address}

    def poll(self, first: bool) -> list[Frame]:
        """See Drives: none."""
        return []

    def fits(self, limits: Sequence[Limits]) -> None:
        """See Drives: nothing to check."""

    def recover(self, ask: Ask) -> None:
        """See Drives: nothing to do."""

    def temperature(self, joint: int, ask: Ask) -> float:
        """See Drives: the newest that a reading told."""
        return self.temperatures[joint]


def no_order() -> Order:
    """An order whose every target is NaN, to be filled by `_replace`: for decoding another host's frames."""
    nan = math.nan
    return Order(Power.ON, False, 0, nan, nan, nan, nan, nan)
