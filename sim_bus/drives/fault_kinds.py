"""Firmware faults of drives that are no CANopen nodes, and the kind of a fault."""

import math
from dataclasses import dataclass


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
        FaultKind("drive.trip", True, "", 0.0, "the drive's watchdog trips although its host is there"),
        FaultKind("drive.latched", True, "", 0.0, "the same, and nothing but a power cycle clears it"),
        FaultKind("drive.mode", True, "mode", 2.0, "the drive finds itself in this mode of control"),
        FaultKind("drive.classic", True, "", 0.0, "the drive answers CAN FD frames by classical ones"),
        FaultKind("scale.position", True, "factor", 1.25, "positions are coded by a range this much larger than told"),
        FaultKind("scale.velocity", True, "factor", 1.25, "velocities are coded by a range this much larger than told"),
        FaultKind("scale.torque", True, "factor", 1.25, "torques are coded by a range this much larger than told"),
        FaultKind("feedback.lost", True, "", math.inf, "the drive has lost its encoder, or sends no feedback"),
        FaultKind("watchdog.off", True, "", 0.0, "the watchdog's setting is accepted and does nothing"),
    )
}
"""By id."""
