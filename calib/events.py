"""What the observer says: events and estimates."""

from dataclasses import dataclass, field
from typing import Any

from calib.decision import Finding
from calib.records import Array


@dataclass(frozen=True)
class Event:
    """Something that the observer has to say. `kind`: alarm, outliers, verdict, proposal or undecided."""

    t: float
    kind: str
    joint: str | None
    evidence: dict[str, Any] = field(default_factory=dict)
    finding: Finding | None = None
    """What to write, for a proposal."""


@dataclass(frozen=True)
class Estimate:
    """Gain and offset of every joint against the installed calibration, with standard deviations; (n,) each."""

    gain: Array
    gain_std: Array
    offset: Array
    """[N·m]"""
    offset_std: Array
    accepted: Array
    """Rows that went into each."""
