"""Traits: what the drives of a family are like, so that the link knows what it may rely on."""

from dataclasses import dataclass
from typing import Any, Literal

TorqueSource = Literal["link", "current"]
CalibrationPlace = Literal["controller", "host"]
Silence = Literal["holds", "damps", "falls", "keeps on"]
Bound = Literal["torque", "window", "speed"]
Cadence = Literal["sync", "reply", "cyclic"]
FrameKind = Literal["11", "29", "fd"]


@dataclass(frozen=True)
class Traits:
    torque: TorqueSource
    """Whether its torque reading is of a sensor at the joint (link side), or current times torque constant."""
    calibration: CalibrationPlace
    """Who applies gain and offset of the torque reading: the controller itself, or the host (calibration record)."""
    silence: Silence
    """Its own reaction to a silent host, once `set_up` has set its watchdog."""
    bounds: tuple[Bound, ...]
    """Quantities that the drive itself bounds, whatever the host commands."""
    cadence: Cadence
    """When a reading comes: after SYNC, as the reply to a command, or by the drive's own clock."""
    frame: FrameKind
    """Identifiers of 11 or 29 bits on classical CAN, or CAN FD."""
    torque_cycles: int = 1
    """Cycles from one torque reading to the next."""
    kept: Silence | None = None
    """Of a drive that keeps on: its reaction once a keeper (`armlink.link.keeper`) has sent its `safe_frames`."""
    heard: bool = False
    """It is no drive on a bus: another program tells of the joint, and nothing can be asked or ordered."""

    def reaction(self, keeper: bool) -> Silence:
        """Its reaction to a silent host, with a keeper or without."""
        return self.kept if keeper and self.kept and self.silence == "keeps on" else self.silence

    def as_json(self) -> dict[str, Any]:
        """By name, as `armlink drives --json` has them."""
        shown = ("torque", "calibration", "silence", "bounds", "cadence", "frame")
        return {name: list(value) if isinstance(value := getattr(self, name), tuple) else value for name in shown}
