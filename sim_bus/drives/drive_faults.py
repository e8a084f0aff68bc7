"""Faults of drives that are no CANopen nodes: their kinds, and readings that are false or sent by a second node."""

import math
from dataclasses import dataclass
from itertools import product


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault: whether it belongs to a joint, meaning of its value, and its effect."""

    id: str
    per_joint: bool
    value: str
    """Meaning and unit of the value; empty if there is none."""
    default: float
    does: str


DRIVE_KINDS = {
    kind.id: kind
    for kind in (
        FaultKind("drive.trip", True, "", 0.0, "the drive's watchdog trips although its host is alive"),
        FaultKind("drive.latched", True, "", 0.0, "the drive's watchdog trips, and only a power cycle clears it"),
        FaultKind("drive.mode", True, "mode", 2.0, "the drive changes to this mode of control"),
        FaultKind("drive.classic", True, "", 0.0, "the drive answers CAN FD frames with classical frames"),
        FaultKind("scale.position", True, "factor", 1.25, "positions have a larger range than the drive reports"),
        FaultKind("scale.velocity", True, "factor", 1.25, "velocities have a larger range than the drive reports"),
        FaultKind("scale.torque", True, "factor", 1.25, "torques have a larger range than the drive reports"),
        FaultKind("feedback.lost", True, "", math.inf, "the drive has lost its encoder, or sends no feedback"),
        FaultKind("watchdog.off", True, "", 0.0, "the watchdog's setting is accepted, but has no effect"),
    )
}


QUANTITIES = ("position", "velocity", "torque")
UNITS = {"position": "rad", "velocity": "rad/s", "torque": "N·m"}
SECOND_SENDER = ("forged", "doubled")
"""Falsehoods that a second node tells: every frame with the quantity comes once more."""


def _kind(how: str, quantity: str) -> FaultKind:
    unit = UNITS[quantity]
    value, default, does = {
        "frozen": ("", 0.0, f"the reported {quantity} no longer changes"),
        "scaled": ("factor", 2.0, f"the reported {quantity} is the true one times this factor"),
        "forged": (f"{quantity} [{unit}]", 0.0, f"a second node repeats the joint's frames with this {quantity}"),
        "doubled": ("", 0.0, f"a second node repeats the joint's frames with the {quantity} of the first frame"),
    }[how]
    return FaultKind(f"{how}.{quantity}", True, value, default, does)


FALSE_READINGS = {
    f"{how}.{quantity}": _kind(how, quantity)
    for how, quantity in product(("frozen", "scaled", *SECOND_SENDER), QUANTITIES)
}


class FalseReadings:
    def __init__(self) -> None:
        self._faults: dict[str, float] = {}
        self._first: dict[str, float] = {}
        """Value that each falsehood began with."""

    def begin(self, fault: str, value: float) -> None:
        self._faults[fault] = value

    def end(self) -> None:
        self._faults.clear()
        self._first.clear()

    @property
    def any(self) -> bool:
        return bool(self._faults)

    def repeated(self, quantities: tuple[str, ...]) -> bool:
        """Whether a second node repeats frames with these quantities."""
        return any(f"{how}.{quantity}" in self._faults for how, quantity in product(SECOND_SENDER, quantities))

    def told(self, quantity: str, true: float, second: bool = False) -> float:
        """A quantity as the joint itself, or a second node, tells it."""
        faults = self._faults
        if second:
            if (forged := faults.get(f"forged.{quantity}")) is not None:
                return forged
            doubled = f"doubled.{quantity}"
            return self._first.setdefault(doubled, true) if doubled in faults else true
        frozen = f"frozen.{quantity}"
        if frozen in faults:
            true = self._first.setdefault(frozen, true)
        return true * faults.get(f"scaled.{quantity}", 1.0)
