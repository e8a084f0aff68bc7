"""Readings of a joint that are not what its sensors say: false, or sent by a second node in its name."""

from itertools import product

from sim_bus.drives.fault_kinds import FaultKind

QUANTITIES = ("position", "velocity", "torque")
UNITS = {"position": "rad", "velocity": "rad/s", "torque": "N·m"}
SECOND_SENDER = ("forged", "doubled")
"""Falsehoods that a second node tells: every frame with the quantity comes once more."""


def _kind(how: str, quantity: str) -> FaultKind:
    unit = UNITS[quantity]
    value, default, does = {
        "frozen": ("", 0.0, f"the {quantity} that is told stays what it is"),
        "scaled": ("factor", 2.0, f"the {quantity} that is told is this many times the true one"),
        "forged": (f"{quantity} [{unit}]", 0.0, f"a second node repeats the joint's frames with this {quantity}"),
        "doubled": ("", 0.0, f"a second node repeats the joint's frames with the {quantity} that they had at first"),
    }[how]
    return FaultKind(f"{how}.{quantity}", True, value, default, does)


FALSE_READINGS = {
    f"{how}.{quantity}": _kind(how, quantity)
    for how, quantity in product(("frozen", "scaled", *SECOND_SENDER), QUANTITIES)
}
"""By id."""


class FalseReadings:
    """Falsehoods of one joint's frames."""

    def __init__(self) -> None:
        """The truth."""
        self._faults: dict[str, float] = {}
        self._first: dict[str, float] = {}
        """Value that each falsehood began with."""

    def begin(self, fault: str, value: float) -> None:
        """A falsehood begins."""
        self._faults[fault] = value

    def end(self) -> None:
        """All falsehoods end."""
        self._faults.clear()
        self._first.clear()

    @property
    def any(self) -> bool:
        """Whether anything is false."""
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
