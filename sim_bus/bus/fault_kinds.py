"""Faults that can be injected, as text: `ID:JOINT:VALUE`, `ID::VALUE` for the bus or host, `…@T` at time T."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from armlink.errors import BadInput
from sim_bus.drives.drive_faults import DRIVE_KINDS, FALSE_READINGS, FaultKind

FORM = "ID:JOINT[:VALUE][@T] or ID::VALUE[@T], for example node.silent:joint_2 or bus.off::0.5@3"


KINDS = {
    kind.id: kind
    for kind in (
        FaultKind("node.silent", True, "duration [s]", math.inf, "the node is cut off: it neither hears nor sends"),
        FaultKind("node.reboot", True, "", 0.0, "power cycle: mode and unsaved calibration are lost, boot-up message"),
        FaultKind("node.babbling", True, "frames/s", 5000.0, "the node sends frames of identifier 001h"),
        FaultKind("node.duplicate", True, "", 0.0, "a second node has the same id: every frame comes twice"),
        FaultKind("bus.off", False, "restart time [s]", 0.1, "the host's controller is bus-off and then restarts"),
        FaultKind("bus.full", False, "duration [s]", math.inf, "the queue stays full: no node acknowledges frames"),
        FaultKind("link.down", False, "duration [s]", math.inf, "the interface is down"),
        FaultKind("reader.slow", False, "frames", 4.0, "the host's receive queue holds only this number of frames"),
        FaultKind("frame.short", True, "share of frames", 1.0, "position and torque come in frames of three bytes"),
        FaultKind("frame.corrupt", True, "share of frames", 1.0, "the node's frames are destroyed by error frames"),
        FaultKind("emcy.storm", True, "frames/s", 1000.0, "the node sends emergency 7305h again and again"),
        FaultKind("sdo.abort", True, "", 0.0, "every SDO request is aborted (0800 0022h)"),
        FaultKind("sdo.timeout", True, "", 0.0, "no SDO request is answered"),
        FaultKind("mode.refused", True, "mode", 10.0, "the controller does not enter this mode of operation"),
        FaultKind("clock.jump", False, "jump [s]", 1.0, "time jumps, as if the host had been suspended"),
    )
}
ALL_KINDS = KINDS | DRIVE_KINDS | FALSE_READINGS
CANOPEN_FAULTS = frozenset(("emcy.storm", "sdo.abort", "sdo.timeout"))
"""Faults that only a CANopen node can have."""


@dataclass(frozen=True)
class Fault:
    id: str
    joint: str = ""
    value: float = math.nan
    """NaN: default of the kind."""
    time: float = 0.0
    """Simulated time of the fault [s]; if it is past, immediately."""

    @property
    def kind(self) -> FaultKind:
        return ALL_KINDS[self.id]

    @property
    def amount(self) -> float:
        return self.kind.default if math.isnan(self.value) else self.value


def parse_fault(text: str, joints: Sequence[str]) -> Fault:
    """Parse one `--fault`. Raises BadInput."""
    what, at, time = text.partition("@")
    parts = what.split(":")
    kind = ALL_KINDS.get(parts[0])
    if kind is None:
        raise BadInput(f"fault {text!r}: there is no fault {parts[0]!r}; expected one of {', '.join(ALL_KINDS)}")
    joint, value = [*parts[1:], "", ""][:2]
    if len(parts) > 3 or bool(joint) != kind.per_joint:
        raise BadInput(
            f"fault {text!r}: {'a joint is missing' if kind.per_joint else 'this fault takes no joint'}; "
            f"expected {FORM}"
        )
    if joint and joint not in joints:
        raise BadInput(f"fault {text!r}: there is no joint {joint!r}; expected one of {', '.join(joints)}")
    try:
        amount = float(value) if value else math.nan
        instant = float(time) if at else 0.0
        if amount < 0 or math.isinf(amount) or not math.isfinite(instant) or (value and not kind.value):
            raise ValueError
    except ValueError:
        raise BadInput(
            f"fault {text!r}: its value ({kind.value or 'none'}) or its time is wrong; expected {FORM}"
        ) from None
    return Fault(kind.id, joint, amount, instant)
